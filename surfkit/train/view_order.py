"""The order in which photographs are shown, and what may be asked about all of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from surfkit.core.lazy import Lazy
from surfkit.densify.base import Contribution
from surfkit.raster.api import Rasterizer, Splats
from surfkit.scene.scene import View


@dataclass
class ViewOrder:
    """A new random order of `count` views each time all have been shown.

    Attributes:
        count: Views.
        queue: (count,) int64, the present order.
        at: How many of it have been shown.
    """

    count: int
    queue: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))
    at: int = 0

    def shuffle(self, generator: torch.Generator) -> None:
        """Begin a new order."""
        self.queue, self.at = torch.randperm(self.count, generator=generator), 0

    def next(self, generator: torch.Generator) -> int:
        """The view to show now."""
        if self.at == len(self.queue):
            self.shuffle(generator)
        self.at += 1
        return int(self.queue[self.at - 1])


@dataclass(frozen=True)
class ViewContributions:
    """Answers what policies ask about all training views of the present splats (`densify.base.Views`)."""

    views: Sequence[View]
    rasterizer: Rasterizer
    shape: Lazy[Splats] = Lazy()
    near: float  # type: ignore[misc]  # the splats must be given, which mypy does not see
    rows: int | None = None
    """Of how many of the splats, the first ones, it tells; None for all."""
    tallies: dict[tuple[float, float], Contribution] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.views)

    def each(self, alpha_power: float, transmittance_power: float) -> Iterator[tuple[Tensor, Tensor]]:
        """See `Views.each`."""
        for view in self.views:
            found = self.rasterizer.contribution(self.shape, view.camera, self.near, alpha_power, transmittance_power)
            yield found[0][: self.rows], found[1][: self.rows]

    def contributions(self, alpha_power: float = 0.5, transmittance_power: float = 0.5) -> Contribution:
        """See `Views.contributions`."""
        powers = (alpha_power, transmittance_power)
        if powers not in self.tallies:
            mean = torch.zeros_like(self.shape.opacities[: self.rows])
            peak = torch.zeros_like(mean)
            hits, views = (torch.zeros_like(mean, dtype=torch.int64) for _ in range(2))
            for amount, count in self.each(*powers):
                here = amount / count.clamp_min(1)
                mean += here
                torch.maximum(peak, here, out=peak)
                hits += count
                views += count > 0
            self.tallies[powers] = Contribution(mean / len(self.views), peak, hits, views)
        return self.tallies[powers]
