"""Which share of each cell of a map lies inside a polygon, exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.apps.maps.map_grid import MapGrid, Window

ROUNDING = 1e-9
"""Shares nearer to 0 than this are 0: what is left of sums that cancel out."""


@dataclass(frozen=True)
class OutlinePieces:
    """The outline of a polygon, cut where it passes from one cell to another; sorted by row.

    Attributes:
        row: (P,) int64 row of the cell of each piece.
        column: (P,) int64 its column; as many as the map has columns for what lies at its right border or beyond.
        down: (P,) float64 how far the piece leads down, in cells; negative where it leads up.
        right: (P,) float64 how far its middle is from the left side of its cell, 0 to 1.
    """

    row: np.ndarray
    column: np.ndarray
    down: np.ndarray
    right: np.ndarray

    def shares(self, window: Window) -> np.ndarray:
        """(H, W) float64 share of each cell of a window that lies inside, 0 to 1.

        A piece that leads down has the inside on its right, as outer rings run anticlockwise and holes clockwise. So
        it adds what lies to the right of it in its own cell, and its length down to all cells further right: a running
        sum along the row. That is exact, as pieces are straight.
        """
        first, last = np.searchsorted(self.row, [window.top, window.top + window.height])
        row, column = self.row[first:last] - window.top, self.column[first:last] - window.left
        down, right = self.down[first:last], self.right[first:last]
        before, within = column < 0, (column >= 0) & (column < window.width)
        steps = np.zeros((window.height, window.width + 1))
        np.add.at(steps[:, 0], row[before], down[before])
        np.add.at(steps, (row[within], column[within]), down[within] * (1 - right[within]))
        np.add.at(steps, (row[within], column[within] + 1), down[within] * right[within])
        found = np.cumsum(steps, axis=1)[:, :-1]
        return np.where(found < ROUNDING, 0.0, found.clip(max=1.0))


def outline_pieces(rings: Sequence[np.ndarray], grid: MapGrid) -> OutlinePieces:
    """Cut the outline of a polygon at the sides of the cells of a map.

    What lies beyond the map is moved to its border first, so pieces are no more than the outline crosses cells, however
    large the polygon is.

    Args:
        rings: Each (n, 2) float64 easting and northing, the first place again at the end; outer rings anticlockwise,
            holes clockwise.
        grid: The map.
    """
    starts = np.concatenate([ring[:-1] for ring in rings]) / grid.gsd
    ends = np.concatenate([ring[1:] for ring in rings]) / grid.gsd
    starts, ends = ((place - [grid.west, grid.north]) * np.array([1.0, -1.0]) for place in (starts, ends))
    size = np.array([grid.width, grid.height], np.float64)
    for axis in range(2):
        borders = np.tile([0.0, size[axis]], (len(starts), 1))
        starts, ends = _cut(starts, ends, axis, borders.ravel(), np.repeat(np.arange(len(starts)), 2))
    starts, ends = (place.clip(0, size) for place in (starts, ends))
    for axis in range(2):
        starts, ends = _cut(starts, ends, axis, *_lines_between(starts[:, axis], ends[:, axis]))
    middle, down = (starts + ends) / 2, ends[:, 1] - starts[:, 1]
    kept = down != 0
    middle, down = middle[kept], down[kept]
    cell = np.floor(middle).astype(np.int64)
    cell[:, 1] = cell[:, 1].clip(0, grid.height - 1)
    order = np.argsort(cell[:, 1], kind="stable")
    cell, middle, down = cell[order], middle[order], down[order]
    return OutlinePieces(cell[:, 1], cell[:, 0], down, middle[:, 0] - cell[:, 0])


def _lines_between(starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whole numbers between the ends of (n,) intervals: (m,) float64 of them, and (m,) int64 to which each belongs."""
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    first = np.floor(low).astype(np.int64) + 1
    count = (np.ceil(high).astype(np.int64) - first).clip(min=0)
    owner = np.repeat(np.arange(len(starts)), count)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    return (first[owner] + within).astype(np.float64), owner


def _cut(
    starts: np.ndarray, ends: np.ndarray, axis: int, lines: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cut straight pieces, (n, 2) starts and ends, where a coordinate passes some values.

    Args:
        starts: (n, 2) float64.
        ends: (n, 2) float64.
        axis: Of the coordinate.
        lines: (m,) float64 values; those that a piece does not pass cut nothing.
        owner: (m,) int64 pieces that they cut.
    """
    low, high = np.minimum(starts, ends)[:, axis], np.maximum(starts, ends)[:, axis]
    passed = (lines > low[owner]) & (lines < high[owner])
    lines, owner = lines[passed], owner[passed]
    along = (lines - starts[owner, axis]) / (ends - starts)[owner, axis]
    at = starts[owner] + along[:, None] * (ends - starts)[owner]
    at[:, axis] = lines  # to the last bit, so that no sliver is left beyond the line
    order = np.lexsort([np.concatenate([np.full(len(starts), -1.0), along]), np.r_[: len(starts), owner]])
    begins = np.concatenate([starts, at])[order]
    owner = np.r_[: len(starts), owner][order]
    last = np.r_[owner[1:] != owner[:-1], True]
    stops = np.empty_like(begins)
    stops[~last] = begins[1:][~last[:-1]]
    stops[last] = ends
    return begins, stops
