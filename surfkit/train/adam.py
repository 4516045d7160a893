"""The optimiser, over the columns of `Points`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from surfkit import native
from surfkit.cuda.modules import Kernels, kernels
from surfkit.cuda.source import Source
from surfkit.primitives.points import Columns, Points

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
SOURCE = Source(Path(__file__).parent / "cuda" / "adam.cu")
PER_BLOCK = 1024
"""Values that a block of the kernel updates."""


@torch.no_grad()
def adam_step(points: Points, grads: Columns, rates: Mapping[str, float], index: int) -> None:
    """Take step `index` (from 1) of Adam on every column that has a gradient, in place."""
    values = points.all_params()
    for name, grad in grads.items():
        update(values[name], grad, points.exp_avg[name], points.exp_avg_sq[name], rates[name], index)


def update(value: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rate: float, index: int) -> None:
    """Take one step of Adam on a tensor and its moments, in place."""
    tensors = (value, grad, exp_avg, exp_avg_sq)
    if all(_is_gpu(t) for t in tensors):
        launch_update(kernels(SOURCE, value.device), *tensors, rate, index)
        return
    rate, correction = _corrected(rate, index)
    if native.module() is not None and all(_plain(t) for t in tensors):
        native.module().adam(*tensors, rate, BETA1, BETA2, correction, EPSILON, torch.get_num_threads())
        return
    exp_avg.lerp_(grad, 1 - BETA1)
    exp_avg_sq.mul_(BETA2).addcmul_(grad, grad, value=1 - BETA2)
    value.addcdiv_(exp_avg, exp_avg_sq.sqrt().mul_(correction).add_(EPSILON), value=-rate)


def launch_update(
    on: Kernels, value: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rate: float, index: int
) -> None:
    """What `update` does, by the kernel of adam.cu."""
    rate, correction = _corrected(rate, index)
    blocks = (value.numel() + PER_BLOCK - 1) // PER_BLOCK
    numbers = (rate, 1 - BETA1, 1 - BETA2, correction, EPSILON)
    on.launch("adam", blocks, 256, value, grad, exp_avg, exp_avg_sq, *numbers)


def _corrected(rate: float, index: int) -> tuple[float, float]:
    """The learning rate and the factor of the root of the second moment, corrected for moments that began at 0."""
    return rate / (1 - BETA1**index), (1 - BETA2**index) ** -0.5


def _is_gpu(tensor: Tensor) -> bool:
    return tensor.device.type == "cuda" and tensor.dtype == torch.float32 and tensor.is_contiguous()


def _plain(tensor: Tensor) -> bool:
    return tensor.device.type == "cpu" and tensor.dtype == torch.float32 and tensor.is_contiguous()
