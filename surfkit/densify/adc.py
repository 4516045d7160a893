"""Adaptive density control."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.registry import choice
from surfkit.core.schedule import StepCount, Steps
from surfkit.densify.base import Densify, Filter, Step, ViewStatistics, admitted
from surfkit.densify.filters import CountCap
from surfkit.primitives.base import SHRINK
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points

GRAD_STAT, SEEN_STAT, SIZE_STAT, SIGNED_STAT = "adc/grad", "adc/seen", "adc/size", "adc/signed"
START_STRETCH, EVERY_STRETCH = 15.0, 30.0
"""How much longer than their share of a short run its first steps without an edit and its pauses between edits may be.
Of the default `until`, 15,000, 500 times 15 are a half, and 100 times 30 a fifth: two edits. On examples/boruszyn at
a quarter of its size, 500 steps of 2DGS came to 18.7 dB so, to 17.4 without edits, and to 17.0 with five, which add
points faster than these can learn; 1,000 steps to 20.6, to 18.4 with one edit, and to 20.3 with five (69,000 points
instead of 31,000)."""


@dataclass(frozen=True)
class ADC(Densify):
    """Clone small and split large points whose screen-space gradient is high; drop faint and huge ones (3DGS)."""

    divides: ClassVar[bool] = True

    threshold: float = 2e-4
    """Mean length of the gradient above which a point is densified, in units of half the image size."""

    split_threshold: float | None = None
    """If set, large points are split where the mean of the signal, which must be abs-gradient, is above this, and small
    ones cloned where that of the signed gradient of all losses is above `threshold` (AbsGS: 4e-4 and 2e-4)."""

    small: float = 0.01
    """Largest scale that is cloned rather than split, as a share of the scene extent."""

    start: Annotated[int, StepCount(floor=300, stretch=START_STRETCH)] = 500
    """Steps before the first edit; short runs keep at least 300, as gradients mean little until colours settle, but no
    more than half of the time up to `until`."""

    until: Steps = 15_000
    """Step from which on nothing is edited."""

    every: Annotated[int, StepCount(floor=100, stretch=EVERY_STRETCH)] = 100
    """Steps between edits; short runs keep at least 100, which points need to find their place, but no more than a
    fifth of the time up to `until`: two edits remain in a run of 20 steps."""

    cull_opacity: float = 0.005
    """Drop points fainter than this."""

    cull_scale: float = 0.1
    """Drop points larger than this share of the scene extent, once opacities have been reset; 0 never does."""

    cull_screen: float = 0.0
    """Drop points whose radius in any view since the last edit was larger than this share of the longer image side,
    once opacities have been reset; 0 never does. (3DGS states 20 px, but its released code never applies it.)"""

    reset_every: Annotated[int, StepCount(floor=500)] = 3_000
    """Steps between resets of the opacities; short runs keep at least 500, which opacities need to recover."""

    reset_opacity: float = 0.01
    """Highest opacity after a reset."""

    recovery: Annotated[int, StepCount(floor=100)] = 100
    """Steps after a reset before faint points are dropped again; short runs keep at least 100."""

    filters: tuple[Annotated[Filter, choice(Filter)], ...] = ()
    """Conditions that a point must also meet to be densified; filters.0:NAME adds the first."""

    def __post_init__(self) -> None:
        for name in ("every", "reset_every"):
            if getattr(self, name) < 1:
                raise BadInput(f"densify.{name} is {getattr(self, name)}; it must be 1 or more steps")
        if self.split_threshold is not None and not 0 < self.split_threshold < float("inf"):
            raise BadInput(f"densify.split_threshold is {self.split_threshold}; it must be above 0, or unset")
        if not 0 < self.reset_opacity < 1:
            raise BadInput(f"densify.reset_opacity is {self.reset_opacity}; it must lie between 0 and 1")

    def watch(self, points: Points, step: Step) -> None:
        """See `Policy.watch`."""
        self.note(points, step, step.shown)

    def note(self, points: Points, step: Step, shown: ViewStatistics) -> None:
        """Sum the signal and count the views, from one edit to the next; `shown` may have another signal."""
        if step.index >= self.until:
            return
        names = [GRAD_STAT, SEEN_STAT] + [SIZE_STAT] * (self.cull_screen > 0) + [SIGNED_STAT] * self.needs_absolute
        columns = {name: points.stat(name) for name in names}
        if self.is_due(step.index - 1):
            for column in columns.values():
                column.zero_()
        shown.add(columns[GRAD_STAT], shown.grad_norm)
        shown.add(columns[SEEN_STAT], shown.seen)
        if self.cull_screen > 0:
            shown.raise_to(columns[SIZE_STAT], shown.radii / step.image_px)
        if self.needs_absolute:
            assert shown.signed_norm is not None, "a trainer gives it to policies that need it"
            shown.add(columns[SIGNED_STAT], shown.signed_norm)

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Clone, split and drop every so often; reset opacities less often."""
        if not self.is_due(step.index):
            cap = self._cap(step.index)
            return None if cap is None else Edit(max_opacity=cap)
        return self.edit_of(points, step, self._hot(points, step))

    def edit_of(self, points: Points, step: Step, hot: Tensor) -> Edit:
        """The edit of a step that is due, for densifiers with another rule: (N,) bool `hot` are densified."""
        size = step.splats.scales.amax(-1)
        small = size <= self.small
        clone, split = hot & small, hot & ~small
        drop = step.splats.opacities < self.cull_opacity
        if step.index > self.reset_every:
            drop &= not 0 < step.index % self.reset_every < self.recovery
            if self.cull_scale > 0:
                drop |= torch.where(split, size / SHRINK, size) > self.cull_scale
            if self.cull_screen > 0:
                drop |= points.stat(SIZE_STAT) > self.cull_screen
        return Edit(drop, clone, split, self._cap(step.index))

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        return range((self.start // self.every + 1) * self.every, min(self.until, steps + 1), self.every)

    @property
    def needs_absolute(self) -> bool:
        """See `Densify.needs_absolute`."""
        return self.split_threshold is not None

    @property
    def most_points(self) -> int | None:
        """See `Densify.most_points`."""
        limits = [limit for one in self.filters if (limit := one.most_points) is not None]
        return min(limits, default=None)

    def limited(self, points: int) -> ADC:
        """See `Densify.limited`; the points with the largest gradient come first."""
        return replace(self, filters=(*self.filters, CountCap(points)))

    def is_due(self, index: int) -> bool:
        """Whether points are added and dropped after step `index`."""
        return self.start < index < self.until and index % self.every == 0

    def _cap(self, index: int) -> float | None:
        """Where step `index` resets opacities, the highest one after that."""
        return self.reset_opacity if index % self.reset_every == 0 and index < self.until else None

    def _hot(self, points: Points, step: Step) -> Tensor:
        """(N,) bool, points to be densified."""
        return admitted(self.filters, step, self.want(points, step))

    def want(self, points: Points, step: Step) -> Tensor:
        """(N,) how strongly each point wants to be densified, as its mean gradient, in multiples of the thresholds
        where there are two; 0 for those that do not."""
        seen = points.stat(SEEN_STAT).clamp_min(1)
        mean, least = points.stat(GRAD_STAT) / seen, self.threshold
        if self.split_threshold is not None:  # in multiples of the threshold, so that both kinds can be compared
            small = step.splats.scales.amax(-1) <= self.small
            mean = torch.where(small, points.stat(SIGNED_STAT) / seen / self.threshold, mean / self.split_threshold)
            least = 1.0
        return mean * (mean >= least)
