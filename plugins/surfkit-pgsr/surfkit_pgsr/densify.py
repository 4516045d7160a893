"""Which points PGSR adds and removes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from surfkit.densify.adc import GRAD_STAT, SEEN_STAT
from surfkit.plugin import ADC, BadInput, CountCap, Densify, Edit, Points, Prune, Step, StepCount, Steps, admitted

ABSOLUTE, RADIUS = "two-threshold/absolute", "two-threshold/radius"


@dataclass(frozen=True)
class TwoThresholdADC(Densify):
    """ADC by the signed gradient; points that are large on the screen are also split by the absolute one (PGSR).

    Signs cancel out in points that cover much of a picture, and the sizes of the pixels' shares do not (AbsGS). Needs
    signal:abs-gradient.
    """

    adc: ADC = ADC(small=0.001)
    """Schedule, removal and filters, and the threshold of the signed gradient."""

    absolute: float = 8e-4
    """Mean absolute gradient above which large points are split, in units of half the image size."""

    radius_px: float = 20.0
    """Radius of a point in pixels, in any view since the last edit, above which it is large."""

    most: int = 50_000
    """Largest number of points split by the absolute gradient in an edit; those with the largest gradient."""

    points: int = 6_000_000
    """Largest number of points; those farthest above a threshold come first."""

    def __post_init__(self) -> None:
        for name in ("absolute", "radius_px"):
            if not getattr(self, name) > 0:
                raise BadInput(f"densify.{name} is {getattr(self, name):g}; it must be more than 0")
        for name, least in (("most", 0), ("points", 1)):
            if getattr(self, name) < least:
                raise BadInput(f"densify.{name} is {getattr(self, name)}; it must be {least} or more")

    @property
    def needs_absolute(self) -> bool:
        """See `Densify.needs_absolute`."""
        return True

    def watch(self, points: Points, step: Step) -> None:
        """Sum both gradients, count the views and keep the largest radius, from one edit to the next."""
        if step.index >= self.adc.until:
            return
        shown = step.shown
        if shown.signed_norm is None:
            raise BadInput("densify: a step without `signed_norm`; whoever makes steps for two-threshold-adc gives it")
        absolute, radius = points.stat(ABSOLUTE), points.stat(RADIUS)
        if self.adc.is_due(step.index - 1):
            absolute.zero_()
            radius.zero_()
        shown.add(absolute, shown.grad_norm)
        shown.raise_to(radius, shown.radii)
        self.adc.note(points, step, replace(shown, grad_norm=shown.signed_norm))

    def edit(self, points: Points, step: Step) -> Edit | None:
        """As that of ADC, with more splits, and none beyond the number of points."""
        if not self.adc.is_due(step.index):
            return self.adc.edit(points, step)
        signed, absolute = self.wants(points)
        filters = (*self.adc.filters, CountCap(self.points))
        hot = admitted(filters, step, torch.maximum(signed, absolute))
        edit, large = self.adc.edit_of(points, step, hot), hot & (signed == 0)
        assert edit.clone is not None and edit.split is not None, "ADC gives both"
        return replace(edit, clone=edit.clone & ~large, split=edit.split | large)

    def wants(self, points: Points) -> tuple[Tensor, Tensor]:
        """(N,) how far a point is above the threshold of the signed gradient, 1 or more, or 0 where it is below; and
        the same of the absolute one, of points that only that one chooses."""
        seen = points.stat(SEEN_STAT).clamp_min(1)
        signed, absolute = (
            points.stat(GRAD_STAT) / seen / self.adc.threshold,
            points.stat(ABSOLUTE) / seen / self.absolute,
        )
        signed = signed * (signed >= 1)
        chosen = (absolute >= 1) & (points.stat(RADIUS) > self.radius_px) & (signed == 0)
        absolute = absolute * chosen
        if int(chosen.sum()) > self.most:
            kept = torch.zeros_like(chosen).index_fill(0, absolute.topk(self.most).indices, True)
            absolute = absolute * kept
        return signed, absolute

    def edits(self, steps: int) -> Sequence[int]:
        """See `Densify.edits`."""
        return self.adc.edits(steps)

    @property
    def most_points(self) -> int:
        """See `Densify.most_points`."""
        inner = self.adc.most_points
        return self.points if inner is None else min(inner, self.points)

    def limited(self, points: int) -> TwoThresholdADC:
        """See `Densify.limited`."""
        return replace(self, points=min(self.points, points))


@dataclass(frozen=True)
class FewViews(Prune):
    """Drop points that fewer training views see than a number: no second view can tell where they are (PGSR)."""

    views: int = 2
    """Least number of views with a pixel that the point is blended into."""

    start: Steps = 500
    """Steps before the first time."""

    until: Steps = 15_000
    """Last step that may drop."""

    every: Annotated[int, StepCount(floor=100)] = 1_000
    """Steps between two times; short runs keep at least 100. Each time looks at all training views."""

    def __post_init__(self) -> None:
        if self.every < 1 or self.views < 1:
            raise BadInput(f"prune: few-views has every {self.every} and views {self.views}; both must be 1 or more")

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Drop what is hardly seen."""
        if not self.start < step.index <= self.until or step.index % self.every:
            return None
        return Edit(drop=step.views.contributions().views < self.views)
