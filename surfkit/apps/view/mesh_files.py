"""Meshes of files that are no PLY: their colours and their pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.events import Warned, emit
from surfkit.core.optional import needed
from surfkit.evaluate.geometry.file_transform import FileTransform, place_of, root_of
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface
from surfkit.io.glb import UNSIGNED_BYTE
from surfkit.scene.srgb import from_linear

SRGB_WRITERS = ("surfkit ", "https://github.com/mikedh/trimesh")
"""How `asset.generator` begins in files of programs that write bytes of sRGB to COLOR_0, as surfkit once did."""
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".stl")


@dataclass(frozen=True)
class TexturedGlb:
    """A GLB file with pictures on its triangles."""

    path: Path
    place: FileTransform


def textured(path: Path, root: dict[str, Any]) -> TexturedGlb | None:
    """A GLB file if its triangles have pictures, else None.

    A browser is sent such a file as it is, and would fetch whatever it names: one that names anything outside itself is
    not sent.
    """
    if not root.get("textures"):
        return None
    if outside := next(addresses(root), None):
        emit(Warned(f"{path}: the mesh is shown without pictures: it names {outside[:200]!r}, outside of the file"))
        return None
    return TexturedGlb(path, place_of(path, root))


def addresses(value: Any) -> Iterator[str]:
    """Every address at any depth of the JSON of a GLB file that is not data in itself."""
    items = value.items() if isinstance(value, dict) else enumerate(value if isinstance(value, list) else ())
    for name, item in items:
        if name in ("uri", "url") and isinstance(item, str) and not item.startswith("data:"):
            yield item
        yield from addresses(item)


def other_mesh(path: Path) -> tuple[SurfaceFile, np.ndarray | None, FileTransform, TexturedGlb | None]:
    """A mesh that is no PLY file, in the frame of the input, with the (V, 3) uint8 colours of its vertices."""
    surface = read_surface(path)  # which says what is wrong with a file, before it is looked at more closely
    root = root_of(path)
    place, colors = place_of(path, root), vertex_colors(path, root)
    colors = colors if colors is not None and len(colors) == len(surface) else None
    return surface, colors, place, textured(path, root)


def vertex_colors(path: Path, root: dict[str, Any]) -> np.ndarray | None:
    """(V, 3) uint8 of a file with one mesh that trimesh reads; None where it has none, or several parts.

    Args:
        path: Of the file.
        root: JSON of a GLB file, whose colours are linear; empty for others.
    """
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
    if missing := missing_pictures(path):
        emit(Warned(f"{path}: the mesh is shown without its picture: {missing[0]!r} is not beside it"))
        return None
    if visual.kind == "vertex":
        return _on_screen(np.asarray(visual.vertex_colors), root)
    if visual.kind != "texture":
        return None
    if "color" in visual.vertex_attributes:  # of a GLB with a material
        return _on_screen(np.asarray(visual.vertex_attributes["color"]), root)
    if visual.uv is None:
        return None
    picture = getattr(visual.material, "image", getattr(visual.material, "baseColorTexture", None))
    return None if picture is None else np.asarray(visual.to_color().vertex_colors)[:, :3]


def _on_screen(colors: np.ndarray, root: dict[str, Any]) -> np.ndarray:
    """(V, 3) uint8 sRGB of the colours of a file, (V, 3) or (V, 4) whole numbers or floats."""
    colors = colors[:, :3] / (np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1)
    if root and not _has_srgb_bytes(root):
        colors = from_linear(colors)
    return np.round(255 * colors.clip(0, 1)).astype(np.uint8)


def _has_srgb_bytes(root: dict[str, Any]) -> bool:
    """Whether a GLB file is of a program that writes bytes of sRGB where glTF has linear colours."""
    try:
        colors = root["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
        is_bytes = root["accessors"][colors]["componentType"] == UNSIGNED_BYTE
        return is_bytes and str(root["asset"].get("generator")).startswith(SRGB_WRITERS)
    except (AttributeError, LookupError, TypeError):
        return False


def missing_pictures(path: Path) -> list[str]:
    """Names of the files that an OBJ file takes its pictures from, or describes them in, and that are not there."""
    named: list[str] = []
    if path.suffix.lower() == ".obj":
        named = _words(path, "mtllib")
        for materials in [path.parent / name for name in named if (path.parent / name).is_file()]:
            named += _words(materials, "map_Kd")
    return [name for name in named if not (path.parent / name).is_file()]


def _words(path: Path, key: str) -> list[str]:
    """What follows a word at the beginning of a line, of all lines of a text file."""
    with path.open(encoding="utf-8", errors="replace") as lines:
        words = (line.strip().partition(" ") for line in lines if line.lstrip().startswith(key))
        return [value.strip() for found, _, value in words if found == key]
