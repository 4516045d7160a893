"""Meshes of files that are no PLY: their colours and their pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.optional import needed
from surfkit.evaluate.geometry.place import Place, place_of, root_of
from surfkit.evaluate.geometry.surface import Surface, read_surface

MESHES = (".glb", ".gltf", ".obj", ".off", ".stl")


@dataclass(frozen=True)
class Textured:
    """A GLB file with pictures on its triangles."""

    path: Path
    place: Place


def textured(path: Path, root: dict[str, Any]) -> Textured | None:
    """A GLB file if its triangles have pictures, else None."""
    return Textured(path, place_of(path, root)) if root.get("textures") else None


def other_mesh(path: Path) -> tuple[Surface, np.ndarray | None, Place, Textured | None]:
    """A mesh that is no PLY file, in the frame of the input, with the (V, 3) uint8 colours of its vertices."""
    surface = read_surface(path)  # which says what is wrong with a file, before it is looked at more closely
    root = root_of(path)
    place, colors = place_of(path, root), vertex_colors(path)
    colors = colors if colors is not None and len(colors) == len(surface) else None
    return surface, colors, place, textured(path, root)


def vertex_colors(path: Path) -> np.ndarray | None:
    """(V, 3) uint8 of a file with one mesh that trimesh reads; None where it has none, or several parts."""
    with needed("trimesh", f"{path}: a file that is not binary PLY"):
        import trimesh
    found: Any = trimesh.load(path, process=False)
    if isinstance(found, trimesh.Scene):
        if len(found.geometry) != 1:
            return None
        found = next(iter(found.geometry.values()))
    visual = getattr(found, "visual", None)
    if visual is None or not visual.defined:
        return None
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors)[:, :3]
    if visual.kind != "texture":
        return None
    if "color" in visual.vertex_attributes:  # of a GLB with a material
        colors = np.asarray(visual.vertex_attributes["color"])[:, :3]
        whole = np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1
        return np.round(colors / whole * 255).astype(np.uint8)
    return None if visual.uv is None else np.asarray(visual.to_color().vertex_colors)[:, :3]
