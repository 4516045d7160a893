"""The order in which photographs are shown, and what may be asked about all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from surfkit.core.lazy import Lazy
from surfkit.densify.base import Contribution
from surfkit.raster.api import Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.camera import Camera
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
    of_view: Callable[[Camera], tuple[Tensor, Splats]] | None = None
    """Gives (R,) the rows that a view may show, and these splats, with others behind them; None draws all. With it,
    `rows` is known."""
    tallies: dict[tuple[float, float], Contribution] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.views)

    def each(self, alpha_power: float, transmittance_power: float) -> Iterator[tuple[Tensor, Tensor]]:
        """See `Views.each`."""
        for shown, amount, count in self.shown(alpha_power, transmittance_power):
            if not isinstance(shown, slice):
                amount, count = (v.new_zeros(self._told(v)).index_copy_(0, shown, v) for v in (amount, count))
            yield amount, count

    def shown(self, alpha_power: float, transmittance_power: float) -> Iterator[tuple[Tensor | slice, Tensor, Tensor]]:
        """For each view, which splats it may show, (R,) indices or a slice, and the two of `each` of these."""
        powers = alpha_power, transmittance_power
        for view in self.views:
            if self.of_view is None:
                amount, count = self.rasterizer.contribution(self.shape, view.camera, self.near, *powers)
                yield slice(None), amount[: self.rows], count[: self.rows]
            else:
                rows, splats = self.of_view(view.camera)
                amount, count = self.rasterizer.contribution(splats, view.camera, self.near, *powers)
                yield rows, amount[: len(rows)].to(rows.device), count[: len(rows)].to(rows.device)

    def contributions(self, alpha_power: float = 0.5, transmittance_power: float = 0.5) -> Contribution:
        """See `Views.contributions`."""
        powers = (alpha_power, transmittance_power)
        if powers not in self.tallies:
            found: Contribution | None = None
            for shown, amount, count in self.shown(*powers):
                found = found or self._nothing(amount)
                here = amount / count.clamp_min(1)
                found.mean[shown] += here
                found.peak[shown] = torch.maximum(found.peak[shown], here)
                found.hits[shown] += count
                found.views[shown] += count > 0
            assert found is not None, "there are views"
            self.tallies[powers] = replace(found, mean=found.mean / len(self.views))
        return self.tallies[powers]

    def leading(self, at: Sequence[int] | None = None) -> Tensor:
        """See `Views.leading`."""
        found: Tensor | None = None
        for view in self.views if at is None else [self.views[i] for i in at]:
            rows, splats = (None, self.shape) if self.of_view is None else self.of_view(view.camera)
            here = self.rasterizer.leading(splats, view.camera, self.near)
            if rows is None:
                here = here[: self.rows]
            else:
                here = here.new_zeros(self._told(here)).index_copy_(0, rows.to(here.device), here[: len(rows)])
            found = here if found is None else found + here
        assert found is not None, "there are views"
        return found

    def _nothing(self, amount: Tensor) -> Contribution:
        """What no view tells, where the amounts of one lie."""
        told = self._told(amount)
        zeros = (amount.new_zeros(told, dtype=kind) for kind in (amount.dtype, amount.dtype, torch.int64, torch.int64))
        return Contribution(*zeros)

    def _told(self, amount: Tensor) -> int:
        """Of how many it tells, given the amounts of a view."""
        return len(amount) if self.rows is None else self.rows
