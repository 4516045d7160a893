"""The surface of a trained field as triangles."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surfkit.plugin import BadInput, Mesh, View, isosurface, replacing
from surfkit_neus.box import SceneBox
from surfkit_neus.field import SurfaceField
from surfkit_neus.render import Look

STEEPEST = 2.0
"""Gradients of a trained distance are nearly 1; tiles are skipped as if they could be this."""


def field_mesh(field: SurfaceField, box: SceneBox, views: Sequence[View], look: Look, cells: int, at_once: int) -> Mesh:
    """The surface of a field in its box, local frame, where a view may see it; without a face if there is none.

    Args:
        field: Trained.
        box: Its frame.
        views: Training views.
        look: At the last step.
        cells: Of the lattice, along the longest side of the box.
        at_once: Positions that are evaluated together.
    """
    device = field.log_sharpness.device

    @torch.no_grad()
    def distances(points: np.ndarray) -> np.ndarray:
        x = torch.from_numpy(points).float()
        return np.concatenate([field(part.to(device), look.levels)[0].cpu().numpy() for part in x.split(at_once)])

    halves = box.halves.numpy()
    vertices, faces = isosurface(distances, -halves, halves, 2 / cells, STEEPEST)
    x = torch.from_numpy(vertices)
    local = box.outward(x)
    vertices, faces = local.float().numpy(), _seen_faces(faces, _seen(local, views))
    if not len(faces):
        return Mesh(vertices, faces)
    used = np.unique(faces)
    colors = np.zeros((len(vertices), 3), np.uint8)
    colors[used] = torch.cat([_colors(field, part.to(device), look) for part in x[used].split(at_once)]).numpy()
    return Mesh(vertices, faces, colors)


def _seen(local: Tensor, views: Sequence[View]) -> np.ndarray:
    """(V,) whether a position lies in front of a camera, within its picture."""
    seen = torch.zeros(len(local), dtype=torch.bool)
    for view in views:
        u, v, z = view.camera.project(local).unbind(1)
        seen |= (z > 0) & (u >= 0) & (u < view.camera.width) & (v >= 0) & (v < view.camera.height)
    return seen.numpy()


def _seen_faces(faces: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return faces[seen[faces].all(1)]


@torch.no_grad()
def _colors(field: SurfaceField, x: Tensor, look: Look) -> Tensor:
    """(V, 3) uint8 colours of positions on the surface, seen from straight above it."""
    found = look.geometry(field, x)
    return (field.color(x, found.normal, -found.normal, found.features) * 255).round().to(torch.uint8).cpu()


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Keep a mesh, also one without a face."""
    colors: dict[str, Any] = {} if mesh.colors is None else {"colors": mesh.colors}
    with replacing(path) as file:
        np.savez(file, vertices=mesh.vertices, faces=mesh.faces, **colors)


def read_mesh(path: Path, facts: Mapping[str, Any]) -> Mesh:
    """A mesh that `write_mesh` has kept.

    Raises:
        BadInput: The file is damaged.
    """
    try:
        with np.load(path) as arrays:
            return Mesh(arrays["vertices"], arrays["faces"], arrays.get("colors"), facts)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise BadInput(f"{path}: damaged ({' '.join(str(error).split())}); delete it, and it is made again") from error
