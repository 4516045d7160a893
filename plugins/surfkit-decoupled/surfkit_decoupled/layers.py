"""Convolution and bilinear doubling that give the same bits twice, on a GPU too.

CUDA sums the gradients of convolutions, and of torch's own bilinear resizing, in any order unless it is told otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d


def convolved(image: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """(1, O, H, W) a 3 x 3 convolution of an image that is 0 outside.

    Args:
        image: (1, I, H, W).
        weight: (O, I, 3, 3).
        bias: (O,).
    """
    return _Convolved.apply(image, weight, bias)  # type: ignore[no-any-return, no-untyped-call]


def doubled(image: Tensor) -> Tensor:
    """(B, C, 2 H, 2 W) an image (B, C, H, W) at twice its size, interpolated linearly between the middles of pixels."""
    for axis in (2, 3):
        count = image.shape[axis]
        first, last = image.narrow(axis, 0, 1), image.narrow(axis, count - 1, 1)
        before = torch.cat([first, image.narrow(axis, 0, count - 1)], axis)
        after = torch.cat([image.narrow(axis, 1, count - 1), last], axis)
        pair = torch.stack([0.75 * image + 0.25 * before, 0.75 * image + 0.25 * after], axis + 1)
        image = pair.flatten(axis, axis + 1)
    return image


@contextmanager
def in_fixed_order() -> Iterator[None]:
    """Within, cuDNN takes the same algorithm each time, of those that sum in a fixed order, in whole floats."""
    with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
        yield


class _Convolved(torch.autograd.Function):
    """Both ways in a fixed order: the backward pass of torch's convolution would ask for the settings of its time."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(image, weight)
        with in_fixed_order():
            return conv2d(image, weight, bias, padding=1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        image, weight = ctx.saved_tensors
        sizes, plain = [len(weight)], ([1, 1], [1, 1], [1, 1], False, [0, 0], 1)  # stride, padding, dilation, ...
        with in_fixed_order():
            found: tuple[Tensor | None, ...] = torch.ops.aten.convolution_backward(
                grad.contiguous(), image, weight, sizes, *plain, list(ctx.needs_input_grad)
            )
        return found
