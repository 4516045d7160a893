"""What makes surfels a surface (2DGS, section 5): normals that agree with depth, and no spread along rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import Steps, log_linear
from surfkit.io.datasets.depth_prior import MIN_KNOWN_CONFIDENCE
from surfkit.losses.base import Loss, Target
from surfkit.raster.api import Maps
from surfkit.raster.normals import disagreement


@dataclass(frozen=True)
class NormalConsistency(Loss):
    """Splats' normals against the normals of the rendered depth (2DGS, normal consistency)."""

    reads: ClassVar[tuple[str, ...]] = ("alpha", "depth", "median", "normal")

    weight: float = 0.0125
    """Loss weight, from `start` on."""

    end: float | None = None
    """Loss weight at the last step, reached along a straight line in the logarithm; constant if unset."""

    start: Steps = 7_000
    """Steps without this term, as a surface must form first; 0 has it from the first step."""

    depth: Literal["median", "expected"] = "median"
    """Which rendered depth is the surface."""

    where: Literal["everywhere", "unknown"] = "everywhere"
    """Pixels that count: all, or those of which a depth prior knows nothing, as on a road without texture. Where it
    knows the depth, that says where the surface is, and its errors are not smoothed into place. In a photograph without
    a depth prior, all pixels count."""

    @property
    def needs_prior(self) -> bool:  # type: ignore[override]  # it depends on a setting
        """Whether depth priors say where it counts."""
        return self.where == "unknown"

    def __post_init__(self) -> None:
        if self.weight < 0 or (self.end is not None and not (self.weight > 0 and self.end > 0)):
            raise BadInput(
                f"the normal loss goes from {self.weight} to {self.end}; weights must be above 0 (or a constant 0)"
            )

    def weight_at(self, index: int, steps: int) -> float:
        if index <= self.start:
            return 0.0
        if self.end is None:
            return self.weight
        return log_linear(self.weight, self.end, (index - self.start) / max(1, steps - self.start))

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        depth = maps.need("median") if self.depth == "median" else maps.expected_depth()
        if self.where == "unknown" and target.prior is not None:
            depth = torch.where(target.prior.confidence < MIN_KNOWN_CONFIDENCE, depth, 0.0)
        return disagreement(depth, maps.need("alpha"), maps.need("normal"), target.view.camera)


@dataclass(frozen=True)
class Distortion(Loss):
    """Spread of the splats along each ray, in inverse depth (2DGS, depth distortion)."""

    reads: ClassVar[tuple[str, ...]] = ("alpha", "distortion")

    weight: float = 0.0
    """Loss weight; the paper finds that it harms large scenes."""

    start: Steps = 3_000
    """First step that counts."""

    unit: float = 0.04
    """Depth at which the inverse depth counts as 1, as a share of the scene extent (2DGS: 0.2 scene units)."""

    normalise: bool = False
    """Divide the spread of each pixel by its squared alpha, so that faint pixels count as much as opaque ones (GOF)."""

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if index > self.start else 0.0

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        spread = maps.need("distortion")
        if self.normalise:
            spread = spread / (maps.need("alpha").square() + 1e-7)
        return spread.mean() * self.unit**2
