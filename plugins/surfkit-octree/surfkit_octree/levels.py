"""The levels of detail of anchors: voxels of an octree, and which anchors a camera at a distance needs (Octree-GS)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.plugin import Camera, Columns

TABLE = "lod"
"""The shared parameter that holds a `LevelTable`; nothing trains it."""
MOST_LEVELS = 12


@dataclass(frozen=True)
class LevelTable:
    """What the levels of a model are, common to all of its anchors.

    Attributes:
        distance: Distance to the camera up to which, about, level 0 is enough; local units.
        count: Levels, 1 or more; level 0 is the coarsest.
        active: Levels that are drawn, 1 to `count`, fewer than `count` while training goes from coarse to fine; 0
            before training, where all are drawn.
        voxel: Side of a voxel of level 0, local units.
        fork: Sides of voxels shrink by this factor from level to level.
    """

    distance: float
    count: int
    active: int
    voxel: float
    fork: float

    @classmethod
    def of(cls, stored: Tensor) -> LevelTable:
        """From the numbers of the shared parameter."""
        distance, count, active, voxel, fork = stored.detach().double().tolist()
        return cls(distance, round(count), round(active), voxel, fork)

    @property
    def drawn(self) -> int:
        """How many levels are drawn, 1 or more."""
        return self.active or self.count

    def stored(self) -> Tensor:
        """(5,) float32, the numbers of the shared parameter."""
        return torch.tensor([self.distance, self.count, self.active, self.voxel, self.fork], dtype=torch.float32)

    def finest_drawn(self, distance: Tensor, extra: Tensor) -> Tensor:
        """(N,) int64, the finest level that is drawn at (N,) distances, for anchors with (N,) extra levels.

        round(log(standard distance / distance) / log(fork) + extra), within the active levels (Octree-GS, section 4.2).
        """
        wanted = torch.log(self.distance / distance.clamp_min(1e-12)) / math.log(self.fork) + extra
        return wanted.round().clamp(0, self.drawn - 1).to(torch.int64)

    def is_drawn(self, means: Tensor, level: Tensor, extra: Tensor, camera: Camera) -> Tensor:
        """(N,) bool, the anchors at (N, 3) positions of (N,) levels that a camera needs, wherever it looks."""
        distance = (means - camera.centre.to(means)).norm(dim=-1)
        return level <= self.finest_drawn(distance, extra)

    def side(self, level: Tensor) -> Tensor:
        """(N,) sides of the voxels of (N,) levels, local units."""
        return self.voxel / self.fork ** level.float()


def level_count(nearest: float, farthest: float, fork: float) -> int:
    """round(log(farthest / nearest) / log(fork)) + 1 levels for a range of view distances, MOST_LEVELS at most."""
    return min(MOST_LEVELS, max(1, round(math.log(max(farthest / nearest, 1.0)) / math.log(fork)) + 1))


def view_distances(points: Tensor, cameras: Sequence[Camera], ratio: float) -> tuple[float, float]:
    """Nearest and farthest distance from cameras to the (N, 3) points that they show, local units.

    Of each camera, and then of all cameras, a share of 1 - `ratio` of the values at either end does not count.
    """
    near, far = [], []
    for camera in cameras:
        distance = (points - camera.centre.to(points)).norm(dim=-1)[is_in_view(points, 0.0, camera, 0.0)]
        if len(distance):
            near.append(distance.quantile(1 - ratio))
            far.append(distance.quantile(ratio))
    if not near:
        return 1.0, 1.0
    least, most = torch.stack(near).quantile(1 - ratio), torch.stack(far).quantile(ratio)
    return max(1e-6, float(least)), max(1e-6, float(most))


def is_in_view(means: Tensor, reach: Tensor | float, camera: Camera, near: float, pixels: float = 2.0) -> Tensor:
    """(N,) bool, whether balls of (N,) radii around (N, 3) positions may touch the picture, `pixels` wider."""
    pose = camera.world_to_camera.to(means)
    local = means @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = local.unbind(-1)
    inside = z + reach > near
    for along, focal, centre, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        for sign, room in ((1.0, centre + pixels), (-1.0, size - centre + pixels)):
            inside &= sign * focal * along + room * z > -reach * math.hypot(focal, room)
    return inside


def voxels(positions: Tensor, side: Tensor | float) -> Tensor:
    """(M, 3) int64, the voxels that (M, 3) positions lie in; `side` of one for all, or (M,)."""
    each = side[:, None] if isinstance(side, Tensor) else side
    return torch.floor(positions.double() / each).to(torch.int64)


def centres(keys: Tensor, side: Tensor | float) -> Tensor:
    """(M, 3) float32 centres of voxels."""
    each = side[:, None] if isinstance(side, Tensor) else side
    return ((keys.double() + 0.5) * each).float()


@dataclass(frozen=True)
class Census:
    """How many anchors a view uses.

    Attributes:
        distance: Mean distance from the camera to the anchors in view, local units.
        in_view: Anchors of all levels in view.
        used: Those that are drawn.
        by_level: Those that are drawn, of each level.
    """

    distance: float
    in_view: int
    used: int
    by_level: tuple[int, ...]


def census(params: Columns, camera: Camera) -> Census:
    """The anchors that a camera uses, of all raw parameters of a model."""
    table, means, level = LevelTable.of(params[TABLE]), params["means"], params["level"]
    inside = is_in_view(means, 0.0, camera, 0.0)
    drawn = inside & table.is_drawn(means, level, params["extra"], camera)
    distance = (means[inside] - camera.centre.to(means)).norm(dim=-1)
    counts = torch.bincount(level[drawn].round().to(torch.int64), minlength=table.count)
    return Census(
        float(distance.mean()) if len(distance) else 0.0, len(distance), int(drawn.sum()), tuple(counts.tolist())
    )
