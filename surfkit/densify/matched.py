"""Adaptive density control by two gradients (GOF, Yu et al. 2024, and methods after it)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.densify.adc import ADC, GRAD_STAT, SEEN_STAT
from surfkit.densify.base import Densify, Step, admitted
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points

ABSOLUTE_STAT = "matched/absolute"


@dataclass(frozen=True)
class MatchedADC(Densify):
    """Densify the points with a high signed gradient, and as many with the highest absolute one; copies are placed at
    random within their original (GOF). Needs signal:abs-gradient."""

    adc: ADC = ADC(cull_opacity=0.05)
    """Schedule, removal and filters, and the threshold of the signed gradient."""

    def __post_init__(self) -> None:
        if self.adc.split_threshold is not None:
            raise BadInput(
                f"densify.adc.split_threshold is {self.adc.split_threshold}; matched-adc has a rule of its own for the "
                "absolute gradient, so leave it out"
            )

    @property
    def needs_absolute(self) -> bool:
        """See `Densify.needs_absolute`."""
        return True

    def watch(self, points: Points, step: Step) -> None:
        """Sum both gradients and count the views, from one edit to the next."""
        if step.index >= self.adc.until:
            return
        absolute, shown = points.stat(ABSOLUTE_STAT), step.shown
        if shown.signed_norm is None:
            raise BadInput("densify: a step without `signed_norm`; whoever makes steps for matched-adc must give it")
        if self.adc.is_due(step.index - 1):
            absolute.zero_()
        shown.add(absolute, shown.grad_norm)
        self.adc.note(points, step, replace(shown, grad_norm=shown.signed_norm))

    def edit(self, points: Points, step: Step) -> Edit | None:
        """As that of ADC, but with the points that both gradients choose."""
        if not self.adc.is_due(step.index):
            return self.adc.edit(points, step)
        edit = self.adc.edit_of(points, step, admitted(self.adc.filters, step, self.wants(points)))
        return replace(edit, scatter=edit.clone)

    def wants(self, points: Points) -> Tensor:
        """(N,) how far a point is above the threshold of either gradient, 1 or more; 0 where below both.

        The threshold of the absolute gradient is the quantile that as many points reach as the signed threshold.
        """
        seen = points.stat(SEEN_STAT).clamp_min(1)
        signed, absolute = points.stat(GRAD_STAT) / seen, points.stat(ABSOLUTE_STAT) / seen
        count = int((signed >= self.adc.threshold).sum())
        if count == 0:
            return torch.zeros_like(signed)
        least = absolute.kthvalue(len(absolute) - count + 1).values.clamp_min(1e-30)
        want = torch.maximum(signed / self.adc.threshold, absolute / least)
        return want * ((signed >= self.adc.threshold) | (absolute >= least))

    def edits(self, steps: int) -> Sequence[int]:
        """See `Densify.edits`."""
        return self.adc.edits(steps)

    @property
    def most_points(self) -> int | None:
        """See `Densify.most_points`."""
        return self.adc.most_points

    def limited(self, points: int) -> MatchedADC:
        """See `Densify.limited`; the points farthest above a threshold come first."""
        return replace(self, adc=self.adc.limited(points))
