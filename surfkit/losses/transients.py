"""What moved while photographs were taken, and is no part of the scene: people, cars, shadows."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from surfkit.core.check import require_within
from surfkit.core.registry import Component
from surfkit.core.schedule import Steps
from surfkit.losses.base import Target

MOST_OF_BOX = 0.5
"""Inliers of the 3 x 3 pixels around one with which it is an inlier itself (RobustNeRF, section 4)."""
MOST_OF_NEIGHBOURHOOD = 0.6
"""Inliers of the neighbourhood of a pixel with which it is kept (RobustNeRF, section 4, of patches)."""


class Transients(Component):
    """Finds the pixels of a photograph that show something passing, which no loss is to learn.

    Such pixels are treated as those that a mask of the data set covers: they have no gradient in any loss, and none of
    those that densification looks at. Nothing is kept from step to step, so that a resumed run has the same bits.
    """

    @abstractmethod
    def kept(self, color: Tensor, target: Target, index: int, steps: int) -> Tensor | None:
        """(H, W) bool, False where the photograph is to be ignored in step `index` of 1..`steps`; None ignores nothing.

        Pixels that the data set's mask covers are ignored whatever is said of them here.

        Args:
            color: (3, H, W) the render as this photograph would show it, after its appearance; constant.
            target: The photograph, its mask and the seed of random draws.
            index: The step.
            steps: Of the stage.
        """


@dataclass(frozen=True)
class Robust(Transients):
    """Areas of a photograph that differ most from the render are left out (RobustNeRF, section 4).

    A pixel is an inlier if its residual is among the lowest `inliers` of the photograph. Single pixels go with most of
    the 3 x 3 around them, and then a pixel is left out only if too many around it are outliers: edges that are not
    sharp yet are thin, and stay. The paper does the last with patches of 8 pixels amid 16, as it draws patches of rays;
    here every pixel is the middle of such a neighbourhood, which follows outlines better. Nothing is left out at first,
    as in SpotLessSplats: a render that is not there yet differs everywhere.
    """

    inliers: float = 0.8
    """Share of a photograph's pixels, those of the lowest residuals, that are surely of the scene: 0.5 to 1; 1 leaves
    nothing out."""

    radius_px: int = 8
    """Pixels on each side of one that decide with it whether it is left out. Smaller objects are not found."""

    start: Steps = 15_000
    """Steps before anything is left out. Too soon, and parts of the scene that are not learnt yet are left out too, and
    never learnt: on Shibuya, a start at a tenth of the run gains nothing."""

    def __post_init__(self) -> None:
        require_within({"inliers": (0.5, 1), "radius_px": (1, 1000), "start": (0, float("inf"))}, self)

    def kept(self, color: Tensor, target: Target, index: int, steps: int) -> Tensor | None:
        if index <= self.start or self.inliers == 1:
            return None
        residual = (color - target.photo).abs().sum(0)
        return kept_areas(inliers_of(residual, self.inliers, target.mask), target.mask, self.radius_px)


def inliers_of(residual: Tensor, share: float, mask: Tensor | None) -> Tensor:
    """(H, W) bool, the residual is at most the quantile of those that count (RobustNeRF, section 4).

    Args:
        residual: (H, W).
        share: Of the quantile, above 0 and at most 1.
        mask: (H, W) bool, False where the photograph does not count.
    """
    known = residual.flatten() if mask is None else residual[mask]
    if not len(known):
        return torch.ones_like(residual, dtype=torch.bool)
    return residual <= known.kthvalue(max(1, round(share * len(known)))).values


def kept_areas(inlier: Tensor, mask: Tensor | None, radius_px: int) -> Tensor:
    """(H, W) bool, pixels amid inliers, once these are smoothed (RobustNeRF, section 4).

    Pixels beyond the picture and under the mask do not count: shares are of those that do.

    Args:
        inlier: (H, W) bool.
        mask: (H, W) bool, False where the photograph does not count.
        radius_px: Of the neighbourhood, a square.
    """
    counts = torch.ones_like(inlier) if mask is None else mask
    for radius, share in ((1, MOST_OF_BOX), (radius_px, MOST_OF_NEIGHBOURHOOD)):
        of = _sums_around(counts, radius).double()  # in float32, 0.6 of 160 is more than 96
        inlier = _sums_around(inlier & counts, radius) >= share * of
    return inlier


def _sums_around(values: Tensor, radius: int) -> Tensor:
    """(H, W) int32, how many of (H, W) bool are true in the square around each pixel; exact, in time that no radius
    changes."""
    sums = values.to(torch.int32)
    for axis, length in enumerate(values.shape):
        ends = (radius + 1, radius)
        before = pad(sums, ends if axis else (0, 0, *ends)).cumsum(axis, dtype=torch.int32)
        sums = before.narrow(axis, 2 * radius + 1, length) - before.narrow(axis, 0, length)
    return sums
