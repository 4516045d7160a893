"""Which places of a surface a photograph shows, and where in it they lie."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage

from surfkit.apps.texture.pieces import MeshClusters
from surfkit.apps.texture.triangle_visibility import HIDDEN_SLACK_PX, MIN_OUTLINE_STEP_PX, OUTLINE_PX
from surfkit.mesh.depths import nearest
from surfkit.scene.camera import Camera

RIM_PX = 2.0
"""What lies within so much of the border of a photograph is not taken from it: lenses are undistorted up to there."""


@dataclass(frozen=True)
class Sight:
    """Places that a photograph shows.

    Attributes:
        rows: (n,) which of the places, rising.
        x: (n,) float64 columns in the photograph, pixels.
        y: (n,) float64 rows in it.
        clear: (n,) bool, false near the outline of something in front, whose colour may be shown instead: meshes and
            cameras are not exact.
    """

    rows: np.ndarray
    x: np.ndarray
    y: np.ndarray
    clear: np.ndarray


def look(places: np.ndarray, camera: Camera, pieces: MeshClusters, keep: np.ndarray | None) -> Sight:
    """Find the places that are in the picture, not hidden by the mesh, and not masked.

    Args:
        places: (P, 3) on the mesh, local frame; NaN for none.
        camera: Of the photograph.
        pieces: The mesh.
        keep: (H, W) bool, false where the photograph is to be ignored; None for all of it.
    """
    x, y, z = camera.project(torch.from_numpy(np.asarray(places, np.float64))).numpy().T
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (x >= RIM_PX) & (x < camera.width - RIM_PX) & (y >= RIM_PX) & (y < camera.height - RIM_PX)
    rows = np.flatnonzero(inside)
    x, y, z = x[rows], y[rows], z[rows]
    column, row = x.astype(np.int64), y.astype(np.int64)
    if keep is not None:
        kept = keep[row, column]
        rows, x, y, z, column, row = (each[kept] for each in (rows, x, y, z, column, row))
    if not len(rows):
        return Sight(rows, x, y, np.zeros(0, bool))
    part, left, top = cut_out(camera, column, row)
    mesh, _ = pieces.in_view(part)
    depth = nearest(mesh.vertices, mesh.faces, part)
    focal, at = min(camera.fx, camera.fy), (row - top, column - left)
    seen = z <= depth[at] * (1 + HIDDEN_SLACK_PX / focal)
    # the colour of a place is mixed from the pixels around it: nothing in front may be in one of them
    around, near = (ndimage.minimum_filter(depth, 2 * reach + 1)[at] for reach in (1, OUTLINE_PX))
    seen &= z <= around * (1 + MIN_OUTLINE_STEP_PX / focal)
    clear = z <= near * (1 + MIN_OUTLINE_STEP_PX / focal)
    return Sight(rows[seen], x[seen], y[seen], clear[seen])


def cut_out(camera: Camera, column: np.ndarray, row: np.ndarray) -> tuple[Camera, int, int]:
    """A camera of the part of a picture around some pixels, and its left column and upper row."""
    left, top = (max(0, int(each.min()) - OUTLINE_PX) for each in (column, row))
    right, bottom = (
        min(camera.width, int(column.max()) + OUTLINE_PX + 1),
        min(camera.height, int(row.max()) + OUTLINE_PX + 1),
    )
    part = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=right - left, height=bottom - top)
    return part, left, top


def between(photo: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 3) colours of a (3, H, W) photograph at places in pixels, between the four centres around each."""
    height, width = photo.shape[1:]
    left, top = np.floor(x - 0.5).astype(np.int64), np.floor(y - 0.5).astype(np.int64)
    p, q = (x - 0.5 - left)[:, None], (y - 0.5 - top)[:, None]

    def at(i: int, j: int) -> np.ndarray:
        return photo[:, (top + i).clip(0, height - 1), (left + j).clip(0, width - 1)].T

    return (1 - q) * ((1 - p) * at(0, 0) + p * at(0, 1)) + q * ((1 - p) * at(1, 0) + p * at(1, 1))
