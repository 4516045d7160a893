"""Which views a block is tuned on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from surfkit.plugin import Assign, BadInput, Cells, CoarseModel
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Assign):
    """The share of the splats in a view that belong to the block."""

    threshold: float = 0.1
    """Smallest share with which a view joins."""

    def __post_init__(self) -> None:
        if not 0 <= self.threshold < 1:
            raise BadInput(f"new-part.threshold is {self.threshold}; it must be 0 or more and below 1")

    def joins(self, sight: CoarseModel, cells: Cells) -> Tensor:
        """See `Assign.joins`."""
        owner = cells.owner(sight.splats.means)
        return self.measure(sight, owner, cells.count) > self.threshold

    def measure(self, sight: CoarseModel, owner: Tensor, count: int) -> Tensor:
        """(V, B) the share of each of `count` blocks in the splats of a view; `owner` is the block of each, (N,)."""
        shares = torch.zeros(len(sight.views), count)
        for at, view in enumerate(sight.views):
            seen = sight.rasterizer.render(sight.splats, view.camera, sight.near, geometry=False).seen
            shares[at] = owner[seen].bincount(minlength=count) / seen.sum().clamp_min(1)
        return shares
