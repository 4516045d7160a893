"""Structural similarity (Wang et al. 2004) as splatting uses it: 11 x 11 Gaussian window, sigma 1.5, zero padding."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from surfkit.raster import native
from surfkit.raster.cuda import cuda_ssim as gpu

C1, C2 = 0.01**2, 0.03**2
WINDOW_RADIUS_PX, WINDOW_SIGMA_PX = 5, 1.5


def ssim(x: Tensor, y: Tensor) -> Tensor:
    """Mean structural similarity of two images, differentiable in `x`.

    Args:
        x: (C, H, W) in [0, 1].
        y: (C, H, W) in [0, 1]; a constant.
    """
    if native.module() is not None and x.device.type == "cpu" and x.dtype == torch.float32:
        return _FusedSSIM.apply(x, y)  # type: ignore[no-untyped-call]
    if x.device.type == "cuda" and x.dtype == torch.float32:
        return _OnGpu.apply(x, y)  # type: ignore[no-untyped-call]
    return ssim_reference(x, y)


def ssim_reference(x: Tensor, y: Tensor) -> Tensor:
    """`ssim` of two images (C, H, W) in plain torch, in any precision."""
    return ssim_map(x, y).mean()


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """(C, H, W) structural similarity of the windows around each pixel of two images, in plain torch.

    Args:
        x: (C, H, W) in [0, 1].
        y: (C, H, W) in [0, 1].
    """
    offsets = torch.arange(-WINDOW_RADIUS_PX, WINDOW_RADIUS_PX + 1, dtype=x.dtype, device=x.device)
    window = torch.exp(-(offsets**2) / (2 * WINDOW_SIGMA_PX**2))
    window = window / window.sum()

    def blur(image: Tensor) -> Tensor:
        rows = conv2d(image[:, None], window.view(1, 1, 1, -1), padding=(0, WINDOW_RADIUS_PX))
        return conv2d(rows, window.view(1, 1, -1, 1), padding=(WINDOW_RADIUS_PX, 0))[:, 0]

    mean_x, mean_y = blur(x), blur(y)
    squares = mean_x**2 + mean_y**2
    spread = blur(x * x + y * y) - squares
    together = blur(x * y) - mean_x * mean_y
    return (2 * mean_x * mean_y + C1) * (2 * together + C2) / ((squares + C1) * (spread + C2))


class _FusedSSIM(torch.autograd.Function):
    """Value and gradient in one native pass."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        x, y = x.detach().contiguous(), y.detach().to(torch.float32).contiguous()
        gradient = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        value = native.kernels().ssim(x, y, gradient, torch.get_num_threads())
        ctx.gradient = gradient
        return x.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        return upstream * ctx.gradient, None


class _OnGpu(torch.autograd.Function):
    """By the CUDA kernels; nothing waits for the GPU."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        x, y = x.detach().contiguous(), y.detach().to(x).contiguous()
        value, derivatives = gpu.forward(x, y, ctx.needs_input_grad[0])
        ctx.save_for_backward(x, y, *derivatives)
        return value

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        x, y, *derivatives = ctx.saved_tensors
        return gpu.backward(x, y, tuple(derivatives), upstream), None
