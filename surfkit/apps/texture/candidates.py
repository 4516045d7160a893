"""The photographs that a triangle can take its texture from, and what of them does not fit to the others."""

from __future__ import annotations

import numpy as np

from surfkit.apps.texture.photo_gains import MAX_USABLE_COLOR, NO_PHOTO, exposed
from surfkit.apps.texture.triangle_visibility import TriangleVisibility

MAX_PHOTOS_PER_TRIANGLE = 8
"""Photographs that are remembered for a triangle: those that show it best."""
MIN_OUTLIER_DISTANCE, OUTLIER_DISTANCE_MEDIANS = 0.08, 3.0
"""A colour that is further from the median of all photographs than this, and than so many times the median distance,
shows something else, such as a car that has moved."""
CLIPPED_QUALITY = 0.1
"""What the quality of a photograph of a triangle is multiplied by that shows it white: others may show its colour."""


class Candidates:
    """The best photographs of each triangle.

    Attributes:
        view: (F, MOST) int32 number of the photograph; NONE where there is none.
        quality: (F, MOST) float32, 0 where there is none.
        color: (F, MOST, 3) uint8 mean colour of the triangle in it.
    """

    def __init__(self, count: int) -> None:
        self.view = np.full((count, MAX_PHOTOS_PER_TRIANGLE), NO_PHOTO, np.int32)
        self.quality = np.zeros((count, MAX_PHOTOS_PER_TRIANGLE), np.float32)
        self.color = np.zeros((count, MAX_PHOTOS_PER_TRIANGLE, 3), np.uint8)

    def offer(self, view: int, sight: TriangleVisibility) -> None:
        """Take what a photograph shows, where it is better than the worst that is known."""
        worst = self.quality[sight.faces].argmin(1)
        better = sight.quality > self.quality[sight.faces, worst]
        rows, slots = sight.faces[better], worst[better]
        self.view[rows, slots] = view
        self.quality[rows, slots] = sight.quality[better]
        self.color[rows, slots] = sight.color[better]

    def shun_clipped(self) -> None:
        """Let photographs in which a triangle is white count less."""
        self.quality[(self.color > MAX_USABLE_COLOR).any(2)] *= np.float32(CLIPPED_QUALITY)

    def refuse_outliers(self, gains: np.ndarray) -> int:
        """Forget photographs of a triangle in which it has another colour than in most; how many.

        Two photographs that differ say nothing about which of them is right.

        Args:
            gains: (V, 3) what the colours of each photograph are multiplied by.
        """
        refused = 0
        for at in range(0, len(self.view), 1 << 18):
            part = slice(at, at + (1 << 18))
            there = self.view[part] != NO_PHOTO
            color = exposed(self.color[part] / np.float32(255), gains[self.view[part]].astype(np.float32))
            color[~there] = np.nan
            rows = np.flatnonzero(there.sum(1) >= 3)
            away = np.abs(color[rows] - np.nanmedian(color[rows], axis=1, keepdims=True)).max(2)
            limit = np.maximum(
                MIN_OUTLIER_DISTANCE, OUTLIER_DISTANCE_MEDIANS * np.nanmedian(away, axis=1, keepdims=True)
            )
            row, slot = np.nonzero(away > limit)
            self.view[rows[row] + at, slot] = NO_PHOTO
            self.quality[rows[row] + at, slot] = 0
            refused += len(row)
        return refused
