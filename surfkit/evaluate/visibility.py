"""How many photographs really show each point of a cloud: nearer points of the same cloud hide those behind them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surfkit.core.events import Progress, emit
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View

LONGEST_PX = 800
"""Of the depth maps; larger photographs are looked at in this size."""
COVER = 1.5
"""A point covers a square of this many spacings: neighbours on a surface then leave no hole between them."""
BEHIND = 2.0
"""Widths of such a square by which a point may lie behind the nearest one in it and still be seen: surfaces that are
turned away by up to 63 degrees hide nothing of themselves."""


def visible_counts(points: np.ndarray, views: Sequence[View], frame: Frame, spacing: float) -> np.ndarray:
    """(n,) int32: in how many views each point lies in the picture and is not hidden.

    Each point fills a square of a depth map, larger where it is near; a point is hidden in a view if it lies further
    than the map by more than a slanted surface would.

    Args:
        points: (n, 3) float64 input frame.
        views: With cameras in the local frame.
        frame: Of the views.
        spacing: Between neighbouring points, input units.
    """
    counts = np.zeros(len(points), np.int32)
    for done, view in enumerate(views, 1):
        camera = view.camera.fitted(LONGEST_PX)
        at, seen = visible(points, camera, frame.input_pose(camera.world_to_camera), spacing)
        counts[at[seen]] += 1
        emit(Progress("counting the views of each point", done, len(views)))
    return counts


def visible(points: np.ndarray, camera: Camera, pose: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Which points lie in the picture, (k,) rows, and which of these are not hidden, (k,) bool.

    Args:
        points: (n, 3) float64.
        camera: Lens and size; its pose does not count.
        pose: (4, 4) world_to_camera in the frame and units of the points.
        spacing: Between neighbouring points.
    """
    at, x, y, z = _pictured(points, camera, pose)
    cover_px = COVER * spacing * max(camera.fx, camera.fy) / z
    level = np.ceil(np.log2(cover_px.clip(min=1))).astype(np.int64)
    level = level.clip(max=max(camera.width, camera.height).bit_length())
    depth = _depth_map(x, y, z, level, (camera.height, camera.width))
    square = 2.0**level * z / min(camera.fx, camera.fy)
    return at, z <= depth[y, x] + BEHIND * square


def _pictured(points: np.ndarray, camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rows, columns, lines and depths of the points in the picture."""
    z = points @ pose[2, :3] + pose[2, 3]
    at = np.flatnonzero(z > 0)
    z, rest = z[at], points[at]
    x = np.floor(camera.fx * (rest @ pose[0, :3] + pose[0, 3]) / z + camera.cx)
    y = np.floor(camera.fy * (rest @ pose[1, :3] + pose[1, 3]) / z + camera.cy)
    inside = np.flatnonzero((x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
    return at[inside], x[inside].astype(np.int64), y[inside].astype(np.int64), z[inside]


def _depth_map(x: np.ndarray, y: np.ndarray, z: np.ndarray, level: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) nearest depth, inf where there is none; points of level l fill squares of 2^l pixels."""
    height, width = size
    result = np.full(size, np.inf)
    for step in np.unique(level):
        chosen = level == step
        wide = (width >> step) + 1
        coarse = np.full(((height >> step) + 1) * wide, np.inf)
        np.minimum.at(coarse, (y[chosen] >> step) * wide + (x[chosen] >> step), z[chosen])
        fine = coarse.reshape(-1, wide)
        if step:
            fine = fine.repeat(1 << step, axis=0)[:height].repeat(1 << step, axis=1)[:, :width]
        np.minimum(result, fine[:height, :width], out=result)
    return result
