"""The optimiser, over the columns of `Points`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit import native
from surfkit.core.check import BadInput
from surfkit.core.schedule import log_linear
from surfkit.primitives.points import Columns, Points

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


@dataclass(frozen=True)
class LearningRate:
    """A learning rate."""

    start: float
    """At the first step."""

    end: float | None = None
    """At the last step, reached along a straight line in the logarithm; constant if unset."""

    def __post_init__(self) -> None:
        if self.start < 0 or (self.end is not None and (self.end <= 0 or self.start == 0)):
            raise BadInput(f"a rate goes from {self.start} to {self.end}; rates must be positive (a constant may be 0)")

    def at(self, index: int, steps: int) -> float:
        """The rate of step `index` of 1..`steps`."""
        return self.start if self.end is None else log_linear(self.start, self.end, index / steps)


@torch.no_grad()
def adam_step(points: Points, grads: Columns, rates: Mapping[str, float], index: int) -> None:
    """Take step `index` (from 1) of Adam on every column that has a gradient, in place."""
    for name, grad in grads.items():
        update(points.params[name], grad, points.exp_avg[name], points.exp_avg_sq[name], rates[name], index)


def update(value: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rate: float, index: int) -> None:
    """Take one step of Adam on a tensor and its moments, in place."""
    rate, correction = rate / (1 - BETA1**index), (1 - BETA2**index) ** -0.5
    tensors = (value, grad, exp_avg, exp_avg_sq)
    if native.module() is not None and all(_plain(t) for t in tensors):
        native.module().adam(*tensors, rate, BETA1, BETA2, correction, EPSILON, torch.get_num_threads())
        return
    exp_avg.lerp_(grad, 1 - BETA1)
    exp_avg_sq.mul_(BETA2).addcmul_(grad, grad, value=1 - BETA2)
    value.addcdiv_(exp_avg, exp_avg_sq.sqrt().mul_(correction).add_(EPSILON), value=-rate)


def _plain(tensor: Tensor) -> bool:
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32 and tensor.is_contiguous()
