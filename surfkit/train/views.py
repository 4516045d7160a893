"""The order in which photographs are shown, and what may be asked about all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from surfkit.raster.api import Rasterizer, Splats
from surfkit.scene.scene import View


@dataclass
class Order:
    """A new random order of `count` views each time all have been shown.

    Attributes:
        count: Views.
        queue: (count,) int64, the present order.
        at: How many of it have been shown.
    """

    count: int
    queue: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))
    at: int = 0

    def next(self, generator: torch.Generator) -> int:
        """The view to show now."""
        if self.at == len(self.queue):
            self.queue, self.at = torch.randperm(self.count, generator=generator), 0
        self.at += 1
        return int(self.queue[self.at - 1])


@dataclass(frozen=True)
class Survey:
    """Answers what policies ask about all training views of the present splats (`densify.base.Views`)."""

    views: Sequence[View]
    rasterizer: Rasterizer
    shape: Splats
    near: float

    def contribution(self, gamma: float) -> Tensor:
        """(N,) see `Views.contribution`."""
        total = torch.zeros_like(self.shape.opacities)
        for view in self.views:
            amount, count = self.rasterizer.contribution(self.shape, view.camera, self.near, gamma, 1 - gamma)
            total += amount / count.clamp_min(1)
        return total / len(self.views)
