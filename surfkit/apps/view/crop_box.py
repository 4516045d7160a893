"""A box that a user draws, as the crop file that `surfkit mesh --crop` and `surfkit evaluate --crop` read."""

from __future__ import annotations

import math

import numpy as np

from surfkit.core.check import BadInput
from surfkit.scene.crop import PLANES, Axis, Crop


def upright_axis(up: np.ndarray) -> Axis:
    """The axis of the frame that is nearest to up: boxes stand along it, as crop files know no other."""
    return ("x", "y", "z")[int(np.abs(up).argmax())]


def turned_box(one: np.ndarray, other: np.ndarray, heading_degrees: float, axis: Axis) -> Crop:
    """The box between two opposite corners.

    Args:
        one, other: (3,) in the frame of the input.
        heading_degrees: By which its sides are turned about the axis, from the other axes of the frame.
        axis: Along which it stands.

    Raises:
        BadInput: It has no volume.
    """
    plane, along = list(PLANES[axis]), "xyz".index(axis)
    angle = math.radians(heading_degrees)
    sides = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    corners = np.stack([one, other])
    flat, heights = corners[:, plane] @ sides.T, corners[:, along]
    (x0, y0), (x1, y1) = flat.min(0), flat.max(0)
    if not (x0 < x1 and y0 < y1 and heights[0] != heights[1]):
        raise BadInput("the crop box has no volume: drag its two corners apart")
    polygon = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) @ sides
    return Crop(polygon, float(heights.min()), float(heights.max()), axis)


def edges(crop: Crop) -> np.ndarray:
    """(3 K, 2, 3) segments along the edges of a crop volume, in its frame."""
    plane, along = list(PLANES[crop.axis]), "xyz".index(crop.axis)
    low, high = np.zeros((len(crop.polygon), 3)), np.zeros((len(crop.polygon), 3))
    for ring, height in ((low, crop.low), (high, crop.high)):
        ring[:, plane], ring[:, along] = crop.polygon, height
    rings = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in (low, high)]
    return np.concatenate([*rings, np.stack([low, high], axis=1)])


def sizes(crop: Crop) -> tuple[float, float, float]:
    """Both sides of a box on the ground and its height, units of its frame."""
    first, second = (float(np.linalg.norm(crop.polygon[at + 1] - crop.polygon[at])) for at in (0, 1))
    return first, second, crop.high - crop.low
