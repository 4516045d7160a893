"""A policy that copies the points with the largest gradients."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from surfkit.plugin import BadInput, Densify, Edit, Interval, Points, Step

SUM, COUNT = "new-part/sum", "new-part/count"
"""Statistics of the points; they are saved and follow every edit."""


@dataclass(frozen=True)
class NewPart(Densify):
    """Copy a share of the points, those with the largest mean gradient since the last edit."""

    share: float = 0.05
    """Of the points, that is copied at an edit."""

    start: Interval = 500
    """Steps before the first edit."""

    until: Interval = 15_000
    """Last step that may edit."""

    every: Interval = 100
    """Steps between edits."""

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1 or self.every < 1:
            raise BadInput(f"new-part.share {self.share}, every {self.every}: give 0 to 1, and 1 or more")

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        first = self.every * (self.start // self.every + 1)
        return range(first, min(self.until, steps) + 1, self.every)

    def watch(self, points: Points, step: Step) -> None:
        """Sum up the gradients of the points that were seen, anew after each edit; `edit` itself changes nothing."""
        if step.index - 1 in self.edits(step.steps):
            for name in (SUM, COUNT):
                points.stat(name).zero_()
        step.shown.add(points.stat(SUM), step.shown.grad_norm)
        step.shown.add(points.stat(COUNT), step.shown.seen)

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Copy the points, every so many steps."""
        if step.index not in self.edits(step.steps):
            return None
        mean = points.stat(SUM) / points.stat(COUNT).clamp_min(1)
        mean = mean * step.may_be_densified()
        largest = mean.topk(max(1, int(self.share * len(points)))).indices
        return Edit(clone=torch.zeros_like(mean, dtype=torch.bool).index_fill(0, largest, True) & (mean > 0))


CHANGE: Mapping[str, Any] = {"pretrain.densify": NewPart()}
"""What puts the part into a recipe, by dotted path."""
