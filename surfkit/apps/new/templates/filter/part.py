"""A condition on the opacity of points that are densified."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.plugin import BadInput, Filter, Step
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Filter):
    """Do not densify points that are nearly transparent."""

    least: float = 0.05
    """Opacity above which a point may be densified."""

    def __post_init__(self) -> None:
        if not 0 <= self.least < 1:
            raise BadInput(f"new-part.least is {self.least}; it must be 0 or more and below 1")

    def admits(self, step: Step, want: Tensor) -> Tensor:
        """(N,) bool, the points that are opaque enough."""
        return step.splats.opacities > self.least


CHANGE: Mapping[str, Any] = {"pretrain.densify.filters": (NewPart(),)}
"""What puts the part into a recipe, by dotted path."""
