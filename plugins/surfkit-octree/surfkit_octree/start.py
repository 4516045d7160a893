"""Where the anchors of a run begin: the centres of the voxels that hold sparse points, of each level."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.plugin import BadInput, InitialModel, Primitive, SparsePoints, Start, StartInput
from surfkit.primitives.init import gaps
from surfkit_octree.anchors import Anchors
from surfkit_octree.levels import MOST_LEVELS, TABLE, LevelTable, centres, level_count, view_distances, voxels

MOST_LOOKED_AT = 50_000
"""Sparse points that decide about distances."""


@dataclass(frozen=True)
class AnchorVoxels(Start):
    """Start from anchors at the centres of the voxels that hold sparse points, with as many levels as the range of view
    distances asks for (Octree-GS); levels 1 is one size of voxels (Scaffold-GS)."""

    levels: int = 0
    """Levels of detail, from 1; 0 takes log(farthest / nearest view distance) / log(fork) + 1 of them."""

    voxel: float = 0.0
    """Side of the voxels of the middle level, as a share of the scene extent; 0 takes the median distance between
    sparse points."""

    fork: float = 2.0
    """Sides of voxels shrink by this factor from level to level."""

    dist_ratio: float = 0.999
    """Share of the view distances, and of the cameras, up to which distances count for nearest and farthest."""

    def __post_init__(self) -> None:
        if not 0 <= self.levels <= MOST_LEVELS:
            raise BadInput(
                f"start.levels is {self.levels}; it must be 0 (from the view distances) or 1 to {MOST_LEVELS}"
            )
        if self.voxel < 0 or self.fork <= 1 or not 0.5 < self.dist_ratio <= 1:
            raise BadInput(
                f"start: voxel is {self.voxel:g} (0 or more), fork {self.fork:g} (above 1) and dist_ratio "
                f"{self.dist_ratio:g} (above 0.5, up to 1); these do not fit"
            )

    def table(self, known: StartInput) -> LevelTable:
        """The levels that fit a scene."""
        xyz = known.scene.cloud.xyz.float()
        if not len(xyz):
            raise BadInput("the scene has no sparse points to start from; triangulate some (COLMAP point_triangulator)")
        some = xyz[:: max(1, len(xyz) // MOST_LOOKED_AT)]
        cameras = [view.camera for view in known.scene.train]
        nearest, farthest = view_distances(some, cameras, self.dist_ratio)
        count = self.levels or level_count(nearest, farthest, self.fork)
        middle = self.voxel or float(gaps(xyz).median())
        return LevelTable(farthest, count, 0, middle * self.fork ** (count // 2), self.fork)

    def anchors(self, known: StartInput) -> tuple[SparsePoints, Tensor, LevelTable]:
        """The places of the anchors, their (N,) int64 levels, and the table of levels.

        Anchors of a level that no training camera would draw are left out.
        """
        table = LevelTable.of(self.table(known).stored())  # as it will be read again
        xyz, rgb = known.scene.cloud.xyz.float(), known.scene.cloud.rgb
        places, colours, levels = [], [], []
        for level in range(table.count):
            side = table.voxel / table.fork**level
            keys, back = torch.unique(voxels(xyz, side), dim=0, return_inverse=True)
            first = torch.full((len(keys),), len(xyz)).scatter_reduce(0, back, torch.arange(len(xyz)), "amin")
            place = centres(keys, side)
            of = torch.full((len(place),), level)
            drawn = torch.full((len(place),), level == 0)
            for view in known.scene.train if level else ():
                drawn |= table.is_drawn(place, of, torch.zeros(len(place)), view.camera)
            places.append(place[drawn])
            colours.append(rgb[first[drawn]])
            levels.append(of[drawn])
        of_point = torch.cat(levels)
        return SparsePoints(torch.cat(places), torch.cat(colours), size=table.side(of_point)), of_point, table

    def cloud(self, known: StartInput) -> SparsePoints:
        """See `Start.cloud`."""
        return self.anchors(known)[0]

    def model(self, primitive: Primitive, known: StartInput, generator: torch.Generator) -> InitialModel:
        """See `Start.model`; other primitives than anchors begin at the same points, without levels."""
        cloud, level, table = self.anchors(known)
        begun = primitive.init(cloud, generator)
        if not isinstance(primitive, Anchors):
            return InitialModel(begun)
        return InitialModel(begun | {"level": level.float(), TABLE: table.stored()})

    def expected(self, sparse: int, pixels: int) -> int:
        """See `Start.expected`."""
        return sparse * max(1, self.levels)
