"""Conditions that a point must meet to be densified, whatever policy asks for it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.densify.base import Filter, Step


@dataclass(frozen=True)
class Elongation(Filter):
    """Do not densify needle-like points: the elongation filter (CityGaussianV2, section 3.2).

    A surfel seen nearly edge-on is as thin on the screen as a line: its gradient is that of a few pixels, always large,
    and it is densified without end.
    """

    min_ratio: float = 0.01
    """Ratio of the second longest to the longest axis (eta) above which a point may be densified. The third axis of an
    ellipsoid does not count: where it is short, the point is flat, which is no needle."""

    def __post_init__(self) -> None:
        if not 0 <= self.min_ratio < 1:
            raise BadInput(f"filters: elongation.min_ratio is {self.min_ratio}; it must be 0 or more and below 1")

    def admits(self, step: Step, want: Tensor) -> Tensor:
        """(N,) bool, points that are no needles."""
        longest, second = step.splats.scales.topk(2, dim=-1).values.unbind(-1)
        return second > self.min_ratio * longest


@dataclass(frozen=True)
class CountCap(Filter):
    """Never add points beyond a number of them; those with the largest densification signal come first."""

    points: int = 1_000_000
    """Largest number of points."""

    def __post_init__(self) -> None:
        if self.points < 1:
            raise BadInput(f"filters: count-cap.points is {self.points}; it must be 1 or more")

    @property
    def most_points(self) -> int:
        """See `Filter.most_points`."""
        return self.points

    def admits(self, step: Step, want: Tensor) -> Tensor:
        """(N,) bool, as many as there is room for: each adds one."""
        room = max(0, self.points - len(want))
        if room >= int((want > 0).sum()):
            return want > 0
        return torch.zeros_like(want, dtype=torch.bool).index_fill(0, want.topk(room).indices, True)
