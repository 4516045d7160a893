"""A mixture of gradients that drives densification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.plugin import BadInput, Signal
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Signal):
    """The gradient of chosen losses and that of all of them, weighed."""

    terms: tuple[str, ...] | None = ("ssim",)
    """Losses, by name, whose gradient is computed separately."""

    share: float = 0.5
    """Weight of the gradient of the chosen losses; that of all has the rest."""

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise BadInput(f"new-part.share is {self.share}; it must be 0 to 1")
        if not self.terms:
            raise BadInput("new-part.terms is empty; name a loss")

    def combine(self, chosen: Tensor, total: Tensor) -> Tensor:
        """(N, 2) the weighted sum."""
        return self.share * chosen + (1 - self.share) * total


CHANGE: Mapping[str, Any] = {"pretrain.signal": NewPart()}
"""What puts the part into a recipe, by dotted path."""
