"""Exposure and white balance of each photograph."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.appearance.base import Appearance
from surfkit.core.check import BadInput
from surfkit.core.registry import name_of
from surfkit.core.schedule import log_linear
from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns
from surfkit.scene.camera import Camera

SH0 = 0.28209479177387814
"""The spherical harmonic of degree 0: a colour is 0.5 + SH0 x its first coefficient + the rest."""


@dataclass(frozen=True)
class Exposure(Appearance):
    """An affine change of colour per photograph, for cameras whose exposure or white balance changed on the way."""

    start: float = 1e-2
    """Learning rate at the first step."""

    end: float = 1e-3
    """Learning rate at the last step, reached along a straight line in the logarithm."""

    def __post_init__(self) -> None:
        if not (self.start > 0 and self.end > 0):
            raise BadInput(f"appearance: the rate goes from {self.start} to {self.end}; both must be above 0")

    def refuse_unfit(self, primitive: Primitive) -> None:
        """See `Appearance.refuse_unfit`."""
        if lacking := {"sh0", "sh_rest"} - set(primitive.columns()):
            raise BadInput(
                f"appearance exposure changes the columns sh0 and sh_rest, and primitive {name_of(primitive)} has no "
                f"{' and '.join(sorted(lacking))}; choose appearance:none or another primitive"
            )

    def begin(self, count: int) -> Tensor:
        """(V, 3, 4): a matrix and an offset each, which change nothing."""
        return torch.eye(3, 4).repeat(count, 1, 1)

    def rate_at(self, index: int, steps: int) -> float:
        return log_linear(self.start, self.end, index / steps)

    def __call__(self, numbers: Tensor, color: Tensor, camera: Camera) -> Tensor:
        return torch.einsum("ij,jhw->ihw", numbers[:, :3], color) + numbers[:, 3, None, None]

    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """The mean matrix applied to every coefficient, and the mean offset to the constant one."""
        mean = numbers.mean(0).to(params["sh0"])
        turn, offset = mean[:, :3], (mean @ torch.tensor([0.5, 0.5, 0.5, 1.0]).to(mean) - 0.5) / SH0
        return params | {"sh0": params["sh0"] @ turn.T + offset, "sh_rest": params["sh_rest"] @ turn.T}
