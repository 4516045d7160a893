"""The ground below a surface: what can be reached by gentle slopes and is stepped up from, not down from."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numpy as np

CELL_TAUS = 2.0
"""Of the height map, multiples of tau."""
MAX_MAP_SIDE_CELLS = 1024
"""Of the height map, along each side."""
MAX_SLOPE = 1.0
"""Slope between neighbouring cells above which there is a step between them."""
MIN_LOWER_SHARE = 0.75
"""Share of the steps around a connected piece, at which it must be the lower side to be ground."""
MIN_CONNECTED_SHARE = 0.01
"""Of all cells: smaller pieces are judged by their height above the ground around them."""
HIGHEST_PERCENTILE = 98
"""Percentile of the heights above ground that stands for the highest."""
CLEARANCE = 0.05
"""Of that height, up to which a surface still lies on the ground."""


@dataclass(frozen=True)
class Terrain:
    """Heights of the ground on a lattice of square cells.

    Attributes:
        turn: (3, 3) unit vectors in rows: two on the ground, and up.
        corner: (2,) of the first cell, along the first two of them.
        cell: Side of a cell.
        heights: (X, Y) of the ground.
        clearance: Height above it up to which a surface lies on the ground.
    """

    turn: np.ndarray
    corner: np.ndarray
    cell: float
    heights: np.ndarray
    clearance: float

    def above(self, points: np.ndarray) -> np.ndarray:
        """(n,) heights of (n, 3) points above the ground below them; beyond the map, above the nearest of it."""
        placed = points @ self.turn.T
        at = np.floor((placed[:, :2] - self.corner) / self.cell).astype(np.int64)
        x, y = at.clip(0, np.array(self.heights.shape) - 1).T
        return placed[:, 2] - self.heights[x, y]


def terrain(points: np.ndarray, turn: np.ndarray, tau: float) -> Terrain:
    """The ground below points.

    The lowest point of each cell makes a height map. Pieces of it without steps are ground if they are the lower side
    of most steps around them; elsewhere, the nearest ground counts. So hills are ground, whatever their height, and
    roofs are not, however wide.

    Args:
        points: (n, 3) on surfaces that face up or down, at least one.
        turn: (3, 3) unit vectors in rows: two on the ground, and up.
        tau: Threshold of the comparison, which sets the resolution.
    """
    from scipy import ndimage

    placed = points @ turn.T
    corner = placed[:, :2].min(0)
    cell = max(CELL_TAUS * tau, float(np.ptp(placed[:, :2], axis=0).max()) / MAX_MAP_SIDE_CELLS)
    at = np.floor((placed[:, :2] - corner) / cell).astype(np.int64)
    lowest = np.full(at.max(0) + 1, np.inf)
    np.minimum.at(lowest, tuple(at.T), placed[:, 2])
    lowest = _filled(lowest, np.isfinite(lowest), ndimage)
    heights = _filled(lowest, _ground(lowest, cell), ndimage)
    found = Terrain(turn, corner, cell, heights, 0.0)
    highest = float(np.percentile(found.above(points), HIGHEST_PERCENTILE))
    return Terrain(turn, corner, cell, heights, max(2 * tau, CLEARANCE * highest))


def _filled(values: np.ndarray, known: np.ndarray, ndimage: ModuleType) -> np.ndarray:
    """(X, Y) values, that of the nearest known cell where they are not known."""
    if known.all():
        return values
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def _ground(lowest: np.ndarray, cell: float) -> np.ndarray:
    """(X, Y) bool: cells of the pieces that are ground."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    number = np.arange(lowest.size).reshape(lowest.shape)
    pairs = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:])]
    a, b = (np.concatenate([pair[side].ravel() for pair in pairs]) for side in (0, 1))
    rise = lowest.ravel()[b] - lowest.ravel()[a]
    flat = np.abs(rise) <= MAX_SLOPE * cell
    links = csr_matrix((np.ones(flat.sum()), (a[flat], b[flat])), shape=(lowest.size,) * 2)
    count, piece = connected_components(links, directed=False)
    area = np.bincount(piece, minlength=count)
    low = np.where(rise > 0, a, b)[~flat]
    high = np.where(rise > 0, b, a)[~flat]
    apart = piece[low] != piece[high]
    lower, upper = (np.bincount(piece[side[apart]], minlength=count) for side in (low, high))
    share = (lower + 1) / (lower + upper + 1)  # 1 for a piece with no step around it
    ground = (area >= MIN_CONNECTED_SHARE * lowest.size) & (share >= MIN_LOWER_SHARE)
    if not ground.any():
        ground[np.argmax(area * share)] = True
    return ground[piece].reshape(lowest.shape)
