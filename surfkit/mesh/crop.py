"""Volumes that a mesh is cut to, in the frame of the input."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput


@dataclass(frozen=True)
class Prism:
    """A polygon swept along an axis of the frame.

    Attributes:
        corners: (K, 2) of the polygon, on the two other axes in their order.
        axis: 0, 1 or 2.
        low: Where it begins along the axis.
        high: Where it ends.
    """

    corners: np.ndarray
    axis: int
    low: float
    high: float

    def contains(self, points: np.ndarray) -> np.ndarray:
        """(M,) whether each of (M, 3) points of the input frame lies inside."""
        along, flat = points[:, self.axis], np.delete(points, self.axis, axis=1)
        inside = np.zeros(len(points), bool)
        for (x0, y0), (x1, y1) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            spans = (y0 > flat[:, 1]) != (y1 > flat[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = x0 + (flat[:, 1] - y0) * (x1 - x0) / (y1 - y0)
            inside ^= spans & (flat[:, 0] < crossing)
        return inside & (along >= self.low) & (along <= self.high)


def box(sides: tuple[float, ...]) -> Prism:
    """The box between two corners, x0 y0 z0 x1 y1 z1."""
    x0, y0, z0, x1, y1, z1 = sides
    if not (x0 < x1 and y0 < y1 and z0 < z1):
        shown = " ".join(f"{side:g}" for side in sides)
        raise BadInput(f"--crop-box {shown}: give the lowest x y z, then the highest x y z")
    return Prism(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), 2, z0, z1)


def read_crop(path: Path) -> Prism:
    """The polygon in a crop file of Tanks and Temples, which Open3D calls SelectionPolygonVolume.

    Raises:
        BadInput: It is not such a file.
    """
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
        axis = "XYZ".index(str(found["orthogonal_axis"]).upper())
        corners = np.array(found["bounding_polygon"], np.float64)
        low, high = float(found["axis_min"]), float(found["axis_max"])
        if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 3 or not np.isfinite(corners).all():
            raise ValueError("bounding_polygon must be three or more points of three numbers")
    except OSError as error:
        raise BadInput(f"--crop {path}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(
            f"--crop {path}: no crop volume with orthogonal_axis, axis_min, axis_max and bounding_polygon: {error}"
        ) from error
    return Prism(np.delete(corners, axis, axis=1), axis, low, high)
