"""Which views a block is tuned on."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.core.registry import Component
from surfkit.partition.base import CoarseModel
from surfkit.raster.ssim import ssim


class Assign(Component):
    """A way to find the views that a block matters to; those with their camera inside always join."""

    @abstractmethod
    def measure(self, sight: CoarseModel, owner: Tensor, count: int) -> Tensor:
        """(V, B) how much each of `count` blocks matters to each view; `owner` is the block of each splat, (N,)."""

    @property
    @abstractmethod
    def least(self) -> float:
        """A view joins a block that matters more than this."""


@dataclass(frozen=True)
class SSIMDifference(Assign):
    """How much the picture changes without the block: 1 - SSIM (CityGaussianV2, sec. 3.3)."""

    threshold: float = 0.05
    """Smallest difference with which a view joins; 0.01 for streets."""

    def __post_init__(self) -> None:
        check_threshold(self.threshold, "ssim-difference")

    @property
    def least(self) -> float:
        """See `Assign.least`."""
        return self.threshold

    def measure(self, sight: CoarseModel, owner: Tensor, count: int) -> Tensor:
        """Draw each view once whole, and once without each block of which it shows anything."""
        difference = torch.zeros(len(sight.views), count)
        for at, view in enumerate(sight.views):
            whole = sight.rasterizer.render(sight.splats, view.camera, sight.near, geometry=False)
            for block in owner[whole.seen].unique().tolist():
                without = replace(sight.splats, opacities=sight.splats.opacities * (owner != block))
                rest = sight.rasterizer.render(without, view.camera, sight.near, geometry=False)
                difference[at, block] = 1 - ssim(rest.maps.color, whole.maps.color)
            emit(Progress("assigning views", at + 1, len(sight.views)))
        return difference


@dataclass(frozen=True)
class PictureShare(Assign):
    """The part of the picture that the block makes up, from one pass over each view.

    Without the block that part is black, and unlike the picture: 1 - SSIM is about the share, and both ways choose
    nearly the same views at the same threshold (`bench/assign.py`).
    """

    threshold: float = 0.05
    """Smallest share with which a view joins."""

    def __post_init__(self) -> None:
        check_threshold(self.threshold, "picture-share")

    @property
    def least(self) -> float:
        """See `Assign.least`."""
        return self.threshold

    def measure(self, sight: CoarseModel, owner: Tensor, count: int) -> Tensor:
        """Sum the shares of the splats of each block."""
        share = torch.zeros(len(sight.views), count)
        for at in range(len(sight.views)):
            share[at].index_add_(0, owner, sight.share(at).float())
            emit(Progress("assigning views", at + 1, len(sight.views)))
        return share


def check_threshold(threshold: float, name: str) -> None:
    """BadInput unless some view can join."""
    if not 0 <= threshold < 1:
        raise BadInput(f"assign: {name}.threshold is {threshold}; it must be 0 or more and below 1")
