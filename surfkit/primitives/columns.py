"""What a primitive declares of each trainable parameter: shape, learning rate and what its numbers stand for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import LearningRate


@dataclass(frozen=True)
class Activation:
    """An increasing function from raw, trainable numbers to values that mean something.

    Attributes:
        value: Raw numbers to activated ones, of the same shape.
        inverse: The raw numbers of activated ones.
    """

    value: Callable[[Tensor], Tensor]
    inverse: Callable[[Tensor], Tensor]

    def times(self, raw: Tensor, factor: Tensor | float) -> Tensor:
        """The raw numbers whose activated values are `factor` times as large."""
        return self.inverse(self.value(raw) * factor)


class Exponential(Activation):
    """The exponential: raw numbers are natural logarithms."""

    def times(self, raw: Tensor, factor: Tensor | float) -> Tensor:
        """See `Activation.times`; without the rounding of a way there and back."""
        return raw + (factor.log() if isinstance(factor, Tensor) else math.log(factor))


def sigmoid(raw: Tensor) -> Tensor:
    """The logistic function, with the same bits on any number of threads.

    torch rounds the last elements of each thread's share in another way than those that fill a vector.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return torch.sigmoid(raw)
    finally:
        torch.set_num_threads(threads)


IDENTITY = Activation(lambda raw: raw, lambda value: value)
EXP = Exponential(torch.exp, torch.log)
SIGMOID = Activation(sigmoid, torch.logit)


RATES = {
    "means": LearningRate(1.6e-4, 1.6e-6),
    "scales": LearningRate(5e-3),
    "quats": LearningRate(1e-3),
    "opacities": LearningRate(5e-2),
    "sh0": LearningRate(2.5e-3),
    "sh_rest": LearningRate(1.25e-4),
}
"""Of 3DGS (Kerbl et al. 2023), for a scene extent of 1."""


@dataclass(frozen=True)
class Column:
    """A trainable parameter.

    Attributes:
        shape: Of one point's values, such as (3,); of all values if `shared`. None stands for a size of a shared
            parameter that is only known when there are points, as in (None, 3) for the vertices of a mesh.
        rate: Its learning rate, unless a stage has another; of positions in scene extents.
        activation: What its raw numbers stand for.
        shared: It belongs to no point: the weights of a network, a code of each photograph. It is optimised, saved and
            resumed with the points; where blocks are merged it becomes the mean over the blocks, each weighted by the
            number of points that it gives.
    """

    shape: tuple[int | None, ...]
    rate: LearningRate
    activation: Activation = IDENTITY
    shared: bool = False

    def __post_init__(self) -> None:
        if None in self.shape and not self.shared:
            raise BadInput(f"a column of points has shape {self.shape}; only that of a shared parameter may have None")

    @property
    def of_point(self) -> tuple[int, ...]:
        """The sizes of `shape` that are known: for a column that is not shared, all of them."""
        return tuple(size for size in self.shape if size is not None)

    def fits(self, shape: tuple[int, ...], points: int) -> bool:
        """Whether values of `shape` are those of so many points, or all values of a shared parameter."""
        wanted = self.shape if self.shared else (points, *self.shape)
        return len(shape) == len(wanted) and all(a in (None, b) for a, b in zip(wanted, shape, strict=True))


def standard_columns(axes: int, sh_degree: int) -> dict[str, Column]:
    """The columns of 3DGS (Kerbl et al. 2023), with its learning rates for a scene extent of 1.

    Args:
        axes: Scales of a point, 2 or 3.
        sh_degree: Of the spherical harmonics.

    Returns:
        means (3,) local units; scales (axes,) logarithms; quats (4,) wxyz of any length but 0; opacities () logits;
        sh0 (1, 3); sh_rest ((sh_degree + 1)^2 - 1, 3).
    """
    return {
        "means": Column((3,), RATES["means"]),
        "scales": Column((axes,), RATES["scales"], EXP),
        "quats": Column((4,), RATES["quats"]),
        "opacities": Column((), RATES["opacities"], SIGMOID),
        "sh0": Column((1, 3), RATES["sh0"]),
        "sh_rest": Column(((sh_degree + 1) ** 2 - 1, 3), RATES["sh_rest"]),
    }
