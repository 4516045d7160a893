"""Views that see the same surface from another direction, to compare depths with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from surfkit.scene.camera import Camera
from surfkit.scene.parallax import degrees_between, worth

PROBES_PER_SIDE = 12
"""Pixels along each side of a view whose points are projected into other views."""
MAX_RAY_DEGREES = 45.0
"""Degrees between rays from which on a view is not compared."""
MAX_NEARBY_VIEWS = 128
"""Number of nearby views that the probes are projected into."""
MIN_GAIN_SHARE = 0.01
"""A view with a weight below this share of the probes is not compared."""


@dataclass(frozen=True)
class Depths:
    """The depth maps of all views, read one at a time.

    Attributes:
        cameras: Of the views.
        read: (H, W) float32 camera z of the view at a position, local units; 0 where nothing is to be fused.
    """

    cameras: Sequence[Camera]
    read: Callable[[int], Tensor]

    @cached_property
    def centres(self) -> np.ndarray:
        """(V, 3) float64 positions of the cameras."""
        return np.stack([camera.centre.numpy() for camera in self.cameras])

    @cached_property
    def places(self) -> cKDTree:
        """The same, to be asked which are near."""
        return cKDTree(self.centres)


def overlapping(at: int, depths: Depths, count: int, angle: float) -> list[int]:
    """Positions of up to `count` views that see much of what a view sees, best first.

    A view is worth, for each point of the first that lies in its picture, what the angle between both rays is worth;
    less where views that are chosen already see the point, so that all points get their share.

    Args:
        at: Position of the view.
        depths: Of all views.
        count: Of views.
        angle: Between rays, degrees.
    """
    points, eye = probes(depths.cameras[at], depths.read(at)), depths.centres[at]
    if not len(points):
        return []
    near = nearby(at, depths, float(np.quantile(np.linalg.norm(points - eye, axis=1), 0.9)))
    worths = np.array([_worth(points, eye, depths.cameras[other], angle) for other in near])
    covered = np.zeros(len(points))
    chosen: list[int] = []
    while len(chosen) < min(count, len(near)):
        gains = (worths / (1 + covered)).sum(1)
        best = int(gains.argmax())
        if gains[best] <= MIN_GAIN_SHARE * len(points):
            break
        chosen.append(near[best])
        covered += worths[best]
        worths[best] = 0
    return chosen


def probes(camera: Camera, depth: Tensor) -> np.ndarray:
    """(P, 3) float64 points of the world that pixels spread over a view show."""
    rows = np.linspace(0, camera.height - 1, min(PROBES_PER_SIDE, camera.height)).round().astype(int)
    columns = np.linspace(0, camera.width - 1, min(PROBES_PER_SIDE, camera.width)).round().astype(int)
    y, x = (grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij"))
    z = depth.numpy()[y, x].astype(np.float64)
    x, y, z = x[z > 0], y[z > 0], z[z > 0]
    local = np.stack([(x + 0.5 - camera.cx) / camera.fx * z, (y + 0.5 - camera.cy) / camera.fy * z, z], 1)
    pose = camera.world_to_camera.numpy()
    return (local - pose[:3, 3]) @ pose[:3, :3]


def nearby(at: int, depths: Depths, distance: float) -> list[int]:
    """Other views that stand near enough to see what lies at a distance at less than `MAX_RAY_DEGREES`, evenly
    thinned."""
    eye, reach = depths.centres[at], 2 * np.tan(np.radians(MAX_RAY_DEGREES / 2)) * distance
    around = np.array(depths.places.query_ball_point(eye, reach, return_sorted=True), np.int64)
    apart = np.linalg.norm(depths.centres[around] - eye, axis=1)
    found = [int(i) for i in around[np.argsort(apart, kind="stable")] if i != at]
    return found[:: -(-len(found) // MAX_NEARBY_VIEWS)] if found else []


def _worth(points: np.ndarray, eye: np.ndarray, other: Camera, angle: float) -> np.ndarray:
    """(P,) worth of a view for each point."""
    pose = other.world_to_camera.numpy()
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = other.fx * x / z + other.cx, other.fy * y / z + other.cy
        inside = (z > 0) & (u >= 0) & (u < other.width) & (v >= 0) & (v < other.height)
    between = degrees_between(points, eye, other.centre.numpy())
    return np.where(inside & (between < MAX_RAY_DEGREES), worth(between, angle), 0)
