"""Surfaces that close the space which trusted depth sees into (after space carving, Kutulakos and Seitz 2000).

Where photographs do not agree on a depth, as in alleys, something is known all the same: trusted depth maps see through
the space around. What they neither see nor see through takes the state of what lies above it: below free space it is
free, down to the ground, and below a roof it is not. The border between both is where walls go on, and the ground lies.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.raster.native import module
from surfkit.scene.camera import Camera

MAX_GRID_VOXELS = 1 << 27
"""Voxels of a grid; those of a larger scene are made larger."""
GRID_QUANTILES = np.array([[0.03, 0.03, 0.002], [0.97, 0.97, 0.998]])
"""Shares of the points up to which the grid reaches along each axis: few views see the rim of a scene."""
GRID_MARGIN_VOXELS = 8
"""Voxels around those points."""
OWN_SURFACE_VOXELS, SEEN_THROUGH_VOXELS = 0.8, 1.6
"""Voxels around the middle of one in which a surface counts as its own, and behind it from which it is seen through."""
MIN_SOLID_VIEWS, MIN_GROUND_VIEWS = 2, 6
"""Views that see a surface in a voxel, from which it is solid, and from which the ground may be there."""
CELL_VOXELS, NEIGHBOURHOOD_CELLS = 8, 5
"""Voxels along a cell, of whose columns the lowest 5 % tell the ground, and cells around in which it is the lowest."""
NORMAL_REACH_VOXELS = 2
"""Voxels around one that tell which way a surface faces, as in cpu/carve.cpp."""
NOWHERE = 1 << 20


@dataclass(frozen=True)
class CarvingGrid:
    """Voxels, the last of whose axes is up.

    Attributes:
        origin: (3,) local position of the middle of the first voxel.
        axes: (3, 3) unit vectors in rows.
        side: Of a voxel, local units.
        size: Voxels along each axis.
    """

    origin: np.ndarray
    axes: np.ndarray
    side: float
    size: tuple[int, int, int]

    @classmethod
    def around(cls, points: np.ndarray, axes: np.ndarray, side: float, most: int = MAX_GRID_VOXELS) -> CarvingGrid:
        """The grid that holds nearly all of (N, 3) points; with larger voxels where there would be more than `most`."""
        placed = points @ axes.T
        low, high = np.stack([np.quantile(placed[:, i], GRID_QUANTILES[:, i]) for i in range(3)], 1)

        def sizes(side: float) -> np.ndarray:
            return np.ceil((high - low) / side).astype(np.int64) + 1 + 2 * GRID_MARGIN_VOXELS

        while np.prod(sizes(side).astype(float)) > most:
            side *= 1.02
        size = tuple(int(n) for n in sizes(side))
        return cls(axes.T @ (low - GRID_MARGIN_VOXELS * side), axes, side, (size[0], size[1], size[2]))

    def voxels_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(3, M) voxels that (M, 3) points lie in, or nearest to those outside; and (M,) bool, inside of the grid."""
        at = np.rint((points - self.origin) @ self.axes.T / self.side).astype(np.int64)
        nearest = at.clip(0, np.array(self.size) - 1)
        return nearest.T, (at == nearest).all(1)

    def pose(self, camera: Camera) -> np.ndarray:
        """(3, 4) from (i, j, k, 1) of a voxel to the camera's axes, in voxels."""
        pose = camera.world_to_camera.numpy()
        shift = pose[:3, :3] @ self.origin + pose[:3, 3]
        return np.concatenate([pose[:3, :3] @ self.axes.T, shift[:, None] / self.side], 1)


@dataclass(frozen=True)
class Votes:
    """What trusted depth maps say of each voxel.

    Attributes:
        surfaces: (X, Y, Z) uint8 views that see a surface there, 255 at most.
        through: (X, Y, Z) uint8 views that see through it.
    """

    surfaces: np.ndarray
    through: np.ndarray


def votes(grid: CarvingGrid, maps: Iterable[tuple[Camera, Tensor]]) -> Votes:
    """What depth maps say of each voxel.

    Args:
        grid: Of the voxels.
        maps: Cameras, and (H, W) depths along their axes, local units, 0 where they are not trusted.
    """
    found = Votes(np.zeros(grid.size, np.uint8), np.zeros(grid.size, np.uint8))
    for camera, depth in maps:
        scaled = np.ascontiguousarray((depth / grid.side).numpy(), np.float32)
        lens, pose = [camera.fx, camera.fy, camera.cx, camera.cy], grid.pose(camera)
        if (native := module()) is None:
            vote(found, scaled, lens, pose)
        else:
            low, high = reach(grid, camera, pose, float(scaled.max(initial=0)))
            way = [*pose.ravel().tolist(), OWN_SURFACE_VOXELS, SEEN_THROUGH_VOXELS]
            native.carve(found.surfaces, found.through, scaled, lens, way, low, high, torch.get_num_threads())
    return found


def reach(grid: CarvingGrid, camera: Camera, pose: np.ndarray, depth: float) -> tuple[list[int], list[int]]:
    """Columns that a camera may see up to a depth in voxels, along both axes on the ground: the first, and the end."""
    x, y = np.array([0, camera.width]), np.array([0, camera.height])
    rays = [[(a - camera.cx) / camera.fx, (b - camera.cy) / camera.fy, 1] for a in x for b in y]
    corners = (np.array([[0, 0, 0], *rays]) * depth - pose[:, 3]) @ pose[:, :3]
    ends = np.stack([np.floor(corners.min(0)), np.ceil(corners.max(0)) + 1])[:, :2]
    low, high = ends.clip(0, grid.size[:2]).astype(int).tolist()
    return low, high


def vote(found: Votes, depth: np.ndarray, lens: list[float], pose: np.ndarray) -> None:
    """Add one view in numpy, a layer of voxels at a time: what cpu/carve.cpp does."""
    fx, fy, cx, cy = lens
    height, width = depth.shape
    j, k = np.meshgrid(*(np.arange(n) for n in found.surfaces.shape[1:]), indexing="ij")
    for i in range(len(found.surfaces)):
        x, y, z = (row[0] * i + row[1] * j + row[2] * k + row[3] for row in pose)
        u, v = fx * x + cx * z, fy * y + cy * z
        inside = (z >= 1) & (u >= 0) & (v >= 0) & (u <= width * z) & (v <= height * z)
        at = [np.where(inside, value / np.where(inside, z, 1), 0).astype(int) for value in (v, u)]
        seen = depth[at[0].clip(0, height - 1), at[1].clip(0, width - 1)].astype(np.float64)
        known = inside & (seen > 0)
        through = known & (seen > z + SEEN_THROUGH_VOXELS)
        for counts, more in (
            (found.through[i], through),
            (found.surfaces[i], known & (abs(seen - z) <= OWN_SURFACE_VOXELS)),
        ):
            counts += more & (counts < 255)


def solid_of(found: Votes) -> np.ndarray:
    """(X, Y, Z) uint8, 1 where voxels are solid: see the head of this file."""
    ground, height = ground_of(found), np.arange(found.surfaces.shape[2])
    solid = np.empty(found.surfaces.shape, np.uint8)
    for i, (surfaces, through) in enumerate(zip(found.surfaces, found.through, strict=True)):
        free = (through > 0) & (through > surfaces)
        filled = (~free & (surfaces >= MIN_SOLID_VIEWS)) | (height < ground[i][:, None])
        nearest = np.where(free | filled, height, NOWHERE)  # known place at or above
        nearest = np.minimum.accumulate(nearest[:, ::-1], axis=1)[:, ::-1]
        rows = np.arange(len(free))[:, None]
        solid[i] = np.where(nearest < NOWHERE, filled[rows, nearest.clip(0, len(height) - 1)], False)
    return solid


def ground_of(found: Votes) -> np.ndarray:
    """(X, Y) number of the lowest voxel above the ground: the lowest surface around that many views see."""
    from scipy.ndimage import gaussian_filter, minimum_filter, zoom

    lowest: np.ndarray = np.full(found.surfaces.shape[:2], NOWHERE)
    for i, (surfaces, through) in enumerate(zip(found.surfaces, found.through, strict=True)):
        sure = (surfaces >= MIN_GROUND_VIEWS) & (surfaces > through)
        lowest[i] = np.where(sure.any(1), sure.argmax(1), NOWHERE)
    over = [-n % CELL_VOXELS for n in lowest.shape]
    padded = np.pad(lowest, [(0, n) for n in over], mode="edge")
    cells = padded.reshape(padded.shape[0] // CELL_VOXELS, CELL_VOXELS, -1, CELL_VOXELS).transpose(0, 2, 1, 3)
    low = np.percentile(cells.reshape(*cells.shape[:2], -1), 5, axis=2, method="lower")
    low = minimum_filter(low, size=2 * NEIGHBOURHOOD_CELLS + 1)
    low = gaussian_filter(np.where(low < NOWHERE, low, 0).astype(np.float64), 1.0)
    return zoom(low, CELL_VOXELS, order=1, grid_mode=True, mode="nearest")[: lowest.shape[0], : lowest.shape[1]]


def meet(grid: CarvingGrid, solid: np.ndarray, camera: Camera, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays of a camera first meet a solid voxel.

    Args:
        grid: Of the voxels.
        solid: (X, Y, Z) uint8.
        camera: Of the rays.
        rays: (M, 3) in its axes, z = 1.

    Returns:
        (M,) depth along the axis of the camera, local units, 0 where there is none; (M, 3) unit normals in the local
        frame away from the solid, 0 where there is none.
    """
    pose = grid.pose(camera)
    turn = pose[:, :3]
    start, ways = -turn.T @ pose[:, 3], np.ascontiguousarray(rays @ turn, np.float32)
    lengths, outward = np.zeros(len(rays), np.float32), np.zeros((len(rays), 3), np.float32)
    if (native := module()) is None:
        march(solid, start, ways, lengths, outward)
    else:
        native.meet(solid, start.tolist(), ways, lengths, outward, torch.get_num_threads())
    normals = outward @ grid.axes
    return lengths * grid.side, normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-6)


def march(solid: np.ndarray, start: np.ndarray, ways: np.ndarray, lengths: np.ndarray, outward: np.ndarray) -> None:
    """The same for rays in voxels, in numpy, all rays a step at a time: what cpu/carve.cpp does."""
    ways, size = ways.astype(np.float64), np.array(solid.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(-0.5 - start) / ways, (size - 0.5 - start) / ways])
    low, high = np.nanmin(ends, 0).max(1).clip(0), np.nanmax(ends, 0).min(1)
    step = 0.5 / np.linalg.norm(ways, axis=1)
    t, on = low + step / 2, np.arange(len(ways))
    while len(on := on[t[on] <= high[on]]):
        at = np.rint(start + t[on, None] * ways[on]).astype(int).clip(0, size - 1)
        met = solid[tuple(at.T)] > 0
        lengths[on[met]] = t[on[met]]
        for ray, c in zip(on[met], at[met], strict=True):
            low_c, high_c = (c - NORMAL_REACH_VOXELS).clip(0), np.minimum(c + NORMAL_REACH_VOXELS + 1, size)
            around = np.argwhere(solid[tuple(slice(a, b) for a, b in zip(low_c, high_c, strict=True))])
            outward[ray] = -(around + low_c - c).sum(0)
        on = on[~met]
        t[on] += step[on]
