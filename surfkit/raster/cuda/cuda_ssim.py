"""Structural similarity by ssim.cu."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.modules import Kernels, kernels

SSIM_SOURCE = CudaSource(Path(__file__).with_name("ssim.cu"))
TILE_SIZE_PX = (32, 16)
THREADS_PER_BLOCK = 128


def forward(x: Tensor, y: Tensor, has_gradient: bool, on: Kernels | None = None) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The mean similarity, a scalar on the device of the images, and what `backward` needs.

    Args:
        x, y: (C, H, W) float32, contiguous, on one device.
        has_gradient: Whether `backward` will be called.
        on: The kernels; by default those for the device.
    """
    grid = _grid(x)
    sums = x.new_empty(grid[0] * grid[1] * grid[2])
    derivatives = tuple(torch.empty_like(x) if has_gradient else x.new_empty(0) for _ in range(3))
    on = on or kernels(SSIM_SOURCE, x.device)
    on.launch("ssim_forward", grid, THREADS_PER_BLOCK, x, y, x.shape[2], x.shape[1], sums, *derivatives)
    return (sums.sum(dtype=torch.float64) / x.numel()).float(), derivatives


def backward(
    x: Tensor, y: Tensor, derivatives: tuple[Tensor, ...], upstream: Tensor, on: Kernels | None = None
) -> Tensor:
    """(C, H, W) the gradient by `x` of the mean similarity times `upstream`, a scalar tensor."""
    gradient = torch.empty_like(x)
    sizes = (x.shape[2], x.shape[1])
    on = on or kernels(SSIM_SOURCE, x.device)
    on.launch(
        "ssim_backward",
        _grid(x),
        THREADS_PER_BLOCK,
        x,
        y,
        *sizes,
        *derivatives,
        upstream.reshape(1).contiguous(),
        gradient,
    )
    return gradient


def _grid(x: Tensor) -> tuple[int, int, int]:
    channels, height, width = x.shape
    return (width + TILE_SIZE_PX[0] - 1) // TILE_SIZE_PX[0], (height + TILE_SIZE_PX[1] - 1) // TILE_SIZE_PX[1], channels
