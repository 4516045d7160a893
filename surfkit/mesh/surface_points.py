"""Points of a surface from the depth maps of all views: one for a cell, and one for many where they lie on a plane."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np

from surfkit.mesh.delaunay import split
from surfkit.mesh.view_observations import ViewObservation, ViewObservations, for_all
from surfkit.raster.native import kernels
from surfkit.scene.morton import morton_order

MERGE_LEVELS = 2
"""How often points on a plane become one for eight cells."""
MIN_NORMAL_AGREEMENT = 0.95
"""Length of the mean of the normals of points that become one."""


@dataclass(frozen=True)
class SurfacePoints:
    """Means of what views see.

    Attributes:
        places: (P, 3) float64 local.
        normals: (P, 3) float32 of length 1, or 0 where they are not known.
        colors: (P, 3) uint8.
        cells: (P,) float32 how many cells each stands for.
    """

    places: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    cells: np.ndarray

    def take(self, rows: np.ndarray) -> SurfacePoints:
        """Those of (N,) rows."""
        return SurfacePoints(self.places[rows], self.normals[rows], self.colors[rows], self.cells[rows])


COARSE_SIDE_CELLS = 4
"""Cells along each axis of those by which others are counted before there are any."""
FINE_CELLS_PER_COARSE = 24
"""Cells that have a point in each of these: 16 where a surface is flat."""


def gather(
    sights: ViewObservations, side: float, limit: float, least_weight: float, flat: float, most: int
) -> SurfacePoints:
    """One point for each cell of a lattice where depth has some weight, near ones next to each other.

    Args:
        sights: What the views see.
        side: Of a cell, local units.
        limit: Depth from which nothing counts, local units.
        least_weight: Sum of the weights of the pixels of a cell that has a point.
        flat: Distance from a plane up to which points on it become one, cells.
        most: Cells that may be in memory: more are gathered in boxes, one after the other.
    """
    boxes = boxes_with(sights, side, limit, most)
    found = []
    for at, box in enumerate(boxes, 1):
        cells = kernels().Cells(side, *box.tolist())
        ends = np.clip(box * side, *_bounds(sights, limit))
        what = "gathering points" + (f", box {at} of {len(boxes)}" if len(boxes) > 1 else "")
        for_all(sights, what, partial(_add, cells, limit), ends if len(boxes) > 1 else None)
        found.append(_points(cells.rows(), side, least_weight, flat))
    points = SurfacePoints(*(np.concatenate([getattr(part, f.name) for part in found]) for f in fields(SurfacePoints)))
    return points.take(morton_order(points.places))


def _add(cells: Any, limit: float, sight: ViewObservation) -> None:
    cells.add(*sight.native, limit)


def _bounds(sights: ViewObservations, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """(3,) lowest and highest corner of what can be seen up to a depth."""
    centres = np.stack([camera.centre.numpy() for camera in sights.cameras])
    return centres.min(0) - 4 * limit, centres.max(0) + 4 * limit


def boxes_with(sights: ViewObservations, side: float, limit: float, most: int) -> list[np.ndarray]:
    """Boxes of cells, (2, 3) int64 from the first up to, without, the second, expected to have `most` points or fewer.

    They fill space, and cells that may become one lie in the same box. Their number is estimated from every fourth
    pixel and cells four times as large.
    """
    half = 1 << (kernels().CELL_BITS - 1)
    whole = np.array([[-half] * 3, [half] * 3])
    coarse = kernels().Cells(COARSE_SIDE_CELLS * side, *whole.tolist())

    def add(sight: ViewObservation) -> None:
        camera = sight.camera
        lens = [camera.fx / COARSE_SIDE_CELLS, camera.fy / COARSE_SIDE_CELLS]
        lens += [(middle - 0.5) / COARSE_SIDE_CELLS + 0.5 for middle in (camera.cx, camera.cy)]
        part = [
            np.ascontiguousarray(values[:, ::COARSE_SIDE_CELLS, ::COARSE_SIDE_CELLS]) for values in sight.native[:4]
        ]
        coarse.add(*part, lens, sight.native[5], limit)

    for_all(sights, "counting points", add)
    if coarse.count * FINE_CELLS_PER_COARSE <= most:
        return [whole]
    boxes = split(cell_of(coarse.rows()[0]) + 0.0, max(most // FINE_CELLS_PER_COARSE, 1))
    ends = [np.ceil(np.stack(box)) * COARSE_SIDE_CELLS for box in boxes]
    return [np.clip(box, -half, half).astype(np.int64) for box in ends]


def cell_of(keys: np.ndarray) -> np.ndarray:
    """(N, 3) int64 cells with these keys."""
    bits = kernels().CELL_BITS
    return (np.stack([keys >> 2 * bits, keys >> bits, keys], 1) & ((1 << bits) - 1)) - (1 << (bits - 1))


def _points(rows: tuple[np.ndarray, np.ndarray], side: float, least_weight: float, flat: float) -> SurfacePoints:
    keys, sums = rows
    kept = sums[:, 0] >= least_weight
    cell, sums = cell_of(keys[kept]), sums[kept]
    sums[:, 1:4] += sums[:, :1] * (cell * side)
    sums = np.concatenate([sums, np.ones((len(sums), 1))], 1)
    for _ in range(MERGE_LEVELS):
        cell, sums = merged(cell >> 1, sums, flat * side)
    means = sums[:, 1:] / sums[:, :1]
    lengths = np.linalg.norm(means[:, 3:6], axis=1, keepdims=True)
    normals = np.where(lengths > 0.3, means[:, 3:6] / np.maximum(lengths, 1e-12), 0)
    colors = np.rint(means[:, 6:9]).astype(np.uint8)
    return SurfacePoints(means[:, :3], normals.astype(np.float32), colors, sums[:, 10].astype(np.float32))


def merged(cell: np.ndarray, sums: np.ndarray, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """The same points, those of one cell as one where they lie on a plane: few are enough there.

    Args:
        cell: (P, 3) int64 cell of each.
        sums: (P, 11) weight, by it positions, normals and colours, and cells.
        thickness: Standard deviation from the plane up to which they lie on it.

    Returns:
        (Q, 3) int64 and (Q, 11), in no order.
    """
    if not len(cell):
        return cell, sums
    order = np.lexsort(cell.T)
    cell, sums = cell[order], sums[order]
    first = np.flatnonzero(np.concatenate([[True], (cell[1:] != cell[:-1]).any(1)]))
    group = np.repeat(np.arange(len(first)), np.diff(first, append=len(cell)))
    total = np.add.reduceat(sums, first)
    off = sums[:, 1:4] / sums[:, :1] - (total[:, 1:4] / total[:, :1])[group]
    spread = np.stack([sums[:, 0] * off[:, i] * off[:, j] for i in range(3) for j in range(i, 3)], 1)
    spread = np.add.reduceat(spread, first) / total[:, :1]
    full = spread[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    least = np.linalg.eigvalsh(full)[:, 0]
    agree = np.linalg.norm(total[:, 4:7], axis=1) > MIN_NORMAL_AGREEMENT * np.add.reduceat(
        np.linalg.norm(sums[:, 4:7], axis=1), first
    )
    joined = (least < thickness**2) & agree
    stays = ~joined[group]
    return np.concatenate([cell[first[joined]], cell[stays]]), np.concatenate([total[joined], sums[stays]])
