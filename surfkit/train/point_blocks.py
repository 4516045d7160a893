"""Points in blocks of neighbours, so that a step looks only into blocks that its view can show."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.scene.camera import Camera
from surfkit.scene.morton import morton_order

BLOCK_POINTS = 256
"""Points of a block: those of the rows 256 k to 256 (k + 1)."""
GROUP_BLOCKS = 32
"""Blocks that are looked at together first."""
SORTED_EVERY = 1_000
"""Steps after which points are put in spatial order again; they are after each edit, too."""
ACTIVATED_AT_ONCE = 2**18
"""Points that are activated together where bounds are made of all; whole groups of blocks."""


@dataclass
class PointBlocks:
    """Bounds of blocks of points, and of groups of blocks: they are widened as points move, and made anew in time.

    Attributes:
        blocks: Boxes of B blocks.
        groups: Of each `GROUP_BLOCKS` of them.
        columns: The parameters that they are of; where others have taken their place, they are of no use.
    """

    blocks: SplatBoxes
    groups: SplatBoxes
    columns: Columns

    @classmethod
    @torch.no_grad()
    def of(cls, primitive: Primitive, params: Columns) -> PointBlocks:
        """The blocks of N points, activated some at a time."""
        blocks, groups = [], []
        for begin in range(0, len(params["means"]), ACTIVATED_AT_ONCE):
            some = {name: value[begin : begin + ACTIVATED_AT_ONCE] for name, value in params.items()}
            splats = primitive.activate(some, 0)
            blocks.append(SplatBoxes.of(splats, BLOCK_POINTS))
            groups.append(SplatBoxes.of(splats, BLOCK_POINTS * GROUP_BLOCKS))
        return cls(SplatBoxes.joined(blocks), SplatBoxes.joined(groups), dict(params))

    def are_of(self, params: Columns) -> bool:
        """Whether these are the parameters whose bounds are known."""
        known = self.columns
        return params.keys() == known.keys() and all(params[name] is value for name, value in known.items())

    def rows(self, rasterizer: Rasterizer, camera: Camera, near: float) -> Tensor | None:
        """(C,) int64 in their order: the points of all blocks that a view may show; None where all blocks are.

        What `Rasterizer.in_view` tells of these is what it tells of all.
        """
        count = len(self.columns["means"])
        if self.blocks.low.device.type != "cpu":  # a GPU looks at all blocks sooner than the host hears of some
            shown = rasterizer.boxes_in_view(self.blocks, camera, near)
            return None if shown is None else shown.repeat_interleave(BLOCK_POINTS)[:count].nonzero()[:, 0]
        shown = rasterizer.boxes_in_view(self.groups, camera, near)
        if shown is None:
            return None
        blocks = _members(shown.nonzero()[:, 0], GROUP_BLOCKS, len(self.blocks))
        shown = rasterizer.boxes_in_view(self.blocks.take(blocks), camera, near)
        return _members(blocks if shown is None else blocks[shown], BLOCK_POINTS, count)

    def widen(self, rows: Tensor, splats: Splats) -> None:
        """Take in R points, (R,) rows, as they are now."""
        self.blocks.widen(rows // BLOCK_POINTS, splats)
        self.groups.widen(rows // (BLOCK_POINTS * GROUP_BLOCKS), splats)


def _members(groups: Tensor, size: int, count: int) -> Tensor:
    """(M,) what is in (G,) groups of `size` each, in their order; the last group of `count` may not be full."""
    members = (groups[:, None] * size + torch.arange(size, device=groups.device)).flatten()
    return members[members < count]


def spatial_order(means: Tensor) -> Tensor:
    """(N,) int64 indices that put (N, 3) positions along a Z-order curve: what one view shows then lies together in
    memory, and in blocks."""
    return torch.from_numpy(morton_order(means.detach().cpu().numpy(), cubes=True)).to(means.device)


@torch.no_grad()
def put_in_order(points: Points) -> None:
    """Put points in spatial order, in place."""
    points.rearrange(spatial_order(points.params["means"]))
