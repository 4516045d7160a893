"""A loss term on the shapes of the points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.plugin import BadInput, Regularizer, Splats
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Regularizer):
    """Penalise needles: the mean logarithm of the longest over the second longest axis, beyond a limit."""

    weight: float = 0.01
    """Loss weight."""

    ratio: float = 10.0
    """Ratio of the two axes up to which nothing is penalised."""

    def __post_init__(self) -> None:
        if self.ratio < 1:
            raise BadInput(f"new-part.ratio is {self.ratio}; it must be 1 or more")

    def weight_at(self, index: int, steps: int) -> float:
        """The same at every step."""
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        """The mean over the points."""
        longest, second = splats.scales.topk(2, dim=1).values.unbind(1)
        return (longest / (self.ratio * second)).log().clamp_min(0).mean()


CHANGE: Mapping[str, Any] = {"pretrain.regularizers.new-part": NewPart()}
"""What puts the part into a recipe, by dotted path."""
