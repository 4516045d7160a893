"""Rendered depth against estimated depth (CityGaussianV2, section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import log_linear
from surfkit.losses.base import Loss, Sample
from surfkit.raster.api import Maps
from surfkit.raster.ssim import ssim


@dataclass(frozen=True)
class DepthRegression(Loss):
    """Difference of inverse depths, rendered and estimated, |D_hat - D| (CityGaussianV2, section 3.2).

    Inverse depths are divided by one that is typical of the data set, so that no unit matters; pixels count by the
    confidence of the estimate, and those without a rendered or an estimated depth do not count.
    """

    reads: ClassVar[tuple[str, ...]] = ("median",)
    needs_prior: ClassVar[bool] = True

    start: float = 0.5
    """Share in the objective at the first step; it falls exponentially."""

    end: float = 0.0025
    """Share in the objective at the last step: estimates are coarser than what was learnt by then."""

    error: Literal["l1", "ssim"] = "l1"
    """Mean absolute difference, as in the paper, or one minus the structural similarity, as in the released code."""

    def __post_init__(self) -> None:
        if not (self.start > 0 and self.end > 0):
            raise BadInput(f"the depth loss has start {self.start:g} and end {self.end:g}; both must be above 0")

    def weight_at(self, index: int, steps: int) -> float:
        return log_linear(self.start, self.end, index / steps)

    def __call__(self, maps: Maps, sample: Sample) -> Tensor:
        prior = sample.prior
        if prior is None:
            return 0 * maps.median.sum()
        there = (maps.median > 0) & (prior.inverse > 0)
        weight = torch.where(there, prior.confidence, 0)
        rendered = weight / (torch.where(there, maps.median, 1) * prior.typical)
        estimated = weight * prior.inverse / prior.typical
        if self.error == "ssim":
            return 1 - ssim(rendered[None], estimated[None])
        return (rendered - estimated).abs().sum() / weight.sum().clamp_min(1)
