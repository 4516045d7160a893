"""Losses of PGSR that surfkit does not have: normals that follow the image, and points that become flat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.plugin import BadInput, Loss, Maps, Regularizer, Splats, Steps, Target
from surfkit.raster.normals import normals_of


@dataclass(frozen=True)
class EdgeAwareNormal(Loss):
    """Splats' normals against the normals of the rendered depth, with less weight at image edges (PGSR, single-view
    geometric loss).

    The mean over the inner pixels of (1 - g)^power |N - alpha n|_1, where N is the blended normal, n that of the
    expected depth, and g in [0, 1] the gradient of the photograph over its largest: depth has its edges there too.
    """

    reads: ClassVar[tuple[str, ...]] = ("alpha", "depth", "normal")

    weight: float = 0.015
    """Loss weight, from `start` on."""

    start: Steps = 7_000
    """Steps without this term, as a surface must form first; 0 has it from the first step."""

    power: float = 2.0
    """Exponent of the weight of a pixel: 2 in the released settings, 5 in the paper."""

    def __post_init__(self) -> None:
        if self.weight < 0 or not 0 <= self.power <= 100:
            raise BadInput(
                f"the edge-aware normal loss has weight {self.weight:g} and power {self.power:g}; give a weight of 0 "
                "or more and a power from 0 to 100"
            )

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if index > self.start else 0.0

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        depth, normal = maps.expected_depth(), maps.need("normal")
        surface, valid = normals_of(depth, target.view.camera)
        if valid.numel() == 0:
            return 0 * (depth.sum() + normal.sum())
        alpha = maps.need("alpha").detach()[1:-1, 1:-1]
        apart = (normal[:, 1:-1, 1:-1] - alpha * surface).abs().sum(0)
        weight = (1 - edges(target.photo)) ** self.power
        return torch.where(valid, weight * apart, 0.0).sum() / valid.numel()


def edges(photo: Tensor) -> Tensor:
    """(H - 2, W - 2) length of the gradient of the mean colour at the inner pixels, over the largest one; 0 if all are.

    Args:
        photo: (3, H, W).
    """
    grey = photo.detach().mean(0)
    across = (grey[1:-1, 2:] - grey[1:-1, :-2]) / 2
    down = (grey[2:, 1:-1] - grey[:-2, 1:-1]) / 2
    length = torch.hypot(across, down)
    return length / length.max().clamp_min(1e-12)


@dataclass(frozen=True)
class MeanThickness(Regularizer):
    """Mean of the smallest scale of the points that the view shows: points become flat (PGSR, NeuSG)."""

    only_seen: ClassVar[bool] = True

    weight: float = 100.0
    """Loss weight, for scales as a share of the scene extent."""

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise BadInput(f"the mean thickness has weight {self.weight:g}; give 0 or more")

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        return splats.scales.amin(-1).sum() / max(1, len(splats))
