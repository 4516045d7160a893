"""Rendered normals against those that stereo has estimated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import log_linear
from surfkit.losses.base import Loss, Target
from surfkit.raster.api import Maps

MIN_NORMAL_LENGTH = 1e-3
"""Rendered normals whose sum over a pixel's splats is shorter point nowhere."""


@dataclass(frozen=True)
class NormalPrior(Loss):
    """One minus the cosine of the angle between the rendered normal and that of the depth prior.

    Both are unit vectors in the camera's axes. The loss is a weighted mean over the pixels that have both, where a
    pixel counts by the confidence of the estimate times the rendered opacity, which is held constant. A data set whose
    priors have no normals gives no loss.
    """

    reads: ClassVar[tuple[str, ...]] = ("alpha", "normal")
    needs_prior: ClassVar[bool] = True
    needs_normals: ClassVar[bool] = True

    start: float = 0.05
    """Loss weight at the first step."""

    end: float = 0.05
    """Loss weight at the last step, reached along a straight line in the logarithm."""

    error: Literal["cosine", "l1", "both"] = "cosine"
    """One minus the cosine, the sum of the absolute differences of the three components, or the sum of the two."""

    def __post_init__(self) -> None:
        if not (self.start > 0 and self.end > 0):
            raise BadInput(
                f"the loss of prior normals has start {self.start:g}, end {self.end:g}; both must be above 0"
            )

    def weight_at(self, index: int, steps: int) -> float:
        return log_linear(self.start, self.end, index / steps)

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        normal = maps.need("normal")
        if target.prior is None or target.prior.normal is None:
            return 0 * normal.sum()
        estimated = target.prior.normal.to(normal)
        square = normal.square().sum(0)
        there = (square.detach() > MIN_NORMAL_LENGTH**2) & (estimated != 0).any(0)
        weight = torch.where(there, target.prior.confidence * maps.need("alpha").detach(), 0)
        rendered = torch.where(there, normal, 0) * torch.where(there, square, 1).rsqrt()
        error = torch.zeros_like(square)
        if self.error != "l1":
            error = error + 1 - (rendered * estimated).sum(0)
        if self.error != "cosine":
            error = error + (rendered - estimated).abs().sum(0)
        return (weight * error).sum() / weight.sum().clamp_min(1)
