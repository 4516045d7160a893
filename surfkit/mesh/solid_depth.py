"""Depth maps of Gaussians as stochastic solids (Zhang et al. 2026, GGGS), of any model, however it was trained."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from surfkit.raster.api import Splats
from surfkit.raster.rays import ray_opacity
from surfkit.scene.camera import Camera

SEGMENTS = 8
"""Parts into which a pass divides the interval of a pixel (GGGS)."""
PASSES = 5
"""Passes (GGGS): they leave a 32,768th of the first interval."""
WIDTHS = (0.02, 0.1, 0.4)
"""Half widths of the first interval, as shares of the first depth: the next one where the last does not bracket."""
HALF = 0.5
"""Transmittance at the surface (GGGS, eq. 10)."""


def solid_depth(splats: Splats, camera: Camera, near: float, first: Tensor) -> Tensor:
    """Where half of each ray is left open, T(t) = 0.5 (GGGS, eq. 10), found by search, as T never rises.

    Args:
        splats: Gaussians.
        camera: World is the splats' frame.
        near: Local units.
        first: (H, W) camera z about which the search begins, such as the median depth that is drawn; 0 for none.

    Returns:
        (H, W) float32 camera z; 0 where there is no first depth, or no interval of `WIDTHS` about it brackets the
        surface.

    Raises:
        BadInput: The splats are not ellipsoids, or a value is not finite.
    """
    found = torch.zeros(first.numel(), dtype=torch.float32)
    start = first.detach().cpu().double().flatten()
    rays = camera.rays(torch.float64).flatten(1).T

    def hidden(rows: Tensor, depth: Tensor) -> Tensor:
        """(n, k) bool, whether less than half is left at (n, k) depths on the rays of the pixels `rows`."""
        local = (rays[rows][:, None] * depth[..., None]).flatten(0, 1)
        points = (local - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
        return (ray_opacity(splats, camera, near, points, solid=True) > 1 - HALF).view(depth.shape)

    rows = ((start > near) & start.isfinite()).nonzero()[:, 0]
    for width in WIDTHS:
        if not len(rows):
            break
        # Points before `near` are not in view, and nothing hides them.
        low, high = start[rows] * (1 - width), start[rows] * (1 + width)
        within = hidden(rows, torch.stack([low, high], 1))
        good = ~within[:, 0] & within[:, 1]
        found[rows[good]] = _search(rows[good], low[good], high[good], hidden).float()
        rows = rows[~good]
    return found.view(first.shape)


def _search(rows: Tensor, low: Tensor, high: Tensor, hidden: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """(n,) depths between (n,) bounds, of which the first are open and the second hidden."""
    inner = torch.arange(1, SEGMENTS, dtype=torch.float64) / SEGMENTS
    for _ in range(PASSES):
        segment = (high - low) / SEGMENTS
        open_ones = (~hidden(rows, low[:, None] + (high - low)[:, None] * inner)).to(torch.int64)
        low = low + segment * open_ones.cumprod(1).sum(1)  # the first one that is hidden ends the segment
        high = low + segment
    return (low + high) / 2
