"""Blocks that are strips."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from surfkit.plugin import BadInput, Cells, CoarseModel, Ground, Partition, SURFELS


@dataclass(frozen=True)
class NewPart(Partition):
    """Strips across the direction in which the cameras spread the most, each with equally many cameras."""

    blocks: int = 2
    """Number of strips."""

    def __post_init__(self) -> None:
        if self.blocks < 1:
            raise BadInput(f"new-part.blocks is {self.blocks}; it must be 1 or more")

    def cells(self, sight: CoarseModel) -> Cells:
        """See `Partition.cells`."""
        ground = Ground.under(sight.centres, sight.splats.means)
        cameras = ground.flat(sight.centres)
        axis = int(cameras.std(0, unbiased=False).argmax())
        sorted_places = cameras[:, axis].sort().values
        at = [len(sorted_places) * part // self.blocks for part in range(1, self.blocks)]
        borders = sorted_places[torch.tensor(at, dtype=torch.int64)].tolist()
        if len(set(borders)) < len(borders) or 0 in at:
            raise BadInput(f"partition: {len(cameras)} cameras are too few for {self.blocks} strips; use fewer")
        ends = [None, *borders, None]
        pairs = list(zip(ends[:-1], ends[1:], strict=True))
        boxes = tuple((low, None, high, None) if axis == 0 else (None, low, None, high) for low, high in pairs)
        return Cells(ground, boxes, tuple(range(self.blocks)))


CHANGE: Mapping[str, Any] = {"partition": NewPart(), "tune": SURFELS.pretrain}
"""What puts the part into a recipe, by dotted path: blocks are optimised as the whole scene was before."""
