"""Which views a block is tuned on."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.core.registry import Component
from surfkit.partition.base import Cells, CoarseModel
from surfkit.raster.ssim import ssim


class Assign(Component):
    """A way to find the views that a block is tuned on."""

    needs_observations: ClassVar[bool] = False
    """Whether it looks at the sparse points that each view shows; only then are they read."""

    @abstractmethod
    def joins(self, sight: CoarseModel, cells: Cells) -> Tensor:
        """(V, B) bool, which views each block is tuned on.

        What is drawn by chance is drawn from the seed of `sight`, and is the same again.
        """

    @property
    def most_views(self) -> int | None:
        """A block has at most so many views, drawn by chance where more join; None for no limit."""
        return None


def inside(sight: CoarseModel, cells: Cells) -> Tensor:
    """(V, B) bool, which cameras stand in each block."""
    return torch.nn.functional.one_hot(cells.owner(sight.centres), cells.count).bool()


@dataclass(frozen=True)
class SSIMDifference(Assign):
    """How much the picture changes without the block: 1 - SSIM (CityGaussianV2, sec. 3.3)."""

    threshold: float = 0.05
    """Smallest difference with which a view joins; 0.01 for streets."""

    def __post_init__(self) -> None:
        check_threshold(self.threshold, "ssim-difference")

    def joins(self, sight: CoarseModel, cells: Cells) -> Tensor:
        """See `Assign.joins`; those with their camera inside always join."""
        owner = cells.owner(sight.splats.means)
        return inside(sight, cells) | (self.measure(sight, owner, cells.count) > self.threshold)

    def measure(self, sight: CoarseModel, owner: Tensor, count: int) -> Tensor:
        """(V, B) how much a view changes without each of `count` blocks; `owner` is the block of each splat, (N,).

        Each view is drawn once whole, and once without each block of which it shows anything.
        """
        difference = torch.zeros(len(sight.views), count)
        device = sight.rasterizer.where()
        splats, owner = sight.splats.to(device), owner.to(device)
        for at, view in enumerate(sight.views):
            whole, found = sight.rasterizer.render(splats, view.camera, sight.near, geometry=False), []
            blocks = owner[whole.seen].unique().tolist()
            for block in blocks:
                without = replace(splats, opacities=splats.opacities * (owner != block))
                rest = sight.rasterizer.render(without, view.camera, sight.near, geometry=False)
                found.append(1 - ssim(rest.maps.need("color"), whole.maps.need("color")))
            if blocks:
                difference[at, blocks] = torch.stack(found).cpu()
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

    def joins(self, sight: CoarseModel, cells: Cells) -> Tensor:
        """See `Assign.joins`; those with their camera inside always join."""
        owner = cells.owner(sight.splats.means)
        return inside(sight, cells) | (self.measure(sight, owner, cells.count) > self.threshold)

    def measure(self, sight: CoarseModel, owner: Tensor, count: int) -> Tensor:
        """(V, B) the share of a view that each of `count` blocks makes up; `owner` is the block of each splat, (N,)."""
        share = torch.zeros(len(sight.views), count)
        for at in range(len(sight.views)):
            share[at].index_add_(0, owner, sight.share(at).float())
            emit(Progress("assigning views", at + 1, len(sight.views)))
        return share


def check_threshold(threshold: float, name: str) -> None:
    """BadInput unless some view can join."""
    if not 0 <= threshold < 1:
        raise BadInput(f"assign: {name}.threshold is {threshold}; it must be 0 or more and below 1")
