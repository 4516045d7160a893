"""Strips of a picture, for processes that draw one picture together; on CPUs, by the compiled kernels.

A splat is sent to whoever draws a strip that it touches: position, rotation, scales and opacity, and in place of its
harmonics its colour in this view, which its owner works out: 13 numbers instead of 58.
"""

from __future__ import annotations

import torch
from torch import Tensor

from surfkit.raster import native
from surfkit.raster.api import Splats
from surfkit.raster.native_rasterizer import Pass, pose_and_lens
from surfkit.scene.camera import Camera

TILE = 16
"""Pixels of a side of a tile."""

Strip = tuple[int, int]
"""Rows of tiles [first, end)."""


def tile_rows(camera: Camera) -> int:
    """Rows of tiles of an image."""
    return -(-camera.height // TILE)


def pixel_rows(strip: Strip, camera: Camera) -> slice:
    """Rows of pixels of a strip."""
    return slice(min(strip[0] * TILE, camera.height), min(strip[1] * TILE, camera.height))


def colors(splats: Splats, camera: Camera, rows: Tensor) -> Tensor:
    """(R, 3) colours in a view of the splats of (R,) rows, below 0 too."""
    found = torch.empty(len(rows), 3)
    native.kernels().shade(_shading(splats), rows, *pose_and_lens(camera), 0.0, found, torch.get_num_threads())
    return found


def colors_backward(
    splats: Splats, camera: Camera, rows: Tensor, by_colors: Tensor, by_sh: tuple[Tensor, Tensor], by_means: Tensor
) -> None:
    """Write gradients by the harmonics, and add those by the means, of the splats of some rows.

    Args:
        splats: N of them.
        camera: Of the view.
        rows: (R,) int64, different ones.
        by_colors: (R, 3) gradients by `colors`.
        by_sh: (N, 1, 3) and (N, K - 1, 3), of which these rows are written.
        by_means: (N, 3), to these rows of which is added.
    """
    native.kernels().shade_backward(
        _shading(splats),
        rows,
        *pose_and_lens(camera),
        0.0,
        by_colors.contiguous(),
        *by_sh,
        by_means,
        torch.get_num_threads(),
    )


def contribution(
    colored: Splats, camera: Camera, near: float, powers: tuple[float, float], strip: Strip
) -> tuple[Tensor, Tensor]:
    """`Rasterizer.contribution` over the pixels of a strip: sums (N,) and counts (N,) int64."""
    grey = colored.with_colors(torch.zeros(len(colored), 3))
    total, count = torch.zeros(len(colored)), torch.zeros(len(colored), dtype=torch.int64)
    Pass(grey, camera, near, strip=strip).native.contribution(*powers, total, count, torch.get_num_threads())
    return total, count


def leading(colored: Splats, camera: Camera, near: float, strip: Strip) -> Tensor:
    """`Rasterizer.leading` over the pixels of a strip, (N,) int64."""
    count = torch.zeros(len(colored), dtype=torch.int64)
    grey = colored.with_colors(torch.zeros(len(colored), 3))
    Pass(grey, camera, near, strip=strip).native.leading(count, torch.get_num_threads())
    return count


def _shading(splats: Splats) -> list[Tensor]:
    """What colours depend on: positions (N, 3) and harmonics (N, 1, 3) and (N, K - 1, 3)."""
    return [value.detach().contiguous() for value in (splats.means, splats.sh0, splats.sh_rest)]
