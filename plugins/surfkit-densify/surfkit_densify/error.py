"""Points are densified where the pixels that they are blended into are wrong (Rota Bulò et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from surfkit.plugin import (
    BadInput,
    CountCap,
    Densify,
    Edit,
    Filter,
    Points,
    Step,
    StepCount,
    Steps,
    admitted,
    choice,
    ssim_map,
)

ERROR_STAT = "error/worst"
LEAST_OPACITY = 1e-4
"""That remains of an opacity which is lowered; the faint are dropped at the next edit."""


@dataclass(frozen=True)
class ByError(Densify):
    """Densify the points of the largest error, the pixels' 1 - SSIM in the share of their blending weights; clones
    leave the picture as it is, and opacities fall a little at each edit (Revising Densification).

    E_k is the largest, over the views since the last edit, of the sum over the pixels p of e(p) w_k(p), with the weight
    w_k = alpha_k T_k that point k is blended with. Large points are split and small ones cloned, as in 3DGS.
    """

    threshold: float = 0.1
    """Error E_k above which a point is densified, in pixels that are wholly wrong. A sum over pixels: pictures of half
    the width show a point with a quarter of the error, and nothing makes up for that, as a point then has as much less
    to mend. In most edits `growth` chooses."""

    growth: float = 0.05
    """Share of the points that may be added at an edit; those of the largest error come first."""

    small: float = 0.01
    """Largest scale that is cloned rather than split, as a share of the scene extent."""

    corrected: bool = True
    """Give a clone and its original the opacity 1 - sqrt(1 - o), so that both together hide what one has hidden; off,
    both have that of the original, as in 3DGS."""

    lower_by: float = 1e-3
    """What every opacity is lowered by at each edit, in place of resets; 0 does not."""

    start: Annotated[int, StepCount(floor=300, stretch=15.0)] = 500
    """Steps before the first edit; short runs keep at least 300, but no more than half of the time up to `until`."""

    until: Steps = 15_000
    """Step from which on nothing is edited."""

    every: Annotated[int, StepCount(floor=100, stretch=30.0)] = 100
    """Steps between edits; short runs keep at least 100, but no more than a fifth of the time up to `until`."""

    cull_opacity: float = 0.005
    """Drop points fainter than this at each edit."""

    filters: tuple[Annotated[Filter, choice(Filter)], ...] = ()
    """Conditions that a point must also meet to be densified; filters.0:NAME adds the first."""

    def __post_init__(self) -> None:
        if self.every < 1:
            raise BadInput(f"densify.every is {self.every}; it must be 1 or more steps")
        for name in ("threshold", "growth"):
            if not 0 < getattr(self, name) < float("inf"):
                raise BadInput(f"densify.{name} is {getattr(self, name)}; it must be above 0")
        for name in ("lower_by", "cull_opacity"):
            if not 0 <= getattr(self, name) < 1:
                raise BadInput(f"densify.{name} is {getattr(self, name)}; it must be 0 or more and below 1")

    @property
    def needs_pixels(self) -> bool:
        """See `Densify.needs_pixels`."""
        return True

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        return range((self.start // self.every + 1) * self.every, min(self.until, steps + 1), self.every)

    @property
    def most_points(self) -> int | None:
        """See `Densify.most_points`."""
        return min((limit for one in self.filters if (limit := one.most_points) is not None), default=None)

    def limited(self, points: int) -> ByError:
        """See `Densify.limited`; the points of the largest error come first."""
        return replace(self, filters=(*self.filters, CountCap(points)))

    def watch(self, points: Points, step: Step) -> None:
        """Keep the largest error of each point, from one edit to the next."""
        if step.index >= self.until:
            return
        if step.view is None:
            raise BadInput("densify: a step without `view`; whoever makes steps for densify:error must give it")
        worst = points.stat(ERROR_STAT)
        if self._is_due(step.index - 1):
            worst.zero_()
        error = 1 - ssim_map(step.view.color, step.view.photo).mean(0)
        step.shown.raise_to(worst, step.view.blended(error))

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Clone, split, drop and dim every so often."""
        if not self._is_due(step.index):
            return None
        worst, splats = points.stat(ERROR_STAT), step.splats
        hot = self._hot(step, worst)
        small = splats.scales.amax(-1) <= self.small
        clone, opacities = hot & small, splats.opacities
        if self.corrected:
            opacities = torch.where(clone, shared_opacity(opacities), opacities)
        lowered = (opacities - self.lower_by).clamp(LEAST_OPACITY, 1 - 1e-6)
        changes = clone & self.corrected | (self.lower_by > 0)
        return Edit(
            drop=splats.opacities < self.cull_opacity,
            clone=clone,
            split=hot & ~small,
            opacities=torch.where(changes, lowered, torch.nan),
        )

    def _is_due(self, index: int) -> bool:
        return self.start < index < self.until and index % self.every == 0

    def _hot(self, step: Step, worst: Tensor) -> Tensor:
        """(N,) bool, points to be densified: of those above the threshold, as many as may grow."""
        want = worst * (worst > self.threshold)
        want = want * admitted(self.filters, step, want)
        most = min(int(self.growth * len(want)), int((want > 0).sum()))
        return torch.zeros_like(want, dtype=torch.bool).index_fill(0, want.topk(most).indices, True)


def shared_opacity(opacities: Tensor) -> Tensor:
    """(N,) the opacity of each of two points at one place that together hide as much as one of (N,) `opacities`."""
    return 1 - (1 - opacities).sqrt()
