"""Cubes of a mesh that stand for the whole where that would take too long, the same for the same mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from surfkit.evaluate.geometry.surface_file import BLOCK_POINTS
from surfkit.evaluate.mesh.whole import WholeMesh

MAX_CUBES_PER_AXIS = 1 << 20
"""Cubes along an axis, so that the number of a cube fits 64 bits."""
GOLDEN = 0.6180339887498949
"""The golden section, multiples of which spread most evenly between whole numbers."""
PARTS_PER_SIDE = 4
"""Into which the side of a cube is cut where vertices near it are looked for."""
PRIMES = np.array([73856093, 19349663, 83492791])
"""Of a spatial hash (Teschner et al. 2003, Optimized spatial hashing for collision detection of deformable objects)."""
HASH_TABLE_SIZE = 1 << 24
"""Of the table of that hash; two cells in one place cost time only."""


@dataclass(frozen=True)
class MeshCube:
    """A cube, and the faces of the mesh that reach into it or near it.

    Attributes:
        low: (3,) float64.
        high: (3,) float64.
        faces: (n,) numbers of the faces whose bounding box touches the cube with its margin, in order.
        chosen: How many of the faces that cubes were laid around are in it.
    """

    low: np.ndarray
    high: np.ndarray
    faces: np.ndarray
    chosen: int

    def has(self, points: np.ndarray) -> np.ndarray:
        """(...,) bool, which of (..., 3) points lie in the cube; of those on borders between cubes, each in one."""
        return np.all((points >= self.low) & (points < self.high), axis=-1)


def boxes(mesh: WholeMesh, side: float, chosen: np.ndarray, margin: float = 0.0) -> list[MeshCube]:
    """The cubes of a lattice that some faces of a mesh have their middle in.

    Args:
        mesh: Any.
        side: Of a cube; at least a 2**20th of the extent of the mesh is taken.
        chosen: (K,) numbers of these faces.
        margin: Around a cube, from which faces are given as well.
    """
    origin, top = mesh.places.min(0).astype(np.float64), mesh.places.max(0).astype(np.float64)
    side = max(side, float((top - origin).max()) / MAX_CUBES_PER_AXIS * 1.01)
    middles = mesh.corners(chosen).mean(1)
    cells, counts = np.unique(((middles - origin) // side).astype(np.int64).clip(0), axis=0, return_counts=True)
    lows = origin + cells * side
    found = _touching(mesh, lows - margin, lows + (side + margin), _near(mesh.places, cells, origin, side, margin))
    return [MeshCube(low, low + side, *each) for low, *each in zip(lows, found, counts.tolist(), strict=True)]


def by_number(mesh: WholeMesh, count: int) -> np.ndarray:
    """(K,) faces, one from each of K equal runs of them: parts of the mesh have a share in them as in its triangles."""
    return (_steps(count) * len(mesh.faces)).astype(np.int64)


def by_area(mesh: WholeMesh, count: int) -> np.ndarray:
    """(K,) faces, one from each of K runs of equal area: parts have a share in them as in its area."""
    ends = np.cumsum(mesh.areas, dtype=np.float64)
    return np.searchsorted(ends, _steps(count) * ends[-1]).clip(max=len(ends) - 1)


def _steps(count: int) -> np.ndarray:
    """(K,) numbers from 0 to 1, one in each K-th, elsewhere within each: files have rows, which even steps keep to."""
    at = np.arange(count)
    return (at + at * GOLDEN % 1) / count


def _touching(mesh: WholeMesh, low: np.ndarray, high: np.ndarray, near: tuple[np.ndarray, float]) -> list[np.ndarray]:
    """For each of (K, 3) least and (K, 3) greatest coordinates of boxes, the faces whose bounding box touches it.

    Args:
        mesh: Any.
        low: Of the boxes.
        high: Of the boxes.
        near: Which vertices may be one of a face that touches a box, and the extent up to which that is so.
    """
    found: list[list[np.ndarray]] = [[] for _ in low]
    is_near, reach = near
    for start in range(0, len(mesh.faces), BLOCK_POINTS):
        part = slice(start, start + BLOCK_POINTS)
        rows = start + np.flatnonzero(is_near[mesh.faces[part, 0]] | (mesh.extents[part] > reach))
        corners = mesh.corners(rows)
        least, most = corners.min(1).T.copy(), corners.max(1).T.copy()
        for at in range(len(low)):
            touches = (least[0] <= high[at, 0]) & (most[0] >= low[at, 0])
            for axis in (1, 2):
                touches &= (least[axis] <= high[at, axis]) & (most[axis] >= low[at, axis])
            found[at].append(rows[touches])
    return [np.concatenate(parts) for parts in found]


def _near(
    places: np.ndarray, cells: np.ndarray, origin: np.ndarray, side: float, margin: float
) -> tuple[np.ndarray, float]:
    """(V,) bool, false only for places further than a reach from all of (K, 3) cells with their margin; and the reach.

    Space is cut into cubes of the size of the reach, and a table says which of them are near a cell.
    """
    reach = side / PARTS_PER_SIDE
    around = 1 + math.ceil(margin / reach)
    steps = np.arange(-around, PARTS_PER_SIDE + around)
    cubes = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    table = np.zeros(HASH_TABLE_SIZE, bool)
    table[_hash((cells[:, None] * PARTS_PER_SIDE + cubes).reshape(-1, 3))] = True
    found = np.empty(len(places), bool)
    for start in range(0, len(places), BLOCK_POINTS):
        part = slice(start, start + BLOCK_POINTS)
        found[part] = table[_hash(((places[part] - origin) // reach).astype(np.int64))]
    return found, reach * (1 - 1e-6)  # coordinates are rounded


def _hash(cells: np.ndarray) -> np.ndarray:
    """(n,) place in the table of each of (n, 3) cells."""
    x, y, z = (cells * PRIMES).T
    return (x ^ y ^ z) & (HASH_TABLE_SIZE - 1)
