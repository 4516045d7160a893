"""PSNR and SSIM over parts of held-out photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import PhotoSkipped, emit
from surfkit.evaluate.images.measure_images import Draw, mean_ssim
from surfkit.evaluate.images.view_counts import ViewCounts
from surfkit.raster.psnr import psnr

Masks = dict[str, Tensor]
"""(H, W) bool of each part, by its name."""
MIN_PART_PIXELS = 64
"""Pixels of a photograph that a figure is taken of."""


def measure_parts(
    found: Iterable[ViewCounts],
    parts: Callable[[ViewCounts], Masks],
    draw: Draw,
    photo_of: Callable[[ViewCounts], Tensor],
    mask_of: Callable[[ViewCounts], Tensor | None],
) -> dict[str, dict[str, Any]]:
    """PSNR and SSIM of each part, as means over photographs that count by their pixels in it, and its share of all.

    A photograph that cannot be read, or whose mask cannot, is left out, and `PhotoSkipped` tells so.

    Args:
        found: What the photographs show.
        parts: Which pixels belong to which part.
        draw: Makes the renders.
        photo_of: (3, H, W) uint8.
        mask_of: Which pixels count at all, (H, W) bool, or None for all.
    """
    sums: dict[str, dict[str, float]] = {}
    total = 0
    for counted in found:
        try:
            photo, keep = photo_of(counted), mask_of(counted)
        except BadInput as error:
            emit(PhotoSkipped(counted.view.name, str(error)))
            continue
        render = draw(counted.view).need("color").cpu().clamp(0, 1)
        target = photo.to(render) / 255
        total += target[0].numel() if keep is None else int(keep.sum())
        for name, mask in parts(counted).items():
            mask = mask if keep is None else mask & keep
            into = sums.setdefault(name, {"pixels": 0, "counted": 0, "psnr": 0.0, "ssim": 0.0})
            into["pixels"] += (count := int(mask.sum()))
            if count >= MIN_PART_PIXELS:
                into["counted"] += count
                into["psnr"] += count * psnr(render, target, mask)
                into["ssim"] += count * mean_ssim(render, target, mask)
    return {name: _means(one, total) for name, one in sums.items()}


def _means(sums: dict[str, float], total: int) -> dict[str, float | None]:
    counted = sums["counted"]
    figures = {name: sums[name] / counted if counted else None for name in ("psnr", "ssim")}
    return {**figures, "share": sums["pixels"] / max(1, total)}


def by_views(least: tuple[int, ...]) -> Callable[[ViewCounts], Masks]:
    """Parts seen by so many training views or more, and by fewer, for each of some numbers."""

    def parts(counted: ViewCounts) -> Masks:
        found: Masks = {}
        for number in least:
            enough = counted.full(counted.counts >= number)
            found |= {f"{number}": enough, f"<{number}": ~enough}
        return found

    return parts


def by_seams(near: Callable[[ViewCounts], Tensor]) -> Callable[[ViewCounts], Masks]:
    """Parts near the borders of blocks and elsewhere; pixels that show no place are in neither.

    Args:
        near: (h, w) bool of a photograph's places.
    """

    def parts(counted: ViewCounts) -> Masks:
        known, close = torch.isfinite(counted.places[..., 0]), near(counted)
        return {"near": counted.full(known & close), "elsewhere": counted.full(known & ~close)}

    return parts
