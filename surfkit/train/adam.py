"""The optimiser, over the columns of `Points`."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from surfkit import native
from surfkit.primitives.points import Columns, Points

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


@torch.no_grad()
def adam_step(points: Points, grads: Columns, rates: Mapping[str, float], index: int) -> None:
    """Take step `index` (from 1) of Adam on every column that has a gradient, in place."""
    values = points.all_params()
    for name, grad in grads.items():
        update(values[name], grad, points.exp_avg[name], points.exp_avg_sq[name], rates[name], index)


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
