"""A limit on the number of points, for a densifier that has none of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch

from surfkit.core.check import BadInput
from surfkit.core.registry import choice
from surfkit.densify.adc import ADC
from surfkit.densify.base import Densify, Step
from surfkit.primitives.edit import Edit, withheld
from surfkit.primitives.points import Points


@dataclass(frozen=True)
class PointCap(Densify):
    """Densify as another densifier does, but never beyond a number of points.

    Where it asks for more clones and splits than there is room for, points drawn at random among those get theirs: what
    makes one more urgent than another, only the densifier knows. One with a limit of its own (`Densify.limited`) may
    choose better.
    """

    divides: ClassVar[bool] = True

    inner: Annotated[Densify, choice(Densify, without=("limited",))] = ADC()
    """How points are densified."""

    points: int = 1_000_000
    """Largest number of points."""

    def __post_init__(self) -> None:
        if self.points < 1:
            raise BadInput(f"densify: limited.points is {self.points}; it must be 1 or more")

    def watch(self, points: Points, step: Step) -> None:
        """See `Policy.watch`."""
        self.inner.watch(points, step)

    def edit(self, points: Points, step: Step) -> Edit | None:
        """The edit of the inner densifier, without the clones and splits that there is no room for."""
        edit = self.inner.edit(points, step)
        if edit is None or (edit.clone is None and edit.split is None and edit.new is None):
            return edit
        dropped = torch.zeros_like(step.seen) if edit.drop is None else edit.drop
        added = torch.zeros_like(dropped, dtype=torch.int64)
        for mask in (edit.clone, edit.split):
            added += 0 if mask is None else mask * ~dropped
        if edit.new is not None:
            added += torch.bincount(edit.new.parent, minlength=len(points))
        added *= step.may_be_densified()  # a trainer leaves out the others
        room = max(0, self.points - int((~dropped).sum()))
        if int(added.sum()) <= room:
            return edit
        order = torch.randperm(len(points), generator=torch.Generator().manual_seed(step.seed)).to(added.device)
        may = torch.zeros_like(step.seen)
        may[order[added[order].cumsum(0) <= room]] = True
        return withheld(edit, may)

    def edits(self, steps: int) -> Sequence[int] | None:
        """See `Densify.edits`."""
        return self.inner.edits(steps)

    @property
    def needs_absolute(self) -> bool:
        """See `Densify.needs_absolute`."""
        return self.inner.needs_absolute

    @property
    def needs_pixels(self) -> bool:
        """See `Densify.needs_pixels`."""
        return self.inner.needs_pixels

    @property
    def needs_leading(self) -> bool:
        """See `Densify.needs_leading`."""
        return self.inner.needs_leading

    @property
    def most_points(self) -> int:
        """See `Densify.most_points`."""
        inner = self.inner.most_points
        return self.points if inner is None else min(self.points, inner)

    def limited(self, points: int) -> PointCap:
        """See `Densify.limited`."""
        return replace(self, points=min(self.points, points))
