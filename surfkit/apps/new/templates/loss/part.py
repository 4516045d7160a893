"""A loss that compares rendered colours with the photograph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.plugin import BadInput, Loss, Maps, Target
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Loss):
    """Charbonnier loss: absolute colour error that is smooth at 0, sqrt(d^2 + epsilon^2)."""

    weight: float = 0.8
    """Loss weight."""

    epsilon: float = 0.001
    """Colour difference below which the loss is nearly quadratic."""

    def __post_init__(self) -> None:
        if self.epsilon <= 0:
            raise BadInput(f"new-part.epsilon is {self.epsilon}; it must be more than 0")

    def weight_at(self, index: int, steps: int) -> float:
        """The same at every step."""
        return self.weight

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        """The mean over pixels and channels."""
        return ((maps.need("color") - target.photo) ** 2 + self.epsilon**2).sqrt().mean()


CHANGE: Mapping[str, Any] = {"pretrain.losses.l1": NewPart()}
"""What puts the part into a recipe, by dotted path."""
