"""Semi-global matching (Hirschmueller 2008): costs made smooth along scanlines from four sides."""

from __future__ import annotations

import torch
from torch import Tensor

CONTRAST = 0.04
"""Difference of luminance at which a jump in depth costs half as much: depth jumps where the picture does."""


def smooth_costs(volume: Tensor, light: Tensor, step: float, jump: float) -> Tensor:
    """The mean of the costs of the best paths to each pixel and plane from the left, right, top and bottom.

    Args:
        volume: (D, H, W) costs.
        light: (H, W) luminance.
        step: Cost of a change by one plane from a pixel to the next.
        jump: Cost of any larger change, where the picture is even.

    Returns:
        (D, H, W).
    """
    total = torch.zeros_like(volume)
    _add_paths(total, volume, _jumps(light, jump, step), step)
    turned = torch.zeros_like(volume.mT, memory_format=torch.contiguous_format)
    _add_paths(turned, volume.mT.contiguous(), _jumps(light.mT, jump, step), step)
    return total.add_(turned.mT).div_(4)


def best_planes(volume: Tensor) -> tuple[Tensor, Tensor]:
    """(H, W) int64 plane of the least cost, and float32 position of the parabola's minimum through its neighbours."""
    plane = volume.argmin(0)
    inner = plane.clamp(1, len(volume) - 2)
    before, here, after = (volume.gather(0, (inner + i)[None])[0] for i in (-1, 0, 1))
    bend = (before - 2 * here + after).clamp_min(1e-9)
    shift = ((before - after) / (2 * bend)).clamp(-0.5, 0.5)
    return plane, torch.where(plane == inner, plane + shift, plane.to(shift.dtype))


def _jumps(light: Tensor, jump: float, step: float) -> Tensor:
    """(H - 1, W) cost of a jump between each row and the next."""
    return (jump / (1 + light.diff(dim=0).abs() / CONTRAST)).clamp_min(step)


def _add_paths(total: Tensor, volume: Tensor, jumps: Tensor, step: float) -> None:
    """Add the paths from the top down and from the bottom up."""
    height = volume.shape[1]
    for rows in (range(height), range(height - 1, -1, -1)):
        path = torch.zeros_like(volume[:, 0])
        for at, row in enumerate(rows):
            if at:
                least = path.amin(0)
                cheapest = torch.minimum(path, least + jumps[min(row, rows[at - 1])])
                torch.minimum(cheapest[1:], path[:-1] + step, out=cheapest[1:])
                torch.minimum(cheapest[:-1], path[1:] + step, out=cheapest[:-1])
                path = cheapest.sub_(least)
            path = path + volume[:, row]
            total[:, row] += path
