"""What GaussianSurfels is trained with beside the photographs (Dai et al. 2024, section on optimisation)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.plugin import BadInput, Loss, Maps, Regularizer, Splats, Target, normals_of


def mean_normals(maps: Maps) -> Tensor:
    """(3, H, W) mean normal of the splats of each pixel, N / (1 - T), at most of length 1; 0 where there are none."""
    alpha = maps.need("alpha")
    return torch.where(alpha > 0, maps.need("normal") / alpha.clamp_min(1e-10), 0.0)


def weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Mean of (H, W) values by a constant (H, W) weight, () in shape; 0 where no weight is above 0."""
    weight = weight.detach()
    return torch.where(weight > 0, weight * values, 0.0).sum() / weight.sum().clamp_min(1)


@dataclass(frozen=True)
class NormalDepthConsistency(Loss):
    """One minus the cosine between the mean normal of the splats and the normal of the rendered depth D / (1 - T)
    (GaussianSurfels, normal-depth consistency loss).

    The mean over the inner pixels whose four neighbours have a depth, weighted by the opacity, which is held constant:
    a photograph of a survey has no silhouette that says which pixels count.
    """

    reads: ClassVar[tuple[str, ...]] = ("alpha", "depth", "normal")

    weight: float = 0.01
    """Loss weight at the first step."""

    gain: float = 0.1
    """What the weight gains up to the middle of the stage, along a straight line; it stays there."""

    def __post_init__(self) -> None:
        if self.weight < 0 or self.gain < 0:
            raise BadInput(
                f"the loss of normal-depth consistency has weight {self.weight:g} and gain {self.gain:g}; give 0 or "
                "more for both"
            )

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight + self.gain * min(2 * index / steps, 1)

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        surface, valid = normals_of(maps.expected_depth(), target.view.camera)
        agreement = (mean_normals(maps)[:, 1:-1, 1:-1] * surface).sum(0)
        return weighted_mean(1 - agreement, maps.need("alpha")[1:-1, 1:-1] * valid)


@dataclass(frozen=True)
class NormalCurvature(Loss):
    """How much the rendered normal changes from pixel to pixel: |dN/dx|_1 + |dN/dy|_1 (GaussianSurfels, curvature
    loss).

    The mean over the pixels of the absolute differences to the pixels at the right and below, of the three components
    of the mean normal. A difference counts by the smaller opacity of its two pixels, which is held constant.
    """

    reads: ClassVar[tuple[str, ...]] = ("alpha", "normal")

    weight: float = 0.005
    """Loss weight."""

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise BadInput(f"the loss of curvature has weight {self.weight:g}; give 0 or more")

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        normal, alpha = mean_normals(maps), maps.need("alpha")
        across = (normal[:, :, 1:] - normal[:, :, :-1]).abs().sum(0)
        down = (normal[:, 1:] - normal[:, :-1]).abs().sum(0)
        return weighted_mean(across, torch.minimum(alpha[:, 1:], alpha[:, :-1])) + weighted_mean(
            down, torch.minimum(alpha[1:], alpha[:-1])
        )


@dataclass(frozen=True)
class BimodalOpacity(Regularizer):
    """Mean of exp(-(opacity - 0.5)^2 / 0.05): points become opaque or fade away (GaussianSurfels, opacity loss)."""

    weight: float = 0.01
    """Loss weight."""

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise BadInput(f"the term of bimodal opacities has weight {self.weight:g}; give 0 or more")

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        return torch.exp(-((splats.opacities - 0.5) ** 2) / 0.05).mean()
