"""The photographs that a triangle can take its texture from, and what of them does not fit to the others."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from surfkit.texture.look import Sight

MOST = 8
"""Photographs that are remembered for a triangle: those that show it best."""
NONE = -1
FEW = 30
"""Triangles that two photographs must both show for their brightness to be compared."""
DARK, BRIGHT = 8, 247
"""Colours beyond these tell nothing of the brightness of a photograph."""
AWAY, SPREADS = 0.08, 3.0
"""A colour that is further from the median of all photographs than this, and than so many times the median distance,
shows something else, such as a car that has moved."""
ENOUGH = 2_000_000
"""Triangles that gains are taken from, of a larger mesh: each gives up to 28 pairs of colours."""
STIFF = 1e-3
"""Weight by which gains are held at 1."""


class Candidates:
    """The best photographs of each triangle.

    Attributes:
        view: (F, MOST) int32 number of the photograph; NONE where there is none.
        quality: (F, MOST) float32, 0 where there is none.
        color: (F, MOST, 3) uint8 mean colour of the triangle in it.
    """

    def __init__(self, count: int) -> None:
        self.view = np.full((count, MOST), NONE, np.int32)
        self.quality = np.zeros((count, MOST), np.float32)
        self.color = np.zeros((count, MOST, 3), np.uint8)

    def offer(self, view: int, sight: Sight) -> None:
        """Take what a photograph shows, where it is better than the worst that is known."""
        worst = self.quality[sight.faces].argmin(1)
        better = sight.quality > self.quality[sight.faces, worst]
        rows, slots = sight.faces[better], worst[better]
        self.view[rows, slots] = view
        self.quality[rows, slots] = sight.quality[better]
        self.color[rows, slots] = sight.color[better]

    def refuse_outliers(self, gains: np.ndarray) -> int:
        """Forget photographs of a triangle in which it has another colour than in most; how many.

        Two photographs that differ say nothing about which of them is right.

        Args:
            gains: (V, 3) what the colours of each photograph are multiplied by.
        """
        refused = 0
        for at in range(0, len(self.view), 1 << 18):
            part = slice(at, at + (1 << 18))
            there = self.view[part] != NONE
            color = self.color[part] / np.float32(255) * gains[self.view[part]].astype(np.float32)
            color[~there] = np.nan
            rows = np.flatnonzero(there.sum(1) >= 3)
            away = np.abs(color[rows] - np.nanmedian(color[rows], axis=1, keepdims=True)).max(2)
            limit = np.maximum(AWAY, SPREADS * np.nanmedian(away, axis=1, keepdims=True))
            row, slot = np.nonzero(away > limit)
            self.view[rows[row] + at, slot] = NONE
            self.quality[rows[row] + at, slot] = 0
            refused += len(row)
        return refused


def exposure_gains(found: Candidates, views: int) -> np.ndarray:
    """(V, 3) float64 what the colours of each photograph must be multiplied by to fit to the others, 1 on the average.

    For each pair of photographs, the median ratio of the colours of the triangles that both show; the gains fit these
    in the least squares of their logarithms. Of a large mesh, evenly spread triangles are enough.
    """
    step = -(-len(found.view) // ENOUGH)
    shown, color = found.view[::step], found.color[::step]
    logs = np.zeros((views, 3))
    for channel in range(3):
        one, other, ratio = [], [], []
        for a in range(MOST):
            for b in range(a + 1, MOST):
                values = color[:, [a, b], channel]
                usable = (shown[:, [a, b]] != NONE).all(1) & ((values > DARK) & (values < BRIGHT)).all(1)
                first, second = shown[usable][:, [a, b]].T
                value = np.log(values[usable, 0].astype(np.float32)) - np.log(values[usable, 1].astype(np.float32))
                swapped = first > second
                one.append(np.where(swapped, second, first))
                other.append(np.where(swapped, first, second))
                ratio.append(np.where(swapped, -value, value))
        logs[:, channel] = _fitted(np.concatenate(one), np.concatenate(other), np.concatenate(ratio), views)
    return np.exp(logs - logs.mean(0))


def _fitted(one: np.ndarray, other: np.ndarray, ratio: np.ndarray, views: int) -> np.ndarray:
    """(V,) logarithms of the gains, of logarithms of ratios between two photographs."""
    pair = one.astype(np.int64) * views + other
    order = np.lexsort((ratio, pair))
    pair, ratio = pair[order], ratio[order]
    first = np.flatnonzero(np.diff(pair, prepend=-1))
    count = np.diff(np.append(first, len(pair)))
    middle = ratio[first + count // 2] if len(first) else np.empty(0)
    known = count >= FEW
    a, b = np.divmod(pair[first[known]], views)
    weight, middle = np.sqrt(count[known]), middle[known]
    # gain of a + ratio = gain of b
    diagonal = np.bincount(a, weight, views) + np.bincount(b, weight, views) + STIFF
    rows = np.concatenate([a, b, np.arange(views)])
    columns = np.concatenate([b, a, np.arange(views)])
    matrix = coo_matrix((np.concatenate([-weight, -weight, diagonal]), (rows, columns)), (views, views))
    side = np.bincount(b, weight * middle, views) - np.bincount(a, weight * middle, views)
    return np.atleast_1d(spsolve(matrix.tocsc(), side))
