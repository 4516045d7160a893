"""Meshes of files that are no PLY: where they lie, what is up, their colours, and their pictures."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.optional import needed
from surfkit.evaluate.geometry.surface import Surface, read_surface
from surfkit.export.glb import read_glb

MESHES = (".glb", ".gltf", ".obj", ".off", ".stl")
Y_UP, Z_UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the y up of glTF to z up."""
NOTE = re.compile(r"^(?:comment|#) (crs|metres[ _]per[ _]unit|offset):? (.+)$", re.MULTILINE)
"""What files of surfkit say of their coordinates, in headers of PLY and in comments of OBJ."""


@dataclass(frozen=True)
class Place:
    """Where the coordinates of a file lie in the frame of the input: input = turn @ file + offset.

    Attributes:
        turn: (3, 3) a rotation.
        offset: (3,) input units.
        up: (3,) unit vector, frame of the input.
        notes: Of the coordinates, by the names in `NOTE`.
    """

    turn: np.ndarray
    offset: np.ndarray
    up: np.ndarray
    notes: dict[str, str]


@dataclass(frozen=True)
class Textured:
    """A GLB file with pictures on its triangles."""

    path: Path
    place: Place


def place_of(path: Path, root: dict[str, Any]) -> Place:
    """Where a mesh lies.

    A GLB of `surfkit mesh` has its offset in NAME.glb.json, one of `surfkit texture` in itself, with a node that turns
    it to y up; the coordinates before that are those of the input. In glTF files of others, y is up. An OBJ of surfkit
    has its offset in a comment; in other files z is taken for up.

    Args:
        path: Of the file.
        root: JSON of a GLB file; empty for others.

    Raises:
        BadInput: What the file says of it is damaged.
    """
    beside, kind = Path(f"{path}.json"), path.suffix.lower()
    if kind == ".glb" and beside.exists():
        told = read_json(beside, dict[str, Any])
        turn = FROM_Y_UP if str(told.get("up", "")).startswith("y") else np.eye(3)
        return _place(beside, turn, Z_UP, told)
    if told := own_notes(root):
        turn = _rotation(path, root).T
        return _place(path, turn, turn @ Y_UP, told)
    if kind == ".obj":
        with path.open("rb") as file:
            notes = notes_in(file.read(1 << 12).decode("ascii", "replace"))
        return _place(path, np.eye(3), Z_UP, notes | {"offset": notes.get("offset", "0 0 0").split()})
    return Place(np.eye(3), np.zeros(3), Y_UP if kind in (".glb", ".gltf") else Z_UP, {})


def root_of(path: Path) -> dict[str, Any]:
    """The JSON of a GLB file; empty for others."""
    return read_glb(path).root if path.suffix.lower() == ".glb" else {}


def textured(path: Path, root: dict[str, Any]) -> Textured | None:
    """A GLB file if its triangles have pictures, else None."""
    return Textured(path, place_of(path, root)) if root.get("textures") else None


def other_mesh(path: Path) -> tuple[Surface, np.ndarray | None, Place, Textured | None]:
    """A mesh that is no PLY file, in the frame of the input, with the (V, 3) uint8 colours of its vertices."""
    surface = read_surface(path)  # which says what is wrong with a file, before it is looked at more closely
    root = root_of(path)
    place, colors = place_of(path, root), vertex_colors(path)
    colors = colors if colors is not None and len(colors) == len(surface) else None
    moved = surface.vertices() @ place.turn.T + place.offset
    return Surface(path, moved, surface.faces), colors, place, textured(path, root)


def notes_in(text: str) -> dict[str, str]:
    """What the first lines of a file say of its coordinates, by name."""
    return {key.replace("_", " "): value.strip() for key, value in NOTE.findall(text.replace("\r", ""))}


def own_notes(root: dict[str, Any]) -> dict[str, Any] | None:
    """What a GLB file of surfkit says of its coordinates; None for files of others."""
    told: Any = root
    for name in ("asset", "extras", "surfkit"):
        told = told.get(name) if isinstance(told, dict) else None
    return told if isinstance(told, dict) else None


def _place(path: Path, turn: np.ndarray, up: np.ndarray, told: dict[str, Any]) -> Place:
    try:
        offset = np.array(told.get("offset", (0, 0, 0)), np.float64)
        unit = told.get("metres_per_unit", told.get("metres per unit"))
        notes = {"crs": told.get("crs"), "metres per unit": None if unit is None else float(unit)}
    except (TypeError, ValueError):
        offset, notes = np.empty(0), {}
    if offset.shape != (3,) or not np.isfinite(offset).all():
        raise BadInput(f"{path}: what it says of its coordinates is damaged; write the file again")
    return Place(turn, offset, up, {name: str(value) for name, value in notes.items() if value is not None})


def _rotation(path: Path, root: dict[str, Any]) -> np.ndarray:
    """(3, 3) of the 16 numbers of the only node, column by column."""
    try:
        turn = np.array(root["nodes"][0].get("matrix", np.eye(4).ravel()), np.float64).reshape(4, 4).T[:3, :3]
    except (AttributeError, LookupError, TypeError, ValueError):
        turn = np.zeros((3, 3))
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6):
        raise BadInput(f"{path}: the matrix of its node is damaged; write the file again")
    return turn


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
