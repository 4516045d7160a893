"""Trimming: what no view shows is not kept."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import StepCount, Steps
from surfkit.densify.base import Prune, Step, Views
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points

RELEASED_TOP = 5


@dataclass(frozen=True)
class Trim(Prune):
    """Drop the points that contribute least to the training views (CityGaussianV2, eq. average contribution)."""

    divides: ClassVar[bool] = True

    ratio: float = 0.025
    """Share of the points that each trim drops."""

    score: Literal["mean", "peak", "sum", "released"] = "mean"
    """Contribution: the mean over pixels and views of alpha^gamma T^(1 - gamma), as in the paper; that of the view
    where it is largest, which spares what few views see, as at the rim of a survey; the sum over pixels and views of
    alpha T, by which pictures change least (on one model, 30 % fewer points cost 4.22, 0.58 and 0.085 dB by these
    three); or the mean of the last records of alpha T over the views in their order, as in the released code."""

    gamma: float = 0.5
    """Power of alpha in a mean or a peak, the rest being that of the transmittance."""

    start: Annotated[int, StepCount(floor=800)] = 1_000
    """First step that may trim; before it, only points that no view sees are dropped, at the first step. Short runs
    keep at least 800, as `adc` has made five edits by then; those of which `until` comes earlier are not trimmed."""

    until: Steps = 15_000
    """Last step that may trim."""

    every: Annotated[int, StepCount(floor=500)] = 500
    """Fewest steps between trims, rounded up to whole epochs unless `whole_epochs` is off, from the first end of an
    epoch after `start`. Short runs keep at least 500: as in long ones, five times the steps between edits of `adc`, as
    what these add must learn before it is judged."""

    whole_epochs: bool = True
    """Trim at ends of epochs only, when all views have taught alike; otherwise at `start` and then at every `every`
    steps, as in the released code."""

    recovery: Annotated[int, StepCount(floor=100)] = 500
    """Steps after a reset of the opacities without a trim, as ranking means nothing then; at least 100. One that falls
    there comes at their end, unless the next is fewer than `every` steps away."""

    def __post_init__(self) -> None:
        if not 0 <= self.ratio < 1:
            raise BadInput(f"prune: trim.ratio is {self.ratio}; it must be 0 or more and below 1")
        if not 0 <= self.gamma <= 1:
            raise BadInput(f"prune: trim.gamma is {self.gamma}; it must lie in 0 to 1")
        if self.every < 1:
            raise BadInput(f"prune: trim.every is {self.every}; it must be 1 or more steps")

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Drop the lowest at the end of some epochs, and the unseen at the beginning."""
        if step.index == 1:
            return Edit(drop=step.views.contributions(self.gamma, 1 - self.gamma).views == 0)
        if not self.is_due(step.index, step.since_reset, len(step.views)):
            return None
        return Edit(drop=lowest(self._scores(step.views), self.ratio))

    def edits(self, steps: int, views: int) -> range:
        """See `Prune.edits`; beside them, the first step drops what no view sees."""
        due = self.trims(views)
        return range(due.start, min(due.stop, steps + 1), due.step)

    def is_due(self, index: int, since_reset: int, views: int) -> bool:
        """Whether step `index` trims, so many steps after the last reset of the opacities."""
        due = self.trims(views)
        if since_reset != self.recovery or index in due or index > self.until:
            return since_reset >= self.recovery and index in due
        was_put_off = any(at in due for at in range(index - self.recovery + 1, index))
        return was_put_off and not any(at in due for at in range(index + 1, index + self.every))

    def trims(self, views: int) -> range:
        """The steps that trim where so many views are an epoch, unless opacities have just been reset."""
        unit = views if self.whole_epochs else 1
        first, period = (-(-steps // unit) * unit for steps in (max(self.start, 1), self.every))
        return range(first, self.until + 1, period)

    def _scores(self, views: Views) -> Tensor:
        if self.score == "released":
            return released_score(views)
        if self.score == "sum":
            return summed(views)
        tally = views.contributions(self.gamma, 1 - self.gamma)
        return tally.peak if self.score == "peak" else tally.mean


def lowest(scores: Tensor, ratio: float) -> Tensor:
    """(N,) bool, the scores up to the one below which a share of all lies; equal ones go together."""
    count = int(ratio * len(scores))
    if count == 0:
        return torch.zeros_like(scores, dtype=torch.bool)
    return scores <= scores.kthvalue(count).values


def summed(views: Views) -> Tensor:
    """(N,) sum over the pixels of all views of alpha T: how much of each point's colour they show in all.

    Over black, the pictures change by that much, summed over pixels, when a point of colour 1 is removed that hides
    none of the others.
    """
    return functools.reduce(torch.add, (amount for amount, _ in views.each(1.0, 1.0)))


def released_score(views: Views) -> Tensor:
    """(N,) mean of the five last records of alpha T over the views in their order, the highest counted twice.

    The list begins with five times the value of the first view, so that later views count for less: the ranking
    depends on the order of the views. Only here to compare with results of the released code.
    """
    top: list[Tensor] = []
    for amount, count in views.each(1.0, 1.0):
        value = amount / (count + 1e-6)
        if not top:
            top = [value] * RELEASED_TOP
        record = value > top[0]
        top = [torch.where(record, new, old) for new, old in zip([value, value, *top[1:-1]], top, strict=True)]
    return torch.stack(top).mean(0)
