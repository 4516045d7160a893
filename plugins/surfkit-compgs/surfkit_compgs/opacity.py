"""Opacities cost something for a while, so that points fade that explain nothing (CompGS, Navaneet et al. 2024)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from surfkit.plugin import BadInput, Regularizer, Splats, Steps


@dataclass(frozen=True)
class OpacitySum(Regularizer):
    """Sum of all opacities, in some of the steps (CompGS, Navaneet et al. ECCV 2024, section 3).

    `regularizer:mean-opacity` is the mean, of all steps. A sum pulls at each point alike, however many there are.
    """

    weight: float = 1e-7
    """Loss weight (lambda_reg)."""

    start: Steps = 15_000
    """Last step without this term."""

    until: Steps = 20_000
    """Last step with it."""

    def __post_init__(self) -> None:
        if not 0 <= self.weight < math.inf:
            raise BadInput(f"regularizer:opacity-sum: weight is {self.weight:g}; it must be 0 or more")
        if not 0 <= self.start <= self.until:
            raise BadInput(
                f"regularizer:opacity-sum: start is {self.start} and until {self.until}; give 0 <= start <= until"
            )

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if self.start < index <= self.until else 0.0

    def __call__(self, splats: Splats) -> Tensor:
        return splats.opacities.sum()
