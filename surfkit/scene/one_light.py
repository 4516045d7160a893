"""Photographs in one light: what becomes of their colours so that all of them show a place alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from surfkit.scene.camera import Camera
from surfkit.scene.response import CENTRE, CURVE, corner_light, falloff, mean_falloff, sensor_scale, uncurved
from surfkit.scene.scene import View
from surfkit.scene.srgb import from_linear, linear
from surfkit.scene.track_colors import TrackColors, axes_of, rows_of
from surfkit.scene.track_light import MIN_SEEN, fit_light

MAX_GAIN = 4.0
"""Light is multiplied by no more, and divided by no more: two stops."""
KNEE = float(linear(np.array(0.8)))
"""Light up to here is multiplied by the gain; brighter one comes to white where it is white in the photograph."""


@dataclass(frozen=True)
class OneLight:
    """What `fit_light` has found, applied to photographs: in the light of the mean one, as the optical axis sees it.

    Attributes:
        stops: (V, 3) of red, green and blue of each photograph.
        tilt: (V, 2, 3) stops that red, green and blue gain along x and y of its sensor.
        kept: (V,) stops that vignetting takes from it on average, which it keeps: the whole is as bright as the
            photographs.
        taken_by: (V,) int64 the camera of each.
        cameras: (C, 8) numbers of each camera, see `scene.response`.
    """

    stops: np.ndarray
    tilt: np.ndarray
    kept: np.ndarray
    taken_by: np.ndarray
    cameras: np.ndarray

    @classmethod
    def of(cls, views: Sequence[View], colors: TrackColors) -> OneLight:
        """That of photographs, from the colours of places that they share; those that share few keep their exposure."""
        taken_by, axes = rows_of(views), axes_of(views)
        found = fit_light(colors, taken_by, axes)
        return cls(
            stops=np.where(found.seen[:, None] < MIN_SEEN, 0, found.stops),
            tilt=np.einsum("vij,ci->vjc", axes, found.slope),
            kept=np.array(
                [mean_falloff(found.cameras[row], view.camera) for row, view in zip(taken_by, views, strict=True)]
            ),
            taken_by=taken_by,
            cameras=found.cameras,
        )

    @classmethod
    def restored(cls, arrays: Mapping[str, np.ndarray]) -> OneLight:
        """That whose attributes were kept, among other arrays, by their names."""
        return cls(**{each.name: arrays[each.name] for each in fields(cls)})

    def even(self, color: np.ndarray, number: int, camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(n, 3) sRGB colours in [0, 1] of a photograph, in one light.

        Args:
            color: (n, 3) in [0, 1].
            number: Of the photograph.
            camera: Its camera, at the size that places are of.
            x: (n,) where the colours are, pixels.
            y: (n,).
        """
        return self.even_at(color, np.full(len(x), number), sensor_places(camera, x, y))

    def even_at(self, color: np.ndarray, number: np.ndarray, place: np.ndarray) -> np.ndarray:
        """(..., 3) the same of colours of several photographs, (...), at places on the sensor, (..., 2)."""
        taken_by, lost, straight = self.taken_by[number], np.empty(number.shape), np.array(color)
        for row, values in enumerate(self.cameras):
            mine = taken_by == row
            lost[mine] = falloff(values, np.square(place[mine] - values[CENTRE]).sum(-1))
            if values[CURVE].any():
                straight[mine] = uncurved(straight[mine], values[CURVE])
        gained = self.stops[number] + np.einsum("...i,...ic->...c", place, self.tilt[number])
        stops = (lost - self.kept[number])[..., None] - gained
        return exposed(straight, np.exp2(stops).clip(1 / MAX_GAIN, MAX_GAIN))

    @property
    def gains(self) -> tuple[float, float]:
        """Least and greatest factor of the light of a photograph, at the optical axis, as it is applied."""
        found = np.exp2(-self.stops).clip(1 / MAX_GAIN, MAX_GAIN)
        return float(found.min()), float(found.max())

    @property
    def corners(self) -> np.ndarray:
        """(C,) light in the corners of the photographs of each camera, as a share of that in the middle."""
        return np.array([corner_light(values) for values in self.cameras])


def sensor_places(camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 2) places on the sensor, see `scene.response`, of places in pixels."""
    return np.stack([x - camera.cx, y - camera.cy], -1) * sensor_scale(camera)


def exposed(color: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """(..., 3) sRGB colours in [0, 1] of a photograph whose light is multiplied by a gain: in [0, 1] too.

    That is so for light up to `KNEE`, before or after. From there a monotone curve of one rational quadratic (Gregory
    and Delbourgo, Piecewise Rational Quadratic Interpolation to Monotonic Data, IMA Journal of Numerical Analysis,
    1982) goes to white, where it has the slope 1: as many colours are nearly white as in the photograph.

    Args:
        color: (..., 3).
        gain: (..., 3), What its light is multiplied by.
    """
    light = linear(color)
    start = KNEE / np.maximum(gain, 1)
    mean = (1 - gain * start) / (1 - start)
    t = ((light - start) / (1 - start)).clip(0, 1)
    beyond = (1 - gain * start) * (mean * t**2 + gain * t * (1 - t)) / (mean + (gain + 1 - 2 * mean) * t * (1 - t))
    return from_linear(np.where(light <= start, gain * light, gain * start + beyond))
