"""The median depth of Gaussians as stochastic solids (Zhang et al. 2026, GGGS), in plain torch, as `solids.h` has it.

A Gaussian whose density on a ray is G(t) = G* exp(-curve (t - peak)^2 / 2) leaves open v = sqrt(1 - G) up to its peak
and v*^2 / v behind it (eq. 12), so that behind it as much is left as in pictures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.raster.api import ALPHA_MAX, ALPHA_MIN

FARTHEST = 0.4
"""The depth is looked for within this share of the depth where the search begins (GGGS, appendix A.1)."""
BISECTIONS = 60
LEAST_FALL = 1.0
"""Of the logarithm of the light over the whole way, at the rate where the depth is: with less it has no gradient."""


@dataclass(frozen=True)
class Solids:
    """n Gaussians on P rays.

    Attributes:
        density: (n, P) at the peak, not yet held at ALPHA_MAX; those below ALPHA_MIN hide nothing.
        peak: (n, P) depth of it.
        curve: (n, P) such that G = density exp(-curve (t - peak)^2 / 2).
    """

    density: Tensor
    peak: Tensor
    curve: Tensor

    def log_open(self, t: Tensor) -> Tensor:
        """(P,) log T at (P,) depths (eq. 11)."""
        here = self.density * torch.exp(-self.curve * (t - self.peak) ** 2 / 2)
        vacancy = torch.log1p(-here.clamp_max(ALPHA_MAX)) / 2
        left = torch.where(t <= self.peak, vacancy, torch.log1p(-self.density.clamp_max(ALPHA_MAX)) - vacancy)
        return torch.where(self.density >= ALPHA_MIN, left, 0.0).sum(0)

    def fall(self, t: Tensor) -> Tensor:
        """(P,) -d(log T) / dt at (P,) depths, by autograd."""
        with torch.enable_grad():
            at = t.detach().requires_grad_()
            apart = Solids(*(each.detach() for each in (self.density, self.peak, self.curve)))
            (slope,) = torch.autograd.grad(apart.log_open(at).sum(), at)
        return -slope

    def depth(self, start: Tensor, near: float) -> tuple[Tensor, Tensor]:
        """Where half is left open (eq. 10), with the gradient of eq. 13, and where rounding may decide, (P,) each.

        Args:
            start: (P,) depths about which to look; 0 for none.
            near: Nothing nearer is a depth.
        """
        half = math.log(0.5)
        with torch.no_grad():
            low, high = (1 - FARTHEST) * start, (1 + FARTHEST) * start
            ends = self.log_open(low), self.log_open(high)
            found = (start > 0) & (ends[0] > half) & (ends[1] <= half)
            for _ in range(BISECTIONS):
                middle = (low + high) / 2
                is_open = self.log_open(middle) > half
                low, high = torch.where(is_open, middle, low), torch.where(is_open, high, middle)
            t = (low + high) / 2
            found &= t >= near
            fall = self.fall(t)
            steep = found & (fall * t > LEAST_FALL)
            unsure = torch.stack([(end - half).abs() for end in ends]).amin(0) < 1e-4
            unsure |= ((fall * t / LEAST_FALL - 1).abs() < 1e-2) | ((t / near - 1).abs() < 1e-4)
            # Where the light hardly falls, what is rounded moves the depth far.
            unsure |= found & (fall * t < 0.3)
        open_here = self.log_open(t)
        moved = t + torch.where(steep, open_here - open_here.detach(), 0.0) / torch.where(steep, fall, 1.0)
        return torch.where(found, moved, 0.0), unsure & (start > 0)
