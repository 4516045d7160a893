"""Exposure of each photograph as two numbers (PGSR, exposure compensation)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.plugin import SH_C0, Appearance, BadInput, Camera, Columns, Primitive, Steps, name_of


@dataclass(frozen=True)
class GainOffset(Appearance):
    """A gain and an offset per photograph, exp(a) c + b for all colours alike (PGSR, exposure compensation)."""

    rate: float = 1e-3
    """Learning rate."""

    start: Steps = 1_000
    """Steps before the first change, as colours must settle first."""

    def __post_init__(self) -> None:
        if not 0 < self.rate <= 1:
            raise BadInput(f"appearance: the rate is {self.rate:g}; give more than 0 and at most 1")

    def refuse_unfit(self, primitive: Primitive) -> None:
        """See `Appearance.refuse_unfit`."""
        if lacking := {"sh0", "sh_rest"} - set(primitive.columns()):
            raise BadInput(
                f"appearance gain-offset changes the columns sh0 and sh_rest, and primitive {name_of(primitive)} has "
                f"no {' and '.join(sorted(lacking))}; choose appearance:none or another primitive"
            )

    def begin(self, count: int) -> Tensor:
        """(V, 2): the logarithm of a gain, and an offset; zeros."""
        return torch.zeros(count, 2)

    def rate_at(self, index: int, steps: int) -> float:
        return self.rate if index > self.start else 0.0

    def __call__(self, numbers: Tensor, color: Tensor, camera: Camera) -> Tensor:
        return numbers[0].exp() * color + numbers[1]

    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """The mean gain applied to every coefficient, and the mean offset to the constant one."""
        gain, offset = numbers[:, 0].exp().mean().to(params["sh0"]), numbers[:, 1].mean().to(params["sh0"])
        shift = (0.5 * gain + offset - 0.5) / SH_C0
        return params | {"sh0": gain * params["sh0"] + shift, "sh_rest": gain * params["sh_rest"]}
