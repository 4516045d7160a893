"""Rendered depth against estimated depth (CityGaussianV2, section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import log_linear
from surfkit.losses.base import Loss, Target
from surfkit.raster.api import Maps
from surfkit.raster.ssim import ssim_map
from surfkit.scene.align import SCALE_BAND

DEPTH_MAPS = {"median": ("median",), "expected": ("alpha", "depth")}
"""The maps that a term on depth reads, by the depth that it compares."""


@dataclass(frozen=True)
class DepthRegression(Loss):
    """Difference of inverse depths, rendered and estimated, |D_hat - D| (CityGaussianV2, section 3.2).

    Inverse depths are divided by one that is typical of the data set, so that no unit matters. Either error is a mean
    over the pixels with a rendered and an estimated depth, weighted by the confidence of the estimate.
    """

    needs_prior: ClassVar[bool] = True

    start: float = 0.5
    """Loss weight at the first step; from there to `end` along a straight line in the logarithm, constant
    where both are the same."""

    end: float = 0.0025
    """Loss weight at the last step: small for estimates that are coarser than what was learnt by then, as
    large as `start` or larger for those to be trusted to the end."""

    error: Literal["l1", "ssim"] = "l1"
    """Absolute difference, as in the paper, or one minus the structural similarity, as in the released code."""

    depth: Literal["median", "expected"] = "median"
    """Which rendered depth is compared: that of the splat where a ray becomes half opaque, or the mean along the ray,
    from which all its splats learn."""

    scale_band: tuple[float, float] = SCALE_BAND
    """Depth priors that are known up to their scale are not used where it is below or above these multiples of the
    median over all photographs; the released code of CityGaussianV2 has 0.01 and 50 for streets."""

    def __post_init__(self) -> None:
        require_weights_and_band("depth", (self.start, self.end), self.scale_band)

    @property
    def reads(self) -> tuple[str, ...]:  # type: ignore[override]  # it depends on a setting
        """The maps of the depth that is compared."""
        return DEPTH_MAPS[self.depth]

    def weight_at(self, index: int, steps: int) -> float:
        return log_linear(self.start, self.end, index / steps)

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        rendered, estimated, weight = inverse_depths(maps, target, self.depth)
        if self.error == "ssim":
            difference = 1 - ssim_map(rendered[None], estimated[None])[0]
        else:
            difference = (rendered - estimated).abs()
        return (weight * difference).sum() / weight.sum().clamp_min(1)


def inverse_depths(maps: Maps, target: Target, depth: Literal["median", "expected"]) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse depth as rendered and as estimated, and how much each pixel counts.

    Args:
        maps: Of a view.
        target: Its depth prior; without one, nothing counts.
        depth: Which rendered depth.

    Returns:
        (H, W) multiples of the inverse depth that is typical of the data set, rendered and estimated, and the (H, W)
        confidence of the estimate; all are 0 where either depth is unknown.
    """
    seen = maps.need("median") if depth == "median" else maps.expected_depth()
    if (prior := target.prior) is None:
        return 0 * seen, torch.zeros_like(seen), torch.zeros_like(seen)
    there = (seen > 0) & (prior.inverse > 0)
    rendered = torch.where(there, 1 / (torch.where(there, seen, 1) * prior.typical), 0)
    return rendered, torch.where(there, prior.inverse / prior.typical, 0), torch.where(there, prior.confidence, 0)


def require_weights_and_band(name: str, weights: tuple[float, float], band: tuple[float, float]) -> None:
    """Refuse settings of a term on depth.

    Raises:
        BadInput: A weight is not above 0, or the band does not hold 1.
    """
    if not min(weights) > 0:
        raise BadInput(f"the {name} loss has start {weights[0]:g} and end {weights[1]:g}; both must be above 0")
    if not 0 < band[0] <= 1 <= band[1] < float("inf"):
        raise BadInput(
            f"the {name} loss has scale_band {band[0]:g} {band[1]:g}; give a multiple above 0 and at most 1, and one "
            "of at least 1"
        )
