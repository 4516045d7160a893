"""Points of a surface from the depth maps of all views: one for a cell, and one for many where they lie on a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surfkit.mesh.sights import Sight, Sights, for_all
from surfkit.native import module

LEVELS = 2
"""How often points on a plane become one for eight cells."""
ALIKE = 0.95
"""Length of the mean of the normals of points that become one."""


@dataclass(frozen=True)
class Points:
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


def gather(
    sights: Sights, side: float, limit: float, least_weight: float, flat: float, most: int = 2**62
) -> Points | None:
    """One point for each cell of a lattice where depth has some weight; None if there are more than `most` cells.

    Args:
        sights: What the views see.
        side: Of a cell, local units.
        limit: Depth from which nothing counts, local units.
        least_weight: Sum of the weights of the pixels of a cell that has a point.
        flat: Distance from a plane up to which points on it become one, cells.
        most: See above.
    """
    native = module()
    half = 1 << (native.CELL_BITS - 1)
    cells = native.Cells(side, [-half] * 3, [half] * 3)

    def add(sight: Sight) -> None:
        if cells.count <= most:
            cells.add(*sight.native, limit)

    for_all(sights, "gathering points", add)
    if cells.count > most:
        return None
    keys, sums = cells.rows()
    kept = sums[:, 0] >= least_weight
    keys, sums = keys[kept], sums[kept]
    cell = (np.stack([keys >> 2 * native.CELL_BITS, keys >> native.CELL_BITS, keys], 1) & (2 * half - 1)) - half
    sums[:, 1:4] += sums[:, :1] * (cell * side)
    sums = np.concatenate([sums, np.ones((len(sums), 1))], 1)
    for _ in range(LEVELS):
        cell, sums = merged(cell >> 1, sums, flat * side)
    means = sums[:, 1:] / sums[:, :1]
    lengths = np.linalg.norm(means[:, 3:6], axis=1, keepdims=True)
    normals = np.where(lengths > 0.3, means[:, 3:6] / np.maximum(lengths, 1e-12), 0)
    colors = np.rint(means[:, 6:9]).astype(np.uint8)
    return Points(means[:, :3], normals.astype(np.float32), colors, sums[:, 10].astype(np.float32))


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
    agree = np.linalg.norm(total[:, 4:7], axis=1) > ALIKE * np.add.reduceat(np.linalg.norm(sums[:, 4:7], axis=1), first)
    joined = (least < thickness**2) & agree
    stays = ~joined[group]
    return np.concatenate([cell[first[joined]], cell[stays]]), np.concatenate([total[joined], sums[stays]])
