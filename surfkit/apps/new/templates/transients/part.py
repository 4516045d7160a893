"""A limit of the colour error, beyond which a pixel shows something else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.plugin import BadInput, Steps, Target, Transients
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Transients):
    """Pixels are left out where a colour is further off than a limit."""

    limit: float = 0.4
    """Largest colour error of a pixel that counts, of colours in [0, 1]."""

    start: Steps = 3_000
    """Steps before anything is left out."""

    def __post_init__(self) -> None:
        if self.limit <= 0:
            raise BadInput(f"new-part.limit is {self.limit}; it must be more than 0")

    def kept(self, color: Tensor, target: Target, index: int, steps: int) -> Tensor | None:
        """See `Transients.kept`."""
        return None if index <= self.start else (color - target.photo).abs().amax(0) <= self.limit


CHANGE: Mapping[str, Any] = {"pretrain.transients": NewPart()}
"""What puts the part into a recipe, by dotted path."""
