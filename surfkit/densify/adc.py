"""Adaptive density control."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.registry import choice
from surfkit.core.schedule import StepCount, Steps
from surfkit.densify.base import Densify, Filter, Step, admitted
from surfkit.densify.filters import CountCap
from surfkit.primitives.base import SHRINK
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points

GRAD, SEEN, SIZE = "adc/grad", "adc/seen", "adc/size"
START_STRETCH, EVERY_STRETCH = 15.0, 30.0
"""How much longer than their share of a short run its first steps without an edit and its pauses between edits may be.
Of the default `until`, 15,000, 500 times 15 are a half, and 100 times 30 a fifth: two edits. On examples/boruszyn at
a quarter of its size, 500 steps of 2DGS came to 18.7 dB so, to 17.4 without edits, and to 17.0 with five, which add
points faster than these can learn; 1,000 steps to 20.6, to 18.4 with one edit, and to 20.3 with five (69,000 points
instead of 31,000)."""


@dataclass(frozen=True)
class ADC(Densify):
    """Clone small and split large points whose screen-space gradient is high; drop faint and huge ones (3DGS)."""

    threshold: float = 2e-4
    """Mean length of the gradient above which a point is densified, in units of half the image size."""

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
        if not 0 < self.reset_opacity < 1:
            raise BadInput(f"densify.reset_opacity is {self.reset_opacity}; it must lie between 0 and 1")

    def watch(self, points: Points, step: Step) -> None:
        """Sum the signal and count the views, from one edit to the next."""
        if step.index >= self.until:
            return
        columns = [points.stat(GRAD), points.stat(SEEN)] + [points.stat(SIZE)] * (self.cull_screen > 0)
        if self._due(step.index - 1):
            for column in columns:
                column.zero_()
        columns[0].add_(step.grad_norm)
        columns[1].add_(step.seen)
        if self.cull_screen > 0:
            torch.maximum(columns[2], step.radii / step.image_px, out=columns[2])

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Clone, split and drop every so often; reset opacities less often."""
        reset = step.index % self.reset_every == 0 and step.index < self.until
        cap = self.reset_opacity if reset else None
        if not self._due(step.index):
            return Edit(max_opacity=cap) if reset else None
        size = step.splats.scales.amax(-1)
        hot, small = self._hot(points, step), size <= self.small
        clone, split = hot & small, hot & ~small
        drop = step.splats.opacities < self.cull_opacity
        if step.index > self.reset_every:
            drop &= not 0 < step.index % self.reset_every < self.recovery
            if self.cull_scale > 0:
                drop |= torch.where(split, size / SHRINK, size) > self.cull_scale
            if self.cull_screen > 0:
                drop |= points.stat(SIZE) > self.cull_screen
        return Edit(drop, clone, split, cap)

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        return range((self.start // self.every + 1) * self.every, min(self.until, steps + 1), self.every)

    @property
    def most_points(self) -> int | None:
        """See `Densify.most_points`."""
        limits = [limit for one in self.filters if (limit := one.most_points) is not None]
        return min(limits, default=None)

    def limited(self, points: int) -> ADC:
        """See `Densify.limited`; the points with the largest gradient come first."""
        return replace(self, filters=(*self.filters, CountCap(points)))

    def _due(self, index: int) -> bool:
        return self.start < index < self.until and index % self.every == 0

    def _hot(self, points: Points, step: Step) -> Tensor:
        """(N,) bool, points to be densified."""
        mean = points.stat(GRAD) / points.stat(SEEN).clamp_min(1)
        return admitted(self.filters, step, mean * (mean >= self.threshold))
