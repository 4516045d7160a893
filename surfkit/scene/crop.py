"""A volume above a polygon on the ground, as Tanks and Temples has them: surfaces are compared in it, or cut to it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json

Axis = Literal["x", "y", "z"]

PLANES = {"x": (1, 2), "y": (0, 2), "z": (0, 1)}
"""Axes of the polygon's plane, by the axis that stands on it."""
POLYGON_CLASS = "SelectionPolygonVolume"


@dataclass(frozen=True)
class Crop:
    """A volume above and below a polygon, in the frame of the truth.

    Attributes:
        polygon: (K, 2) corners in the plane across the axis, in order, without the first one again at the end.
        low: Least coordinate along the axis.
        high: Greatest.
        axis: That stands on the polygon.
    """

    polygon: np.ndarray
    low: float
    high: float
    axis: Axis = "z"

    @property
    def area(self) -> float:
        """Of the polygon."""
        x, y = self.polygon.T
        return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """(3,) least and (3,) greatest coordinates."""
        low, high = np.empty(3), np.empty(3)
        plane, along = list(PLANES[self.axis]), "xyz".index(self.axis)
        low[plane], high[plane] = self.polygon.min(0), self.polygon.max(0)
        low[along], high[along] = self.low, self.high
        return low, high

    def inside(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: which of the (n, 3) points lie in it."""
        along = points[:, "xyz".index(self.axis)]
        result = (along >= self.low) & (along <= self.high)
        near = np.flatnonzero(result)
        result[near] = within(self.polygon, points[near][:, list(PLANES[self.axis])])
        return result


def within(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n,) bool: which of the (n, 2) points lie in the (K, 2) polygon: a ray from them crosses its sides oddly often.

    The points are sorted by height once, so that each side looks only at those of its own heights.
    """
    order = np.argsort(points[:, 1], kind="stable")
    x, y = points[order].T
    odd = np.zeros(len(points), bool)
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if start[1] == end[1]:
            continue
        (x0, y0), (x1, y1) = sorted((tuple(start), tuple(end)), key=lambda corner: corner[1])
        band = slice(np.searchsorted(y, y0, "left"), np.searchsorted(y, y1, "left"))
        odd[band] ^= x[band] < x0 + (y[band] - y0) * ((x1 - x0) / (y1 - y0))
    result = np.empty(len(points), bool)
    result[order] = odd
    return result


def box(sides: tuple[float, ...]) -> Crop:
    """The box between two corners, x0 y0 z0 x1 y1 z1."""
    x0, y0, z0, x1, y1, z1 = sides
    if not (x0 < x1 and y0 < y1 and z0 < z1):
        shown = " ".join(f"{side:g}" for side in sides)
        raise BadInput(f"--crop-box {shown}: give the lowest x y z, then the highest x y z")
    return Crop(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), z0, z1)


def read_crop(path: Path) -> Crop:
    """The volume in a JSON file of Tanks and Temples (`SelectionPolygonVolume` of Open3D).

    Raises:
        BadInput: Not such a file.
    """
    try:
        data = read_json(path, dict[str, Any])
        axis: Any = str(data["orthogonal_axis"]).lower()
        if axis not in PLANES:
            raise BadInput(f"{path}: orthogonal_axis is {data['orthogonal_axis']!r}; it must be X, Y or Z")
        corners = np.array(data["bounding_polygon"], np.float64)
        low, high = float(data["axis_min"]), float(data["axis_max"])
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(
            f"{path}: no crop volume: it must be JSON with orthogonal_axis, axis_min, axis_max and bounding_polygon"
        ) from error
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 3 or not np.isfinite(corners).all():
        raise BadInput(f"{path}: bounding_polygon must be a list of 3 or more points x, y, z")
    if not low < high:
        raise BadInput(f"{path}: axis_min {low:g} is not below axis_max {high:g}")
    polygon = corners[:, list(PLANES[axis])]
    return Crop(
        polygon[:-1] if len(polygon) > 3 and np.array_equal(polygon[0], polygon[-1]) else polygon, low, high, axis
    )


def write_crop(path: Path, crop: Crop) -> None:
    """Save a volume in the form of Tanks and Temples, which Open3D and the toolbox read."""
    corners = np.zeros((len(crop.polygon), 3))
    corners[:, list(PLANES[crop.axis])] = crop.polygon
    write_json(
        path,
        {
            "axis_max": crop.high,
            "axis_min": crop.low,
            "bounding_polygon": corners.tolist(),
            "class_name": POLYGON_CLASS,
            "orthogonal_axis": crop.axis.upper(),
            "version_major": 1,
            "version_minor": 0,
        },
    )
