"""Adaptive density control by the largest gradient of a view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from surfkit.plugin import ADC, BadInput, Edit, Points, Step, StepCount, ViewStatistics, admitted

PEAK_STAT = "peak-adc/grad"


@dataclass(frozen=True)
class PeakADC(ADC):
    """Clone and split points whose screen-space gradient is high in any one view (Hierarchical 3DGS, section 3).

    The mean over the views, as 3DGS has it, is low for what many views show from afar and few from near; the largest is
    high where one view lacks detail. All else is as in `adc`.
    """

    threshold: float = 0.015
    """Largest length of the gradient in a view since the last edit, from which on a point is densified, in units of
    half the image size."""

    small: float = 1e-4
    """Largest scale that is cloned rather than split, as a share of the scene extent."""

    every: Annotated[int, StepCount(floor=100, stretch=30.0)] = 300
    """Steps between edits; short runs keep at least 100, but no more than 30 times their share of the run."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.split_threshold is not None:
            raise BadInput(
                f"densify.split_threshold is {self.split_threshold}: peak-adc has one threshold for clones and splits; "
                "leave it unset, or choose densify:adc"
            )

    def note(self, points: Points, step: Step, shown: ViewStatistics) -> None:
        """Keep the largest signal of each point, from one edit to the next."""
        super().note(points, step, shown)
        if step.index >= self.until:
            return
        peak = points.stat(PEAK_STAT)
        if self.is_due(step.index - 1):
            peak.zero_()
        shown.raise_to(peak, shown.grad_norm)

    def edit(self, points: Points, step: Step) -> Edit | None:
        """See `ADC.edit`."""
        if not self.is_due(step.index):
            return super().edit(points, step)
        peak = points.stat(PEAK_STAT)
        return self.edit_of(points, step, admitted(self.filters, step, peak * (peak >= self.threshold)))
