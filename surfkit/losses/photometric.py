"""How far a rendered colour is from the photograph (3DGS, loss of L1 and D-SSIM)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from surfkit.losses.base import Loss, Target
from surfkit.raster.api import Maps
from surfkit.raster.ssim import ssim


@dataclass(frozen=True)
class L1(Loss):
    """Mean absolute colour error."""

    weight: float = 0.8
    """Loss weight."""

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        return (maps.need("color") - target.photo).abs().mean()


@dataclass(frozen=True)
class SSIM(Loss):
    """One minus the structural similarity with the photograph (11 x 11 window, sigma 1.5)."""

    of_structure: ClassVar[bool] = True

    weight: float = 0.2
    """Loss weight."""

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        return 1 - ssim(maps.need("color"), target.photo)
