"""A factor for the colours of each photograph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from surfkit.plugin import Appearance, BadInput, Camera, Columns, Primitive, log_linear
from torch import Tensor

SH0 = 0.28209479177387814
"""The spherical harmonic of degree 0: a colour is 0.5 + SH0 x coefficient."""


@dataclass(frozen=True)
class NewPart(Appearance):
    """A brightness and white balance for each photograph: one factor for each colour channel."""

    start: float = 0.01
    """Learning rate at the first step."""

    end: float = 0.001
    """Learning rate at the last step."""

    def __post_init__(self) -> None:
        if not (self.start > 0 and self.end > 0):
            raise BadInput(f"new-part.start {self.start}, end {self.end}: both must be above 0")

    def refuse_unfit(self, primitive: Primitive) -> None:
        """See `Appearance.refuse_unfit`."""
        if lacking := {"sh0", "sh_rest"} - set(primitive.columns()):
            raise BadInput(f"new-part: the primitive has no {' and '.join(sorted(lacking))}")

    def begin(self, count: int) -> Tensor:
        """(V, 3) logarithms of the factors."""
        return torch.zeros(count, 3)

    def rate_at(self, index: int, steps: int) -> float:
        """From `start` to `end`, along a straight line in the logarithm."""
        return log_linear(self.start, self.end, index / steps)

    def __call__(self, numbers: Tensor, color: Tensor, camera: Camera) -> Tensor:
        """(3, H, W) the colours times their factors."""
        return color * numbers.exp()[:, None, None]

    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """The colours of all points times the geometric mean of the factors."""
        factor = numbers.mean(0).exp().to(params["sh0"])
        sh0 = factor * params["sh0"] + 0.5 * (factor - 1) / SH0
        return params | {"sh0": sh0, "sh_rest": params["sh_rest"] * factor}


CHANGE: Mapping[str, Any] = {"pretrain.appearance": NewPart()}
"""What puts the part into a recipe, by dotted path."""
