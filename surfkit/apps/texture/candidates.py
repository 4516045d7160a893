"""The photographs that a triangle can take its texture from, and what of them does not fit to the others."""

from __future__ import annotations

import math

import numpy as np

from surfkit.apps.texture.triangle_visibility import TriangleVisibility
from surfkit.scene.one_light import OneLight
from surfkit.scene.track_colors import MAX_SIGHTS, TrackColors

NO_PHOTO = -1
"""Number of the photograph where there is none."""
MAX_PHOTOS_PER_TRIANGLE = 8
"""Photographs that are remembered for a triangle: those that show it best."""
MIN_OUTLIER_DISTANCE, OUTLIER_DISTANCE_MEDIANS = 0.08, 3.0
"""A colour that is further from the median of all photographs than this, and than so many times the median distance,
shows something else, such as a car that has moved."""
CLIPPED_QUALITY = 0.1
"""What the quality of a photograph of a triangle is multiplied by that shows it white: others may show its colour."""

WHITE = 247
"""A colour above this is white, or nearly: it may have been cut off."""
SIGHTS_PER_PHOTO = 1000
"""Colours of triangles that the light of each photograph is found from, on average."""

BATCH_TRIANGLES = 1 << 18
"""Triangles at once."""


class Candidates:
    """The best photographs of each triangle.

    Attributes:
        view: (F, MOST) int32 number of the photograph; NONE where there is none.
        quality: (F, MOST) float32, 0 where there is none.
        color: (F, MOST, 3) uint8 mean colour of the triangle in it.
        place: (F, MOST, 2) float16 where on the sensor the triangle lies, see `sensor_places`.
    """

    def __init__(self, count: int) -> None:
        self.view = np.full((count, MAX_PHOTOS_PER_TRIANGLE), NO_PHOTO, np.int32)
        self.quality = np.zeros((count, MAX_PHOTOS_PER_TRIANGLE), np.float32)
        self.color = np.zeros((count, MAX_PHOTOS_PER_TRIANGLE, 3), np.uint8)
        self.place = np.zeros((count, MAX_PHOTOS_PER_TRIANGLE, 2), np.float16)

    def offer(self, view: int, sight: TriangleVisibility) -> None:
        """Take what a photograph shows, where it is better than the worst that is known."""
        worst = self.quality[sight.faces].argmin(1)
        better = sight.quality > self.quality[sight.faces, worst]
        rows, slots = sight.faces[better], worst[better]
        self.view[rows, slots] = view
        self.quality[rows, slots] = sight.quality[better]
        self.color[rows, slots] = sight.color[better]
        self.place[rows, slots] = sight.place[better]

    def shared(self, photos: int) -> TrackColors:
        """Places as photographs show them: the triangles, evenly spread ones where there are more than enough.

        Args:
            photos: How many photographs there are.
        """
        most = min(SIGHTS_PER_PHOTO * photos, MAX_SIGHTS)
        there = int(np.count_nonzero(self.view != NO_PHOTO))
        some = np.arange(0, len(self.view), max(1, math.ceil(there / most)))
        row, slot = np.nonzero(self.view[some] != NO_PHOTO)
        at = some[row], slot
        return TrackColors(self.view[at].astype(np.int64), row, self.place[at].astype(float), self.color[at] / 255)

    def shun_clipped(self) -> None:
        """Let photographs in which a triangle is white count less."""
        self.quality[(self.color > WHITE).any(2)] *= np.float32(CLIPPED_QUALITY)

    def refuse_outliers(self, light: OneLight) -> int:
        """Forget photographs of a triangle in which it has another colour than in most; how many.

        Two photographs that differ say nothing about which of them is right.

        Args:
            light: Of the photographs.
        """
        refused = 0
        for at in range(0, len(self.view), BATCH_TRIANGLES):
            part = slice(at, at + BATCH_TRIANGLES)
            there = self.view[part] != NO_PHOTO
            color = self._colors(part, light)
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

    def differences(self, light: OneLight) -> np.ndarray:
        """(F,) float32 mean difference of the colours of a triangle in its photographs from their median, of 1."""
        found = np.zeros(len(self.view), np.float32)
        for at in range(0, len(self.view), BATCH_TRIANGLES):
            part = slice(at, at + BATCH_TRIANGLES)
            color = self._colors(part, light)
            rows = np.flatnonzero((self.view[part] != NO_PHOTO).sum(1) >= 2)
            away = np.abs(color[rows] - np.nanmedian(color[rows], axis=1, keepdims=True))
            found[rows + at] = np.nanmean(away, axis=(1, 2))
        return found

    def _colors(self, part: slice, light: OneLight) -> np.ndarray:
        """(n, MOST, 3) colours in [0, 1] of some triangles, made alike; NaN where there is no photograph."""
        color = light.even_at(self.color[part] / 255, self.view[part], self.place[part].astype(float))
        color[self.view[part] == NO_PHOTO] = np.nan
        return color
