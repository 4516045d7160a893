"""How many photographs really show each point of a cloud: nearer points of the same cloud hide those behind them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surfkit.core.events import Progress, emit
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View

DEPTH_LONGEST_PX = 800
"""Of the depth maps, whatever size was trained on: the volume depends on the cameras alone."""
SQUARE_GAPS = 2.0
"""A point covers a square of this many gaps between points: of points strewn at random, 2 % leave a hole then."""
MAX_WIDTHS_BEHIND = 3.0
"""Widths of such a square, or of a pixel, by which a point may lie behind the nearest one and still be seen: surfaces
that are turned away by up to 63 degrees hide nothing of themselves."""
SQUARE_SIDES_PX = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024])
"""Of the squares, pixels."""


def visible_counts(points: np.ndarray, views: Sequence[View], frame: Frame, gap: float) -> np.ndarray:
    """(n,) int32: in how many views each point lies in the picture and is not hidden.

    Each point fills a square of a depth map, larger where it is near; a point is hidden in a view if it lies further
    than the map by more than a slanted surface would.

    Args:
        points: (n, 3) float64 input frame.
        views: With cameras in the local frame.
        frame: Of the views.
        gap: Between points of a surface, input units: 1 / sqrt(points per area).
    """
    counts = np.zeros(len(points), np.int32)
    for done, view in enumerate(views, 1):
        camera = view.camera.sized(DEPTH_LONGEST_PX)
        at, seen = visible(points, camera, frame.input_pose(camera.world_to_camera), gap)
        counts[at[seen]] += 1
        emit(Progress("counting the views of each point", done, len(views)))
    return counts


def visible(points: np.ndarray, camera: Camera, pose: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Which points lie in the picture, (k,) rows, and which of these are not hidden, (k,) bool.

    Args:
        points: (n, 3) float64.
        camera: Lens and size; its pose does not count.
        pose: (4, 4) world_to_camera in the frame and units of the points.
        gap: Between points of a surface.
    """
    depth, spots = cloud_depth(points, camera, pose, gap)
    return spots[0], not_hidden(depth, spots, gap, camera)


def cloud_depth(
    points: np.ndarray, camera: Camera, pose: np.ndarray, gap: float
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """(H, W) depth of the nearest point at each pixel, inf where there is none, and what `project` says of them."""
    spots = project(points, camera, pose)
    _, x, y, z = spots
    side = sides(SQUARE_GAPS * gap * max(camera.fx, camera.fy) / z)
    return nearest_rows(x, y, z, side, (camera.height, camera.width))[0], spots


def not_hidden(depth: np.ndarray, spots: tuple[np.ndarray, ...], gap: float, camera: Camera) -> np.ndarray:
    """(k,) bool: which points in the picture lie no further behind a depth map than a slanted surface would.

    Args:
        depth: (H, W) of `cloud_depth`, of these points or of others.
        spots: Of `project`.
        gap: Between the points that the map was made of.
        camera: Of the map.
    """
    _, x, y, z = spots
    return z <= depth[y, x] + MAX_WIDTHS_BEHIND * np.maximum(SQUARE_GAPS * gap, z / max(camera.fx, camera.fy))


def sides(cover_px: np.ndarray) -> np.ndarray:
    """(n,) int64 sides of squares that are at least (n,) `cover_px` wide, or as wide as squares get."""
    return SQUARE_SIDES_PX[np.searchsorted(SQUARE_SIDES_PX, cover_px).clip(max=len(SQUARE_SIDES_PX) - 1)]


def project(points: np.ndarray, camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rows, columns, lines and depths of the points in the picture."""
    z = points @ pose[2, :3] + pose[2, 3]
    at = np.flatnonzero(z > 0)
    z, rest = z[at], points[at]
    x = np.floor(camera.fx * (rest @ pose[0, :3] + pose[0, 3]) / z + camera.cx)
    y = np.floor(camera.fy * (rest @ pose[1, :3] + pose[1, 3]) / z + camera.cy)
    inside = np.flatnonzero((x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
    return at[inside], x[inside].astype(np.int64), y[inside].astype(np.int64), z[inside]


def nearest_rows(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, side: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest point at each pixel where every point fills that square of a chequered picture which it lies in.

    Args:
        x: (n,) columns.
        y: (n,) lines.
        z: (n,) depths.
        side: (n,) of the squares, pixels.
        size: H and W.

    Returns:
        (H, W) depths, inf where there is no point, and (H, W) rows of the points, -1 there.
    """
    height, width = size
    depth, rows = np.full(size, np.inf), np.full(size, -1)
    for step in np.unique(side):
        chosen = np.flatnonzero(side == step)
        wide, high = -(-width // step), -(-height // step)
        cell = (y[chosen] // step) * wide + x[chosen] // step
        near, row = np.full(high * wide, np.inf), np.full(high * wide, -1)
        np.minimum.at(near, cell, z[chosen])
        first = z[chosen] == near[cell]
        row[cell[first]] = chosen[first]
        near, row = (_spread(values.reshape(high, wide), step, size) for values in (near, row))
        rows = np.where(near < depth, row, rows)
        depth = np.minimum(depth, near)
    return depth, rows


def _spread(values: np.ndarray, times: int, size: tuple[int, int]) -> np.ndarray:
    """(H, W) with each value filling a square of `times` pixels."""
    if times > 1:
        values = values.repeat(times, axis=0)[: size[0]].repeat(times, axis=1)
    return values[: size[0], : size[1]]
