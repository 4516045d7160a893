"""Photographs made alike in their light, from the sparse points that they show."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from surfkit.scene.camera import Camera
from surfkit.scene.observations import Observations
from surfkit.scene.radiometry import Radiometry, SharedPlaces, camera_numbers, estimate, vignetting_terms
from surfkit.scene.scene import View
from surfkit.scene.srgb import from_linear, linear


def light_of_tracks(
    views: Sequence[View], observations: Observations, picture: Callable[[int], tuple[Camera, Tensor]]
) -> Radiometry:
    """The light of photographs, from the sparse points that several of them show.

    Args:
        views: The photographs.
        observations: Where they show points.
        picture: Gives the camera and (3, H, W) colours in [0, 1] of a photograph at any size.
    """
    parts = []
    for number, view in enumerate(views):
        seen = observations.seen.get(view.name)
        if seen is None or not len(seen.points):
            continue
        inside = ((seen.at >= 0) & (seen.at < 1)).all(1)
        camera, color = picture(number)
        x, y = (seen.at[inside] * [camera.width, camera.height]).T
        values = color.cpu().numpy()[:, y.astype(np.int64), x.astype(np.int64)].T
        photo = np.full(len(x), number)
        parts.append((seen.points[inside], photo, np.rint(255 * values), vignetting_terms(camera, x, y)))
    if not parts:
        return Radiometry.unchanged(len(views))
    place, photo, values, terms = (np.concatenate(each) for each in zip(*parts, strict=True))
    order = np.argsort(place, kind="stable")
    shared = SharedPlaces(place[order], photo[order], values[order].astype(np.uint8), terms[order])
    return estimate(shared, camera_numbers([view.camera for view in views]))


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
