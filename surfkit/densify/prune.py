"""Other ways to remove points: by importance, and by opacity."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import StepCount, Steps
from surfkit.densify.base import Prune, Step, Views
from surfkit.densify.trim import lowest
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points
from surfkit.raster.api import Splats


@dataclass(frozen=True)
class PruneByImportance(Prune):
    """Drop the points of least importance (LightGaussian, Fan et al. 2023).

    Importance is opacity, times how much the pixels show that a point hits, times a power of the volume.
    """

    divides: ClassVar[bool] = True

    at: tuple[Steps, ...] = (15_000,)
    """Steps after which to prune; 0 is at once, after the first."""

    ratio: float = 0.66
    """Share of the points that is dropped."""

    power: float = 0.1
    """Of the normalised volume, or of a surfel's area; beta in the paper."""

    score: Literal["hits", "significance"] = "hits"
    """What opacity and volume are multiplied by: the number of pixels hit, the volume over that at the 90th percentile
    from the top, as in the released code; or the sum over these pixels of the transmittance in front of the point, the
    volume over that at the 90th percentile from the bottom and at most 1, so that huge points gain nothing, as in the
    paper (global significance)."""

    def __post_init__(self) -> None:
        if not 0 <= self.ratio < 1:
            raise BadInput(f"prune: importance.ratio is {self.ratio}; it must be 0 or more and below 1")

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Drop the least important at the given steps."""
        if step.index not in self.at and not (step.index == 1 and 0 in self.at):
            return None
        measure = significance if self.score == "significance" else importance
        return Edit(drop=lowest(measure(step.views, step.splats, self.power), self.ratio))

    def edits(self, steps: int, views: int) -> Sequence[int]:
        """See `Prune.edits`."""
        return sorted({max(1, at) for at in self.at if at <= steps})


def importance(views: Views, splats: Splats, power: float) -> Tensor:
    """(N,) sum over views and pixels of the opacity, times (V / V90)^power."""
    hits = views.contributions().hits
    volume = splats.scales.prod(-1)
    large = volume.sort(descending=True).values[int(0.9 * len(volume))]
    return hits * splats.opacities * (volume / large) ** power


def significance(views: Views, splats: Splats, power: float) -> Tensor:
    """(N,) sum over views and pixels of opacity x transmittance, times min(V / V90, 1)^power.

    V90 is the volume that 90 % of the points do not exceed.
    """
    shown = functools.reduce(torch.add, (amount for amount, _ in views.each(0.0, 1.0)))
    volume = splats.scales.prod(-1)
    large = volume.sort().values[int(0.9 * len(volume))]
    return shown * splats.opacities * (volume / large).clamp_max(1) ** power


@dataclass(frozen=True)
class PruneByOpacity(Prune):
    """Drop faint points every so often, also after densification has ended."""

    divides: ClassVar[bool] = True

    below: float = 0.005
    """Opacity that is too little."""

    start: Steps = 500
    """Steps before the first time."""

    until: Steps = 30_000
    """Last step that may drop."""

    every: Annotated[int, StepCount(floor=10)] = 100
    """Steps between two times; short runs keep at least 10."""

    recovery: Annotated[int, StepCount(floor=100)] = 100
    """Steps after a reset of the opacities without dropping; short runs keep at least 100."""

    def __post_init__(self) -> None:
        if self.every < 1:
            raise BadInput(f"prune: opacity.every is {self.every}; it must be 1 or more steps")

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Drop what is too faint."""
        if not self.start < step.index <= self.until or step.index % self.every or step.since_reset < self.recovery:
            return None
        return Edit(drop=step.splats.opacities < self.below)

    def edits(self, steps: int, views: int) -> range:
        """See `Prune.edits`."""
        return range((self.start // self.every + 1) * self.every, min(self.until, steps) + 1, self.every)
