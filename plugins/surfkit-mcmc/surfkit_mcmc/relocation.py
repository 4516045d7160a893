"""Points are never judged by their gradient: dead ones move to where live ones are, and noise lets them explore."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from surfkit.plugin import BadInput, Densify, Edit, Filter, Points, Step, StepCount, Steps, admitted, choice, rotated

MOST = 51
"""Points at one place beyond which the sums of the formula lose their digits."""


@dataclass(frozen=True)
class Relocation(Densify):
    """Move dead points onto live ones and add a few more, without a change of the picture, up to a number of points."""

    cap: int = 1_000_000
    """The most points there may be."""

    start: Annotated[int, StepCount(floor=100, stretch=25.0)] = 500
    """Steps before the first move; short runs keep at least 100, but no more than half of the way to `until`."""

    until: Steps = 25_000
    """Last step that moves points."""

    every: Annotated[int, StepCount(floor=50, stretch=50.0)] = 100
    """Steps between moves; short runs keep at least 50, but no more than a fifth of the way to `until`."""

    growth: float = 0.05
    """Share by which the number of points grows at each move."""

    dead: float = 0.005
    """Opacity up to which a point is dead."""

    noise: float = 1.25e7
    """Noise added to positions at each step, times the rate of positions and the covariance. Published as 5e5 in the
    units of scenes of an extent of about 5; here the extent is 1, hence 25 times as much."""

    filters: tuple[Annotated[Filter, choice(Filter)], ...] = ()
    """Conditions that a point must meet for others to move onto it. The number of points is limited by `cap`: a filter
    that admits nobody once there are enough would stop the moves too."""

    def __post_init__(self) -> None:
        if self.cap < 1 or self.every < 1:
            raise BadInput(f"densify: cap is {self.cap} and every {self.every}; both must be 1 or more")
        if not (0 < self.dead < 1 and self.growth >= 0 and self.noise >= 0):
            raise BadInput(
                f"densify: dead is {self.dead} (between 0 and 1), growth {self.growth} and noise {self.noise} "
                "(0 or more); these do not fit"
            )

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        return range((self.start // self.every + 1) * self.every, min(self.until, steps) + 1, self.every)

    @property
    def most_points(self) -> int:
        """See `Densify.most_points`."""
        return self.cap

    def limited(self, points: int) -> Relocation:
        """See `Densify.limited`."""
        return replace(self, cap=min(self.cap, points))

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Noise at every step, and moves every so often."""
        draw = torch.Generator().manual_seed(step.seed)
        move = self._noise(step, draw) if self.noise > 0 else None
        if not (self.start < step.index <= self.until and step.index % self.every == 0):
            return None if move is None else Edit(move=move)
        return self._move(step, move, draw)

    def _noise(self, step: Step, draw: torch.Generator) -> Tensor:
        """(N, 3) drawn with the covariance squared, so within the disc of a surfel; faint points move the most."""
        shape = step.splats
        spread = torch.nn.functional.pad(shape.scales, (0, 3 - shape.scales.shape[1])) ** 2
        normal = torch.randn(len(shape), 3, generator=draw).to(spread)
        faint = torch.sigmoid(100 * (1 - shape.opacities - 0.995))
        return self.noise * step.rates["means"] * faint[:, None] * rotated(spread * normal, shape.quats)

    def _move(self, step: Step, move: Tensor | None, draw: torch.Generator) -> Edit:
        opacities = step.splats.opacities
        dead = opacities <= self.dead
        alive = admitted(self.filters, step, opacities * ~dead) * opacities
        count = len(opacities)
        moved = int(dead.sum()) + max(0, min(self.cap, int((1 + self.growth) * count)) - count)
        if not bool(alive.any()):
            return Edit(move=move)
        copies = drawn(alive, moved, draw)
        opacity, shrink = shared(opacities, copies + 1, min(1.01 * self.dead, 0.999))
        copied = copies > 0
        return Edit(
            drop=dead,
            clone=copies,
            move=move,
            opacities=torch.where(copied, opacity, torch.nan),
            scale_by=torch.where(copied, shrink, 1.0),
            forget=copied,
        )


def drawn(weights: Tensor, count: int, draw: torch.Generator) -> Tensor:
    """(N,) int64 how often each row is drawn in `count` draws in proportion to (N,) weights, with replacement."""
    ends = weights.double().cumsum(0).cpu()
    at = torch.searchsorted(ends, torch.rand(count, generator=draw, dtype=torch.float64) * ends[-1], right=True)
    return torch.bincount(at.clamp_max(len(weights) - 1), minlength=len(weights)).to(weights.device)


def shared(opacities: Tensor, number: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Opacity of each of `number` points at one place that together look like one, and the factor of its scales.

    With o' = 1 - (1 - o)^(1 / n), the scales shrink by o over the sum for i = 1..n and k = 0..i-1 of
    C(i - 1, k) (-1)^k o'^(k + 1) / sqrt(k + 1) (3DGS-MCMC, eq. 9). Summed over i first, C(i - 1, k) is C(n, k + 1).

    Args:
        opacities: (N,) of the one point.
        number: (N,) int64, 1 or more.
        least: No opacity below this; a little above that of the dead, so that a point just moved is alive.
    """
    n = number.clamp_max(MOST).double()
    one = opacities.double().clamp_max(1 - 1e-6)
    each = 1 - (1 - one) ** (1 / n)
    total, term = torch.zeros_like(each), torch.ones_like(each)
    for k in range(1, int(n.max()) + 1):
        term = term * (n - k + 1).clamp_min(0) / k * each  # C(n, k) o'^k
        total += (-1) ** (k - 1) * term / math.sqrt(k)
    factor = torch.where(n > 1, one / total, 1.0)
    return each.clamp(least, 1 - 1e-6).to(opacities), factor.to(opacities)
