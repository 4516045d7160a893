"""Cells of equal work."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.partition.base import Box, Cells, CoarseModel, Ground, Partition

STRIPS_PER_AXIS = 48
"""Strips along each axis between whose borders cuts are sought."""
Strips = tuple[int, int, int, int]
"""A box of strips: the first along each axis, and the first behind it."""


@dataclass(frozen=True)
class Balanced(Partition):
    """A tree of cuts that gives every block about the same work: the pixels of its views times its points."""

    count: int = 4
    """Blocks."""

    threshold: float = 0.05
    """A view is expected to join a block that makes up more than this share of its picture."""

    def __post_init__(self) -> None:
        if self.count < 1:
            raise BadInput(f"partition: balanced.count is {self.count}; it must be 1 or more")
        if not 0 <= self.threshold < 1:
            raise BadInput(f"partition: balanced.threshold is {self.threshold}; it must be 0 or more and below 1")

    def cells(self, sight: CoarseModel) -> Cells:
        """See `Partition.cells`."""
        ground = Ground.under(sight.centres, sight.splats.means)
        if len(sight.splats) < self.count:
            raise BadInput(
                f"partition: {len(sight.splats):,} points cannot make {self.count} blocks; lower balanced.count"
            )
        load = StripWorkload.of(sight, ground, self.threshold)
        boxes = self._cut(load, (0, 0, *load.counts.shape), self.count)
        return Cells(ground, tuple(load.box(strips) for strips in boxes), tuple(range(len(boxes))))

    def _cut(self, load: StripWorkload, strips: Strips, count: int) -> list[Strips]:
        """Cut a box of strips into `count`, where the halves' work is most nearly in the ratio of their counts."""
        if count == 1:
            return [strips]
        left = count // 2
        best: tuple[float, Strips, Strips] | None = None
        for low, high in _halves(strips):
            work = load.work(low) / left, load.work(high) / (count - left)
            if best is None or max(work) < best[0]:
                best = max(work), low, high
        if best is None:
            raise BadInput(f"partition: the scene is too narrow for {self.count} blocks; lower balanced.count")
        return [*self._cut(load, best[1], left), *self._cut(load, best[2], count - left)]


def _halves(strips: Strips) -> Iterator[tuple[Strips, Strips]]:
    """Both sides of every cut of a box of strips, along the first axis and then along the second."""
    x0, y0, x1, y1 = strips
    for at in range(x0 + 1, x1):
        yield (x0, y0, at, y1), (at, y0, x1, y1)
    for at in range(y0 + 1, y1):
        yield (x0, y0, x1, at), (x0, at, x1, y1)


@dataclass(frozen=True)
class StripWorkload:
    """Where points lie and what views look at, on strips with equally many points.

    Attributes:
        borders: Inner borders of the strips along each axis.
        counts: (X, Y) points in each field.
        shares: (V, X + 1, Y + 1) sums over the fields before each of the share of every picture.
        pixels: (V,).
        threshold: A view joins above this share.
    """

    borders: tuple[Tensor, Tensor]
    counts: Tensor
    shares: Tensor
    pixels: Tensor
    threshold: float

    @classmethod
    def of(cls, sight: CoarseModel, ground: Ground, threshold: float) -> StripWorkload:
        """Look once through every view."""
        flat = ground.flat(sight.splats.means)
        parts = torch.arange(1, STRIPS_PER_AXIS) * len(flat) // STRIPS_PER_AXIS
        borders = tuple(flat[:, axis].sort().values[parts].unique() for axis in (0, 1))
        x, y = (torch.bucketize(flat[:, axis].contiguous(), side, right=True) for axis, side in enumerate(borders))
        wide, high = len(borders[0]) + 1, len(borders[1]) + 1
        field = x * high + y
        counts = torch.bincount(field, minlength=wide * high).view(wide, high)
        shares = torch.zeros(len(sight.views), wide + 1, high + 1)
        for at in range(len(sight.views)):
            here = torch.zeros(wide * high).index_add_(0, field, sight.share(at).float())
            shares[at, 1:, 1:] = here.view(wide, high).cumsum(0).cumsum(1)
            emit(Progress("looking at what views show", at + 1, len(sight.views)))
        return cls(borders, counts, shares, sight.pixels, threshold)

    def work(self, strips: Strips) -> float:
        """Pixels of the views that look at a box of strips, times its points."""
        x0, y0, x1, y1 = strips
        s = self.shares
        joins = s[:, x1, y1] - s[:, x0, y1] - s[:, x1, y0] + s[:, x0, y0] > self.threshold
        return float(self.pixels[joins].sum() * self.counts[x0:x1, y0:y1].sum())

    def box(self, strips: Strips) -> Box:
        """The sides of a box of strips; the outer ones have no end."""
        x0, y0, x1, y1 = strips
        (bx, by), (wide, high) = self.borders, self.counts.shape
        return (
            float(bx[x0 - 1]) if x0 else None,
            float(by[y0 - 1]) if y0 else None,
            float(bx[x1 - 1]) if x1 < wide else None,
            float(by[y1 - 1]) if y1 < high else None,
        )
