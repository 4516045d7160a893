"""A loss term that keeps the Gaussians of anchors small."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from surfkit.plugin import Regularizer, Splats


@dataclass(frozen=True)
class AnchorVolume(Regularizer):
    """Mean, over the anchors that a view shows, of the product of the three scales that bound those of their Gaussians;
    Scaffold-GS takes the Gaussians themselves, whose scales are these times factors below 1."""

    only_seen: ClassVar[bool] = True

    weight: float = 0.01
    """Loss weight, for scales as a share of the scene extent."""

    def weight_at(self, index: int, steps: int) -> float:
        """The same at each step."""
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        """The mean; of splats that are no anchors, of the product of their own scales."""
        sizes = splats.extra["sizes"][:, 3:] if "sizes" in splats.extra else splats.scales
        return sizes.prod(-1).sum() / max(1, len(sizes))
