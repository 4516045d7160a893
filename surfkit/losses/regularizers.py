"""Terms on the points themselves, whatever they look like (3DGS-MCMC, section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from surfkit.losses.base import Regularizer
from surfkit.raster.api import Splats


@dataclass(frozen=True)
class MeanOpacity(Regularizer):
    """Mean opacity: points that explain nothing fade away."""

    weight: float = 0.01
    """Loss weight."""

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        return splats.opacities.mean()


@dataclass(frozen=True)
class MeanScale(Regularizer):
    """Mean scale: points shrink to what they are needed for."""

    weight: float = 0.01
    """Loss weight, for scales as a share of the scene extent."""

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        return splats.scales.mean()
