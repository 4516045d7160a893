"""Rendered depth against estimated depth, patch by patch, whatever scale and shift the estimate has there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import log_linear
from surfkit.losses.base import Loss, Target
from surfkit.losses.depth import DEPTH_MAPS, inverse_depths, require_weights_and_band
from surfkit.raster.api import Maps
from surfkit.scene.align import SCALE_BAND

KNOWN_SHARE = 0.25
"""A patch of which less is known, as a share of its pixels, says nothing of its shape."""
FLAT = 1e-3
"""Spread below which inverse depth counts as constant, as a multiple of the typical one: a wall that is seen from the
front has no relief that could be compared."""


@dataclass(frozen=True)
class PatchDepth(Loss):
    """Squared difference of inverse depths, rendered and estimated, each less its mean over a patch of the picture and
    over its spread (DNGaussian, Li et al. CVPR 2024; the depth constraint that GeoSVR, NeurIPS 2025, begins with).

    Spread is the standard deviation over the patch in one half of the term, so that the estimate may have any scale and
    shift there, and over the whole picture in the other, so that patches keep their relief beside one another.
    Monocular depth is right in the small and drifts across a photograph, which one scale and shift for all of it
    (`losses:depth`) cannot follow. The term says nothing of where a surface lies: that is left to the photographs.
    """

    needs_prior: ClassVar[bool] = True

    start: float = 0.1
    """Loss weight at the first step; from there to `end` along a straight line in the logarithm."""

    end: float = 0.1
    """Loss weight at the last step."""

    patch: int = 16
    """Side of a patch, pixels; the grid of patches lies elsewhere in each step."""

    depth: Literal["median", "expected"] = "expected"
    """Which rendered depth is compared: that of the splat where a ray becomes half opaque, or the mean along the ray,
    from which all its splats learn."""

    scale_band: tuple[float, float] = SCALE_BAND
    """Depth priors that are known up to their scale are not used where it is below or above these multiples of the
    median over all photographs."""

    def __post_init__(self) -> None:
        require_weights_and_band("patch-depth", (self.start, self.end), self.scale_band)
        if self.patch < 4:
            raise BadInput(f"the patch-depth loss has patches of {self.patch} pixels; give 4 or more")

    @property
    def reads(self) -> tuple[str, ...]:  # type: ignore[override]  # it depends on a setting
        """The maps of the depth that is compared."""
        return DEPTH_MAPS[self.depth]

    def weight_at(self, index: int, steps: int) -> float:
        return log_linear(self.start, self.end, index / steps)

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        rendered, estimated, weight = inverse_depths(maps, target, self.depth)
        side = min(self.patch, *weight.shape)
        weights = patches(weight, side, target.seed)
        weights = weights * (weights.sum(1, keepdim=True) >= KNOWN_SHARE * side * side)
        near, far = [], []
        for values in (rendered, estimated):
            apart = centred(patches(values, side, target.seed), weights)
            near.append(apart / spread(apart, weights))
            whole = weight.reshape(1, -1)
            far.append(apart / spread(centred(values.reshape(1, -1), whole), whole))
        squared = (near[0] - near[1]).square() + (far[0] - far[1]).square()
        return (weights * squared).sum() / 2 / weights.sum().clamp_min(1)


def patches(image: Tensor, side: int, seed: int) -> Tensor:
    """(P, side^2) whole patches of an (H, W) picture, of a grid whose place is drawn by the seed."""
    height, width = image.shape
    top, left = seed % min(side, height - side + 1), seed // side % min(side, width - side + 1)
    rows, columns = (height - top) // side, (width - left) // side
    cut = image[top : top + rows * side, left : left + columns * side]
    return cut.reshape(rows, side, columns, side).transpose(1, 2).reshape(rows * columns, side * side)


def centred(values: Tensor, weights: Tensor) -> Tensor:
    """(P, K) values of patches less their weighted means."""
    return values - (weights * values).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp_min(1e-12)


def spread(apart: Tensor, weights: Tensor) -> Tensor:
    """(P, 1) weighted standard deviations of (P, K) values of mean 0, and no less than `FLAT`."""
    variance = (weights * apart.square()).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp_min(1e-12)
    return (variance + FLAT**2).sqrt()
