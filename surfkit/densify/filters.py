"""Conditions that a point must meet to multiply."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.densify.base import Filter


@dataclass(frozen=True)
class Elongation(Filter):
    """Keep needles from multiplying: they shrink to dots in far views and gather gradient (CityGaussianV2, 3.2)."""

    min_ratio: float = 0.01
    """Least ratio of the shortest to the longest axis of a point that may multiply."""

    def __post_init__(self) -> None:
        if not 0 <= self.min_ratio <= 1:
            raise BadInput(f"min_ratio is {self.min_ratio}; it must lie between 0 and 1")

    def admits(self, scales: Tensor) -> Tensor:
        """Points that are round enough."""
        return scales.amin(-1) >= self.min_ratio * scales.amax(-1)
