"""What a ray meets first: a triangle, a splat, a point, or the picture of a camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View

ITEMS_PER_CELL = 256
"""Triangles or points that are looked at together, about."""
GRID_PERCENTILES, SAMPLED_PLACES = (1, 99), 100_000
"""Percentiles of about so many places between which the cells lie."""
PICK_FOCAL_PX = 1000.0
"""Pixels: of the picture of a single ray, about that of a window."""
MIN_PICKED_ALPHA = 0.5
"""Of the light that a ray must lose to have met something."""


class TrianglePicker:
    """Triangles that are found quickly: sorted into the cells of a grid, with the bounding box of each cell."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Sort (F, 3) faces of (V, 3) vertices."""
        corners = vertices[faces]
        order, self.starts, self.ends = into_cells(corners.mean(1))
        self.vertices, self.faces = vertices, faces[order]
        self.low = np.minimum.reduceat(corners.min(1)[order], self.starts)
        self.high = np.maximum.reduceat(corners.max(1)[order], self.starts)

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> float | None:
        """How far along a ray the first triangle is, in lengths of `direction`; None if it meets none.

        Both sides of a triangle count. Moeller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
        """
        first, last = through_boxes(origin, direction, self.low, self.high)
        met = np.flatnonzero(first <= last)
        best = np.inf
        for cell in met[np.argsort(first[met])]:
            if first[cell] > best:
                break
            corners = self.vertices[self.faces[self.starts[cell] : self.ends[cell]]].astype(np.float64)
            best = min(best, float(along_triangles(origin, direction, corners).min(initial=np.inf)))
        return best if np.isfinite(best) else None


class PointPicker:
    """Points that are found quickly: sorted like triangles."""

    def __init__(self, xyz: np.ndarray) -> None:
        """Sort (N, 3) points, one at least."""
        order, self.starts, self.ends = into_cells(xyz)
        self.xyz = xyz[order]
        low, high = (pick.reduceat(self.xyz, self.starts).astype(np.float64) for pick in (np.minimum, np.maximum))
        self.middles, self.radii = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2

    def hit(self, origin: np.ndarray, direction: np.ndarray, spread: float) -> float | None:
        """See `hit_points`: the same, without a look at cells that lie beside the cone as a whole."""
        away = self.middles - origin
        along = away @ direction
        beside = np.linalg.norm(away - along[:, None] * direction, axis=1)
        end = along + self.radii
        met = np.flatnonzero((end > 0) & (beside <= spread * end + self.radii * (1 + 1e-6)))  # rounding loses no cell
        if not len(met):
            return None
        rows = np.concatenate([np.arange(self.starts[cell], self.ends[cell]) for cell in met])
        return hit_points(self.xyz[rows], origin, direction, spread)


def into_cells(middles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The order of (N, 3) places by the cells of a grid, and where each cell that has some begins and ends in it."""
    low, high = np.percentile(
        middles[:: max(1, len(middles) // SAMPLED_PLACES)].astype(np.float64), GRID_PERCENTILES, axis=0
    )
    parts = max(1, round(np.sqrt(len(middles) / ITEMS_PER_CELL)))  # a surface fills as many cells as a square has
    cells = (middles - low) / max(float((high - low).max()), 1e-30) * parts
    cells = cells.clip(0, parts - 1).astype(np.int64)  # what lies far away is in the cells at the rim
    keys = (cells[:, 0] * parts + cells[:, 1]) * parts + cells[:, 2]
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    return order, starts, np.append(starts[1:], len(middles))


def through_boxes(
    origin: np.ndarray, direction: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(B,) where a ray enters and leaves boxes with (B, 3) corners; it misses those that it leaves before it enters."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (low - origin) / direction, (high - origin) / direction
    near, far = np.fmin(near, far), np.fmax(near, far)  # NaN: along a side of the box, where the other two decide
    return np.fmax(np.fmax.reduce(near, axis=1), 0.0), np.fmin.reduce(far, axis=1)


def along_triangles(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(T,) how far along a ray it meets each of (T, 3, 3) triangles; inf where it does not."""
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, ac)
    det = np.einsum("tk,tk->t", ab, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = origin - a
        u = np.einsum("tk,tk->t", away, across) / det
        other = np.cross(away, ab)
        v = other @ direction / det
        t = np.einsum("tk,tk->t", ac, other) / det
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(inside, t, np.inf)


def hit_splats(draw: Callable[[View], Maps], origin: np.ndarray, direction: np.ndarray) -> float | None:
    """How far along a ray of length 1 half of the light is lost to splats, as the rasterizer draws it; None if less is.

    It is the median depth of one pixel.
    """
    ahead = torch.from_numpy(np.asarray(direction, np.float64))
    helper = torch.eye(3, dtype=torch.float64)[int(ahead.abs().argmin())]
    right = torch.linalg.cross(helper, ahead)
    right = right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
    pose[:3, 3] = -pose[:3, :3] @ torch.from_numpy(np.asarray(origin, np.float64))
    maps = draw(View("", Camera(pose, PICK_FOCAL_PX, PICK_FOCAL_PX, 0.5, 0.5, 1, 1), Path()))
    found = surface_depth(maps)
    depth = 0.0 if found is None else float(found[0, 0])
    return depth if depth > 0 else None


def surface_depth(maps: Maps) -> Tensor | None:
    """(H, W) z at which half of the light is lost, the mean depth where no median is drawn; 0 where less is lost.

    None if no depth is drawn.
    """
    if maps.median is not None:
        return maps.median
    if maps.depth is None or maps.alpha is None:
        return None
    return torch.where(maps.alpha > MIN_PICKED_ALPHA, maps.expected_depth(), 0.0)


def hit_points(xyz: np.ndarray, origin: np.ndarray, direction: np.ndarray, spread: float) -> float | None:
    """How far along a ray of length 1 the first of (N, 3) points is that lies within a cone about it; None without one.

    Args:
        spread: Radius of the cone at distance 1.
    """
    away = xyz - origin
    along = away @ direction
    beside = np.linalg.norm(away - along[:, None] * direction, axis=1)
    met = along[(along > 0) & (beside <= spread * along)]
    return float(met.min()) if len(met) else None


def corners_of(cameras: Sequence[Camera], size: float) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) centres of cameras, and (V, 4, 3) corners of their pictures as far from them as `size` times the focal
    length is to the longer side: clockwise from the upper left."""
    poses = np.array([camera.world_to_camera.numpy() for camera in cameras]).reshape(-1, 4, 4)
    turns = poses[:, :3, :3].transpose(0, 2, 1)
    centres = -np.einsum("vij,vj->vi", turns, poses[:, :3, 3])
    lens = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras], np.float64).reshape(-1, 6)
    fx, fy, cx, cy, width, height = lens.T
    depth = size * fx / np.maximum(width, height)
    x, y = np.stack([-cx, width - cx, width - cx, -cx], 1), np.stack([-cy, -cy, height - cy, height - cy], 1)
    local = np.stack([x / fx[:, None], y / fy[:, None], np.ones_like(x)], axis=2) * depth[:, None, None]
    return centres, centres[:, None] + np.einsum("vij,vkj->vki", turns, local)


def hit_camera(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> int | None:
    """Which of the pictures with (V, 4, 3) corners a ray meets first; None without one."""
    halves = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    along = along_triangles(origin, direction, halves).reshape(-1, 2).min(1, initial=np.inf)
    return int(along.argmin()) if np.isfinite(along).any() else None
