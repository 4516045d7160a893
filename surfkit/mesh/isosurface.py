"""The surface where a function of position is 0, by marching cubes on a lattice, tile by tile."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.mesh.cubes import CUBE_EDGES, triangles
from surfkit.mesh.fusion import used
from surfkit.mesh.grid_tiles import join
from surfkit.mesh.lattice import SurfacePatch
from surfkit.mesh.reference_grid import name_edges

TILE_CELLS = 48
"""Cells along a tile."""
COARSE_STEP_CELLS = 8
"""Cells between the points at which a tile is looked at first, to see whether the surface can be in it."""
MAX_CELLS_PER_AXIS = 2**18
"""Cells along an axis that edges can be named for."""

Function = Callable[[np.ndarray], np.ndarray]
"""(P,) values of (P, 3) float64 positions: below 0 inside, above 0 outside."""


def isosurface(
    function: Function, low: np.ndarray, high: np.ndarray, voxel: float, steepest: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a function in a box, open where it leaves the box.

    Args:
        function: Evaluated for one tile at a time.
        low, high: (3,) corners of the box; the last cells may reach beyond it.
        voxel: Side of a cell.
        steepest: Largest length of the function's gradient, 1 for signed distances: tiles where the surface cannot be
            are not evaluated any further. None evaluates every point of the lattice.

    Returns:
        (V, 3) float32 vertices; (F, 3) int32 faces, counter-clockwise seen from where the function is above 0. Both
        are empty where it does not change its sign.

    Raises:
        BadInput: The lattice is too large, or the function is NaN or Inf.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if not (voxel > 0 and (high > low).all() and np.isfinite(high - low).all()):
        raise BadInput(f"the lattice of a mesh has voxels of {voxel:g} in a box from {low} to {high}; it needs a size")
    cells = np.ceil((high - low) / voxel - 1e-9).astype(np.int64).clip(1)
    if cells.max() >= MAX_CELLS_PER_AXIS:
        raise BadInput(f"the lattice of a mesh would have {cells.max():,} cells along an axis; give larger voxels")
    starts = list(_starts(cells))
    pieces = []
    for done, start in enumerate(starts, 1):
        size = np.minimum(cells - start, TILE_CELLS)
        if steepest is None or _may_cross(function, low, voxel, start, size, steepest):
            piece = _tile(_evaluate(function, low, voxel, start, size, 1), low, voxel, start)
            pieces += [piece] if len(piece.faces) else []
        emit(Progress("marching cubes", done, len(starts)))
    if not pieces:
        return np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
    vertices, faces, _ = join(pieces)
    return vertices, faces


def _starts(cells: np.ndarray) -> Iterator[np.ndarray]:
    for z in range(0, cells[2], TILE_CELLS):
        for y in range(0, cells[1], TILE_CELLS):
            for x in range(0, cells[0], TILE_CELLS):
                yield np.array([x, y, z])


def _evaluate(
    function: Function, low: np.ndarray, voxel: float, start: np.ndarray, size: np.ndarray, step: int
) -> np.ndarray:
    """(Z, Y, X) values at every `step`-th point of a tile, its far corners included."""
    numbers = [np.unique([*range(s, s + n, step), s + n]) for s, n in zip(start, size, strict=True)]
    axes = [low[axis] + voxel * along for axis, along in enumerate(numbers)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    values = np.asarray(function(np.stack([x, y, z], -1).reshape(-1, 3)), np.float64).reshape(z.shape)
    if not np.isfinite(values).all():
        raise BadInput("the function whose surface is to be meshed is NaN or Inf; the training may have diverged")
    return values


def _may_cross(
    function: Function, low: np.ndarray, voxel: float, start: np.ndarray, size: np.ndarray, steepest: float
) -> bool:
    """Whether the function can be 0 in a tile: it is, at no point, more than half a diagonal away from one seen."""
    values = _evaluate(function, low, voxel, start, size, COARSE_STEP_CELLS)
    reach = 0.5 * np.sqrt(3) * COARSE_STEP_CELLS * voxel * steepest
    return bool(np.abs(values).min() <= reach or (values.min() < 0 < values.max()))


def _tile(values: np.ndarray, low: np.ndarray, voxel: float, start: np.ndarray) -> SurfacePatch:
    """The surface in the cells between (Z, Y, X) values."""
    inside = values < 0
    parts = []
    for axis in range(3):
        along = 2 - axis
        a, b = (np.take(values, np.arange(n, values.shape[along] - 1 + n), along) for n in (0, 1))
        z, y, x = np.nonzero((a < 0) != (b < 0))
        lattice = start + np.stack([x, y, z], 1)
        share = a[z, y, x] / (a[z, y, x] - b[z, y, x])
        where = low + voxel * (lattice + share[:, None] * np.eye(3)[axis])
        parts.append((where, name_edges(lattice, axis)))
    vertices, edges = (np.concatenate([part[i] for part in parts]) for i in range(2))
    faces = _faces(inside, start, edges)
    return used(SurfacePatch(vertices.astype(np.float32), faces, np.zeros((len(vertices), 3), np.uint8), edges))


def _faces(inside: np.ndarray, start: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(F, 3) rows of the named edges."""
    depth, height, width = (n - 1 for n in inside.shape)
    case = np.zeros((depth, height, width), np.int32)
    for at, (dz, dy, dx) in enumerate(np.ndindex(2, 2, 2)):
        case |= inside[dz : dz + depth, dy : dy + height, dx : dx + width].astype(np.int32) << at
    z, y, x = np.nonzero((case > 0) & (case < 255))
    listed = triangles()[case[z, y, x]]
    row, place = np.nonzero(listed >= 0)
    edge = CUBE_EDGES[listed[row, place]]
    names = name_edges((start + np.stack([x, y, z], 1))[row] + edge[:, :3], edge[:, 3])
    order = np.argsort(edges)
    return order[np.searchsorted(edges[order], names)].astype(np.int32).reshape(-1, 3)
