"""Rendered depths of two views that agree (PGSR, multi-view geometric consistency)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import Steps
from surfkit.losses.base import Loss, Sample
from surfkit.losses.two_views import Opposite, agreement, round_trip, spread, surface_depth
from surfkit.raster.api import Maps


@dataclass(frozen=True)
class Reprojection(Loss):
    """Pixels by which a point misses its own when it goes to a neighbouring view and back (PGSR, arXiv 2406.06521).

    A pixel is taken to the neighbour over its rendered depth, and back over the neighbour's, which is held constant.
    The loss is the mean of exp(-error) x error, the weight exp(-error) held constant, over the pixels that come back
    nearer than `limit`; the others are taken for occluded. One more view is rendered in the steps that count.
    """

    reads: ClassVar[tuple[str, ...]] = ("alpha", "depth", "median")
    needs_neighbour: ClassVar[bool] = True

    weight: float = 0.03
    """Share in the objective of the steps that count, for errors in pixels."""

    start: Steps = 7_000
    """Steps without this term, as a surface must form first; 0 has it from the first step."""

    every: int = 3
    """Only steps that are a multiple of this count; 1 has all. Terms with the same number share the rendered view."""

    stride: int = 2
    """One pixel at random is looked at in each square of so many pixels a side; 1 takes all."""

    limit: float = 1.0
    """Errors of more pixels do not count."""

    depth: Literal["median", "expected"] = "expected"
    """Which rendered depth is the surface, in both views: the expected one moves all splats of a pixel."""

    def __post_init__(self) -> None:
        if self.weight < 0 or min(self.every, self.stride) < 1 or not self.limit > 0:
            given = f"weight {self.weight:g}, every {self.every}, stride {self.stride}, limit {self.limit:g}"
            raise BadInput(f"the reprojection loss has {given}; give 0 or more, twice 1 or more, and a limit above 0")

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if index > self.start and index % self.every == 0 else 0.0

    def __call__(self, maps: Maps, sample: Sample) -> Tensor:
        depth, neighbour = surface_depth(maps, self.depth), sample.neighbour
        if neighbour is None:
            return 0 * depth.sum()
        height, width = depth.shape
        camera = sample.view.camera
        y, x = spread((height, width), self.stride, sample.seed)
        at = y * width + x
        rays = camera.rays(depth.dtype).flatten(1)[:, at]
        error, valid = round_trip(depth.flatten()[at], rays, camera, Opposite.of(neighbour, self.depth))
        weight, counts = agreement(error, valid, self.limit)
        return (weight * error).sum() / counts.sum().clamp_min(1)
