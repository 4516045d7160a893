"""Photographs made alike in their light, from the sparse points that they show."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from surfkit.depth.base import DepthInput
from surfkit.depth.cost_volume import PosedImage
from surfkit.scene.camera import Camera
from surfkit.scene.response import CENTRE, CURVE, falloff, mean_falloff, sensor_scale, uncurved
from surfkit.scene.srgb import from_linear, linear
from surfkit.scene.track_colors import axes_of, rows_of, track_colors
from surfkit.scene.track_light import MIN_SEEN, fit_light

WHITE_SHARE, MOST_STRETCH = 0.005, 4.0
"""Grey values of a photograph are stretched so that so large a share of them is white, by this factor at most: noise of
the windows, and differences within them, are then as large in dark photographs as in bright ones."""


class EvenLight:
    """Photographs in the light of the mean photograph, averaged over the picture, as `scene.track_light` finds it.

    Photographs that share too few points keep their exposure; without any points all stay as they are.
    """

    def __init__(self, given: DepthInput) -> None:
        self.stops = np.zeros((len(given.views), 3))
        self.cameras: np.ndarray | None = None
        if given.in_one_light or given.observations.is_empty:
            return
        self.rows = rows_of(given.views)
        found = fit_light(track_colors(given.views, given.observations), self.rows, axes_of(given.views))
        known = found.seen >= MIN_SEEN
        self.stops[known], self.cameras = found.stops[known], found.cameras

    def even(self, values: Tensor, number: int, camera: Camera) -> Tensor:
        """(..., H, W) sRGB values of a photograph in the light of all, 1 is white; those above 1 are not cut off.

        Args:
            values: (3, H, W) colours in [0, 1], or (H, W) grey, which are changed by the mean of the stops.
            number: Of the photograph.
            camera: At the size of the values.
        """
        if self.cameras is None:
            return values
        numbers, scale = self.cameras[self.rows[number]], sensor_scale(camera)
        sides = (camera.width, camera.cx, numbers[CENTRE][0]), (camera.height, camera.cy, numbers[CENTRE][1])
        x, y = ((np.arange(side) + 0.5 - middle) * scale - centre for side, middle, centre in sides)
        lost = falloff(numbers, x**2 + y[:, None] ** 2) - mean_falloff(numbers, camera)
        stops = self.stops[number].mean() if values.ndim == 2 else self.stops[number][:, None, None]
        light = linear(uncurved(values.cpu().numpy(), numbers[CURVE]))
        return torch.from_numpy(from_linear(light * np.exp2(lost - stops))).to(values)

    def picture(self, taken: PosedImage, number: int) -> PosedImage:
        """A photograph in the light of all, see `even`."""
        return PosedImage(taken.camera, self.even(taken.color, number, taken.camera))


def stretched(grey: Tensor) -> Tensor:
    """(H, W) uint8 of (H, W) grey values in [0, 255], times what makes `WHITE_SHARE` of them white."""
    white = float(np.quantile(grey.numpy(), 1 - WHITE_SHARE))
    return (grey * min(255 / max(white, 1.0), MOST_STRETCH)).round().clamp(max=255).to(torch.uint8)
