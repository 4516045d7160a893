"""Photographs made alike in their light, from the sparse points that they show."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from surfkit.core.events import Progress, emit
from surfkit.depth.base import DepthInput
from surfkit.depth.cost_volume import PosedImage
from surfkit.scene.camera import Camera
from surfkit.scene.radiometry import (
    MAX_SHARED_PLACES,
    Radiometry,
    SharedPlaces,
    camera_numbers,
    estimate,
    vignetting_terms,
)
from surfkit.scene.srgb import from_linear, linear

LIGHT_PHASE = "comparing the light of photographs"
WHITE_SHARE, MOST_STRETCH = 0.005, 4.0
"""Grey values of a photograph are stretched so that so large a share of them is white, by this factor at most: noise of
the windows, and differences within them, are then as large in dark photographs as in bright ones."""


def light_of_tracks(given: DepthInput, picture: Callable[[int], PosedImage]) -> Radiometry:
    """The light of photographs, from the sparse points that several of them show.

    Args:
        given: The photographs, and where they show points.
        picture: Gives a photograph at any size.
    """
    if given.in_one_light:
        return Radiometry.unchanged(len(given.views))
    parts, step = [], -(-len(given.observations.xyz) // MAX_SHARED_PLACES)
    for number, view in enumerate(given.views):
        seen = given.observations.seen.get(view.name)
        if seen is None or not len(seen.points):
            continue
        used = ((seen.at >= 0) & (seen.at < 1)).all(1) & (seen.points % step == 0)
        taken = picture(number)
        camera = taken.camera
        x, y = (seen.at[used] * [camera.width, camera.height]).T
        values = taken.color.cpu().numpy()[:, y.astype(np.int64), x.astype(np.int64)].T
        photo = np.full(len(x), number)
        emit(Progress(LIGHT_PHASE, number + 1, len(given.views)))
        parts.append((seen.points[used], photo, np.rint(255 * values), vignetting_terms(camera, x, y)))
    if not parts:
        return Radiometry.unchanged(len(given.views))
    place, photo, values, terms = (np.concatenate(each) for each in zip(*parts, strict=True))
    order = np.argsort(place, kind="stable")
    shared = SharedPlaces(place[order], photo[order], values[order].astype(np.uint8), terms[order])
    return estimate(shared, camera_numbers([view.camera for view in given.views]))


def in_one_light(values: Tensor, light: Radiometry, number: int, camera: Camera) -> Tensor:
    """(..., H, W) sRGB values of a photograph whose light is multiplied by its gains; grey ones by the mean of these.

    Values are from 0, and 1 is white; those above 1 are not cut off.

    Args:
        values: (H, W) grey or (3, H, W) colours.
        light: Of all photographs.
        number: Of the photograph.
        camera: At the size of the values.
    """
    row, column = np.indices((camera.height, camera.width)) + 0.5
    gain = light.gains_at(number, camera, column.ravel(), row.ravel()).reshape(camera.height, camera.width, 3)
    factor = gain.mean(2) if values.ndim == 2 else np.moveaxis(gain, 2, 0)
    made = from_linear(linear(values.cpu().numpy()) * factor)
    return torch.from_numpy(made).to(values)


def evened(picture: PosedImage, light: Radiometry, number: int) -> PosedImage:
    """A photograph in the light of all, see `in_one_light`."""
    return PosedImage(picture.camera, in_one_light(picture.color, light, number, picture.camera))


def stretched(grey: Tensor) -> Tensor:
    """(H, W) uint8 of (H, W) grey values in [0, 255], times what makes `WHITE_SHARE` of them white."""
    white = float(np.quantile(grey.numpy(), 1 - WHITE_SHARE))
    return (grey * min(255 / max(white, 1.0), MOST_STRETCH)).round().clamp(max=255).to(torch.uint8)
