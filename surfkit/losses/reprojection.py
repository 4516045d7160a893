"""Rendered depths of two views that agree (PGSR, multi-view geometric consistency)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.losses.base import Loss, Target
from surfkit.losses.two_views import Opposite, TwoViews, agreement, round_trip, spread, surface_depth
from surfkit.raster.api import Maps


@dataclass(frozen=True)
class Reprojection(TwoViews, Loss):
    """Pixels by which a point misses its own when it goes to a neighbouring view and back (PGSR, arXiv 2406.06521).

    A pixel is taken to the neighbour over its rendered depth, and back over the neighbour's, which is held constant.
    The loss is the mean of exp(-error) x error, the weight exp(-error) held constant, over the pixels that come back
    nearer than `limit`; the others are taken for occluded. One more view is rendered in the steps that count.
    """

    reads: ClassVar[tuple[str, ...]] = ("alpha", "depth", "median")

    weight: float = 0.03
    """Loss weight in the steps that have the term, for errors in pixels."""

    stride: int = 2
    """One pixel at random is looked at in each square of so many pixels a side; 1 takes all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stride < 1:
            raise BadInput(f"Reprojection has stride {self.stride}; it must be 1 or more")

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        depth, neighbour = surface_depth(maps, self.depth), target.neighbour
        if neighbour is None:
            return 0 * depth.sum()
        height, width = depth.shape
        camera = target.view.camera
        y, x = spread((height, width), self.stride, target.seed, depth.device)
        at = y * width + x
        rays = camera.rays(depth.dtype, depth.device).flatten(1)[:, at]
        error, valid = round_trip(depth.flatten()[at], rays, camera, Opposite.of(neighbour, self.depth))
        weight, counts = agreement(error, valid, self.limit)
        return (weight * error).sum() / counts.sum().clamp_min(1)
