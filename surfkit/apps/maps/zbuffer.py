"""The highest of many triangles at the centre of each cell, without perspective.

A centre on the common edge of two triangles belongs to both: the sign of a centre to an edge is computed from the ends
of the edge in an order of their own, and is the same number for both. So surfaces have no cracks. All is computed in
coordinates of the whole map: a tile of it is the same, bit for bit, as that part of the map drawn at once.
"""

from __future__ import annotations

import numpy as np

from surfkit.apps.maps.map_grid import Window

BATCH_TRIANGLE_CELLS = 1 << 22
"""Pairs of a triangle and a cell in its bounding box in memory."""
NO_TRIANGLE = -1


class ZBuffer:
    """Height and number of the highest triangle of each cell of a window.

    Attributes:
        height: (H, W) float64, units of the input; -inf where there is no triangle.
        face: (H, W) int64 number of the triangle; NONE where there is none. Of equally high ones, the lowest number.
    """

    def __init__(self, window: Window) -> None:
        self.window = window
        self.height = np.full((window.height, window.width), -np.inf)
        self.face = np.full((window.height, window.width), NO_TRIANGLE, np.int64)

    @property
    def covered(self) -> np.ndarray:
        """(H, W) bool: where there is a triangle."""
        return self.face != NO_TRIANGLE

    def leave(self, kept: np.ndarray) -> None:
        """Forget the triangles of all cells but those of an (H, W) bool mask."""
        self.height[~kept], self.face[~kept] = -np.inf, NO_TRIANGLE

    def draw(self, corners: np.ndarray, numbers: np.ndarray) -> None:
        """Draw triangles.

        Args:
            corners: (F, 3, 3) float64 column and row in the map, and height; finite.
            numbers: (F,) of the triangles, rising from call to call and within each.
        """
        low, high = boxes(corners, self.window)
        size = (high - low).prod(1)
        shown = np.flatnonzero(size > 0)
        ends = np.cumsum(size[shown])
        first = 0
        while first < len(shown):
            last = max(
                first + 1, int(np.searchsorted(ends, (ends[first - 1] if first else 0) + BATCH_TRIANGLE_CELLS, "right"))
            )
            some = shown[first:last]
            if last == first + 1:  # may be larger than what fits
                self._one(corners[some], low[some], high[some], numbers[some])
            else:
                self._pairs(corners[some], low[some], high[some], numbers[some])
            first = last

    def _one(self, corners: np.ndarray, low: np.ndarray, high: np.ndarray, number: np.ndarray) -> None:
        """Draw a triangle of any size, some rows at a time."""
        step = max(1, BATCH_TRIANGLE_CELLS // int(high[0, 0] - low[0, 0]))
        for row in range(low[0, 1], high[0, 1], step):
            below = np.array([[high[0, 0], min(row + step, high[0, 1])]])
            self._pairs(corners, np.array([[low[0, 0], row]]), below, number)

    def _pairs(self, corners: np.ndarray, low: np.ndarray, high: np.ndarray, numbers: np.ndarray) -> None:
        """Draw triangles on all cells of their boxes at once."""
        wide, count = high[:, 0] - low[:, 0], (high - low).prod(1)
        owner = np.repeat(np.arange(len(corners)), count)
        within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        row = within // wide[owner]
        column = within - row * wide[owner] + low[owner, 0]
        row += low[owner, 1]
        inside, second, third = barycentric(corners, owner, column + 0.5, row + 0.5)
        owner = owner[inside]
        z, z_second, z_third = corners[:, :, 2].T
        height = z[owner] + second * (z_second - z)[owner] + third * (z_third - z)[owner]  # exact if level
        place = (row[inside] - self.window.top) * self.window.width + column[inside] - self.window.left
        highest, face = self.height.reshape(-1), self.face.reshape(-1)
        before = highest[place]
        np.maximum.at(highest, place, height)
        won = np.flatnonzero((height > before) & (height == highest[place]))[::-1]
        face[place[won]] = numbers[owner[won]]  # where several won, the last one that is assigned: the first triangle


def boxes(corners: np.ndarray, window: Window) -> tuple[np.ndarray, np.ndarray]:
    """First and last + 1 column and row whose centres may lie in triangles, (F, 2) int64 each, within a window."""
    least = np.array([window.left, window.top])
    most = least + [window.width, window.height]
    low = np.ceil(corners[:, :, :2].min(1) - 0.5).clip(least, most)
    high = (np.floor(corners[:, :, :2].max(1) - 0.5) + 1).clip(low, most)
    return low.astype(np.int64), high.astype(np.int64)


def barycentric(
    corners: np.ndarray, owner: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which of some places lie in their triangles, borders included: (n,) their rows; and (n,) shares of the second and
    third corner there. Triangles that are seen edge on have none.

    Args:
        corners: (F, 3, 3).
        owner: (P,) rows of `corners`.
        x: (P,) columns.
        y: (P,) rows.
    """
    signed = []
    for at in range(3):
        (ax, ay), (bx, by) = corners[:, (at + 1) % 3, :2].T, corners[:, (at + 2) % 3, :2].T
        swapped = (bx < ax) | ((bx == ax) & (by < ay))
        sign = np.where(swapped, -1.0, 1.0)
        fx, fy, tx, ty = (np.where(swapped, *pair) for pair in ((bx, ax), (by, ay), (ax, bx), (ay, by)))
        across, along = sign * (ty - fy), sign * (tx - fx)
        signed.append(along[owner] * (y - fy[owner]) - across[owner] * (x - fx[owner]))
    first, second, third = signed
    total = first + second + third
    inside = (first >= 0) & (second >= 0) & (third >= 0) | (first <= 0) & (second <= 0) & (third <= 0)
    rows = np.flatnonzero(inside & (total != 0))
    return rows, second[rows] / total[rows], third[rows] / total[rows]
