"""Points in blocks of neighbours, so that a step looks only into blocks that its view can show."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Rasterizer, SplatBoxes, Splats
from surfkit.scene.camera import Camera
from surfkit.scene.morton import morton_order

BLOCK_POINTS = 256
"""Points of a block: those of the rows 256 k to 256 (k + 1)."""
SORTED_EVERY = 1_000
"""Steps after which points are put in spatial order again; they are after each edit, too."""
ACTIVATED_AT_ONCE = 2**18
"""Points that are activated together where bounds are made of all."""


@dataclass
class PointBlocks:
    """Bounds of each block, which hold all of its points: they are widened as points move, and made anew in time.

    Attributes:
        boxes: B of them.
        columns: The parameters that they are of; where others have taken their place, they are of no use.
    """

    boxes: SplatBoxes
    columns: Columns

    @classmethod
    @torch.no_grad()
    def of(cls, primitive: Primitive, params: Columns) -> PointBlocks:
        """The blocks of N points, activated some at a time."""
        count = len(params["means"])
        parts = []
        for begin in range(0, count, ACTIVATED_AT_ONCE):
            some = {name: value[begin : begin + ACTIVATED_AT_ONCE] for name, value in params.items()}
            parts.append(SplatBoxes.of(primitive.activate(some, 0), BLOCK_POINTS))
        return cls(SplatBoxes.joined(parts), dict(params))

    def are_of(self, params: Columns) -> bool:
        """Whether these are the parameters whose bounds are known."""
        return params.keys() == self.columns.keys() and all(
            params[name] is value for name, value in self.columns.items()
        )

    def rows(self, rasterizer: Rasterizer, camera: Camera, near: float) -> Tensor | None:
        """(C,) int64 in their order: the points of all blocks that a view may show; None where all blocks are.

        What `Rasterizer.in_view` tells of these is what it tells of all.
        """
        shown = rasterizer.boxes_in_view(self.boxes, camera, near)
        if shown is None:
            return None
        blocks = shown.nonzero()[:, 0]
        rows = blocks[:, None] * BLOCK_POINTS + torch.arange(BLOCK_POINTS, device=blocks.device)
        rows = rows.flatten()
        count = len(self.columns["means"])
        return rows[rows < count] if len(blocks) and int(rows[-1]) >= count else rows

    def widen(self, rows: Tensor, splats: Splats) -> None:
        """Take in R points, (R,) rows, as they are now."""
        self.boxes.widen(rows // BLOCK_POINTS, splats)


@torch.no_grad()
def put_in_order(points: Points) -> None:
    """Put points along a Z-order curve, in place: what one view shows then lies together in memory, and in blocks.

    One column after the other is copied, so that no more than one stands twice.
    """
    order = torch.from_numpy(morton_order(points.params["means"].detach().cpu().numpy())).to(
        points.params["means"].device
    )
    for group in (points.params, points.exp_avg, points.exp_avg_sq, points.stats):
        for name in group:
            if name not in points.shared:
                group[name] = group[name][order]
