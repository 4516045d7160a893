"""Depth maps at another size, and those of distorted photographs as a pinhole camera would see them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from surfkit.io.datasets.undistort import warp
from surfkit.scene.align import sample
from surfkit.scene.scene import Lens

MAX_SMOOTH_STEP = 0.05
"""Neighbouring pixels whose inverse depths differ by a larger share lie on two surfaces and are not averaged."""
MIN_KNOWN_SHARE = 1 - 1e-4
"""Share of known neighbours from which on all of them are known, but for rounding."""


def resized(inverse: Tensor, size: tuple[int, int]) -> Tensor:
    """A map (h, w) at another size (H, W), smooth on surfaces and sharp between them; 0 stays 0."""
    if inverse.shape == size:
        return inverse
    smaller = size[0] < inverse.shape[0]
    near = interpolate(inverse[None, None], size, mode="nearest-exact")[0, 0]
    there = (inverse > 0).to(inverse.dtype)
    both = torch.stack([inverse, there])[None]
    smooth, full = interpolate(both, size, mode="area" if smaller else "bilinear")[0]
    return _joined(near, smooth, full == 1)


def nearest(values: Tensor, size: tuple[int, int]) -> Tensor:
    """(C, H, W) of (C, h, w) of any type: the value of the pixel in whose place the middle of each one lies."""
    rows, columns = (
        ((torch.arange(new, dtype=torch.float64) + 0.5) * (old / new)).long().clamp_max(old - 1)
        for new, old in zip(size, values.shape[1:], strict=True)
    )
    return values[:, rows][:, :, columns]


def straightened(inverse: Tensor, lens: Lens) -> Tensor:
    """(H, W) inverse depth for the pinhole camera of `undistort`, of a map (h, w) of the distorted photograph.

    Camera z does not change, as both cameras stand in one place. Smooth on surfaces and sharp between them; 0 where
    there is none.
    """
    _, grid, inside = warp(lens)
    source = resized(inverse, (lens.height, lens.width))
    both = torch.stack([source, (source > 0).to(source.dtype)])[None]
    near = grid_sample(both[:, :1], grid, "nearest", "border", align_corners=False)[0, 0]
    smooth, full = grid_sample(both, grid, "bilinear", "border", align_corners=False)[0]
    return _joined(near, smooth, full > MIN_KNOWN_SHARE) * inside


def straightened_nearest(values: Tensor, lens: Lens) -> Tensor:
    """(C, H, W) of (C, h, w) of any type, as `straightened`, each pixel as the nearest one; 0 outside."""
    _, grid, inside = warp(lens)
    found = grid_sample(values[None].to(torch.float32), grid, "nearest", "border", align_corners=False)[0]
    return (found * inside).to(values.dtype)


def distorted(at: np.ndarray, lens: Lens) -> np.ndarray:
    """(K, 2) where a distorted photograph shows what its undistorted picture shows at (K, 2); shares of the sizes."""
    grid = warp(lens)[1][0].numpy().astype(np.float64)
    return np.stack([(sample(grid[..., axis], at) + 1) / 2 for axis in (0, 1)], axis=1)


def _joined(near: Tensor, smooth: Tensor, known: Tensor) -> Tensor:
    """The smooth values where all that they are made of lies on one surface, else the nearest ones."""
    return torch.where(known & ((smooth - near).abs() < MAX_SMOOTH_STEP * near), smooth, near)
