"""A mesh from a file in memory, as its connections need it: vertices in one place are one vertex."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import BLOCK_POINTS, SurfaceFile
from surfkit.scene.same_places import first_in_place


@dataclass(frozen=True)
class WholeMesh:
    """A mesh in memory.

    Attributes:
        path: The file.
        places: (V, 3) float32 or float64 coordinates as the file has them, without its offset.
        faces: (F, 3) int32 rows of the corners, three different ones.
        areas: (F,) float32.
        extents: (F,) float32 longest sides of the bounding boxes.
    """

    path: Path
    places: np.ndarray
    faces: np.ndarray
    areas: np.ndarray
    extents: np.ndarray

    @property
    def area(self) -> float:
        """Of all faces, square units of the mesh."""
        return float(self.areas.sum(dtype=np.float64))

    def corners(self, faces: np.ndarray | slice) -> np.ndarray:
        """(n, 3, 3) float64 corners of some faces."""
        return self.places[self.faces[faces]].astype(np.float64)

    def part(self, faces: np.ndarray) -> SurfaceFile:
        """Some faces as a surface of their own, each with its own vertices."""
        return SurfaceFile(self.path, self.corners(faces).reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))


def whole_mesh(mesh: SurfaceFile) -> WholeMesh:
    """The mesh in memory: about 70 bytes for a triangle of a closed mesh of float32.

    Files of other programs repeat vertices, for each face (STL) or along seams of a texture: those in one place are
    made one, else every such edge would look like a hole. Faces that then have two corners in one place are left out.

    Raises:
        BadInput: No face is left, or those that are have no area.
    """
    places = _places(mesh.rows)
    stands_for = first_in_place(places)
    faces = np.empty((len(mesh.triangles), 3), np.int32)
    areas, extents = np.empty(len(faces), np.float32), np.empty(len(faces), np.float32)
    count = 0
    for start in range(0, len(faces), BLOCK_POINTS):
        block = np.asarray(mesh.triangles[start : start + BLOCK_POINTS])
        block = block if stands_for is None else stands_for[block]
        a, b, c = block.T
        block = block[(a != b) & (b != c) & (c != a)]
        rows = slice(count, count + len(block))
        faces[rows], (areas[rows], extents[rows]) = block, _sizes(places, block)
        count += len(block)
    found = WholeMesh(mesh.path, places, faces[:count], areas[:count], extents[:count])
    if not found.area > 0:
        raise BadInput(f"{mesh.path}: its faces have no area, so there is no surface to measure; make the mesh again")
    return found


def _places(rows: np.ndarray) -> np.ndarray:
    """(V, 3) coordinates in the precision of the file."""
    if rows.dtype.names is None:
        return np.asarray(rows, np.float32 if rows.dtype == np.float32 else np.float64)
    found = np.empty((len(rows), 3), np.float32 if rows.dtype["x"] == np.float32 else np.float64)
    for at, axis in enumerate("xyz"):
        found[:, at] = rows[axis]
    return found


def _sizes(places: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) areas and (n,) longest sides of the bounding boxes of faces."""
    a, b, c = (places[column] for column in faces.T)
    (ux, uy, uz), (vx, vy, vz) = (b - a).T, (c - a).T
    areas = np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2) / 2
    x, y, z = (np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c)).T
    return areas, np.maximum(np.maximum(x, y), z)
