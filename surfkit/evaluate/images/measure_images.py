"""How close renders come to photographs that training has not seen, and how fast they are drawn."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import PhotoSkipped, emit
from surfkit.evaluate.images.lpips import Perceptual
from surfkit.raster.api import Maps
from surfkit.raster.psnr import psnr
from surfkit.raster.ssim import ssim, ssim_map
from surfkit.scene.scene import View

Draw = Callable[[View], Maps]
"""Renders a view."""

Show = Callable[[View, Tensor, Maps], None]
"""Gets a view, its photograph as (3, H, W) uint8 and its render."""


class HeldOutPhotos(Protocol):
    """Photographs by the position of their view."""

    def __getitem__(self, at: int, /) -> Tensor:
        """(3, H, W) uint8."""


def mean_ssim(render: Tensor, photo: Tensor, mask: Tensor | None = None) -> float:
    """Mean structural similarity of (3, H, W) images in [0, 1].

    With a mask (H, W), the mean over the windows around pixels that count, in which the others are alike.
    """
    if mask is None:
        return float(ssim(render, photo))
    return float(ssim_map(render, torch.where(mask, photo, render))[:, mask].mean())


def aligned_halves(
    render: Tensor, photo: Tensor, mask: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor | None] | None:
    """The right half of a render with its colours aligned, and those of photograph and mask; None where a half has no
    pixel that counts.

    What the light of a held-out photograph was is not known from training. The colours get the affine change that
    brings the left half of the render closest to that of the photograph: what is measured on the right half has not
    seen its own answer (after NeRF in the Wild, Martin-Brualla et al. 2021, which fits its appearance so).

    Args:
        render: (3, H, W) in [0, 1].
        photo: (3, H, W) in [0, 1].
        mask: (H, W) bool, whether a pixel counts; None for all.
    """
    middle = render.shape[2] // 2
    left = [image[:, :, :middle] for image in (render, photo)]
    if mask is not None:
        left = [image[:, mask[:, :middle]] for image in left]
    if not left[0].numel() or (mask is not None and not mask[:, middle:].any()):
        return None
    colors, wanted = (image.flatten(1).double().T for image in left)
    inputs = torch.cat([colors, torch.ones_like(colors[:, :1])], 1)
    damped = inputs.T @ inputs + 1e-9 * torch.eye(4).to(inputs)  # one colour has no unique answer
    change = torch.linalg.solve(damped, inputs.T @ wanted).to(render)
    right = torch.einsum("ci,chw->ihw", change[:3], render[:, :, middle:]) + change[3, :, None, None]
    return right.clamp(0, 1), photo[:, :, middle:].contiguous(), None if mask is None else mask[:, middle:]


def evaluate_views(
    views: Sequence[View],
    photos: HeldOutPhotos,
    draw: Draw,
    *,
    timed: Draw | None = None,
    show: Show | None = None,
    masks: Sequence[Tensor | None] | None = None,
    networks: Sequence[Perceptual] = (),
) -> dict[str, Any]:
    """Mean PSNR and SSIM, both of each view under "per_image", and frames a second; None where there are no views.

    Both are measured of the colours as they are, and as "psnr_aligned" and "ssim_aligned" of `aligned_halves`. A
    photograph that cannot be read, or whose mask cannot, is left out, and `PhotoSkipped` tells so.

    Args:
        views: Held-out views.
        photos: By position in `views`.
        draw: Makes the renders that are measured and shown.
        timed: Makes the renders whose speed counts, where it is not `draw`: colours only, for one.
        show: Called once a view, to write pictures.
        masks: Which pixels count, by position in `views`; a view without any is shown but not measured.
        networks: Of LPIPS: also measure "lpips_NET" as defined, "lpips_NET_unscaled" as the published tables of
            Gaussian splatting have it, and "lpips_NET_aligned".
    """
    per_image = {}
    for at, view in enumerate(views):
        try:
            photo, mask = photos[at], None if masks is None else masks[at]
        except BadInput as error:
            emit(PhotoSkipped(view.name, str(error)))
            continue
        maps = draw(view)
        if mask is None or mask.any():
            color = maps.need("color")
            render, target = color.clamp(0, 1), photo.to(color) / 255
            mask = None if mask is None else mask.to(render.device)
            per_image[view.name] = _measured(render, target, mask, networks)
        if show is not None:
            show(view, photo, maps)
    names = ("psnr", "ssim", *lpips_names(networks), *aligned_names(networks))
    means = {name: _mean([values[name] for values in per_image.values() if name in values]) for name in names}
    return {"images": {**means, "per_image": per_image}, "fps": frames_per_second(views, timed or draw)}


def _measured(render: Tensor, photo: Tensor, mask: Tensor | None, networks: Sequence[Perceptual]) -> dict[str, float]:
    found = {"psnr": psnr(render, photo, mask), "ssim": mean_ssim(render, photo, mask)}
    found |= lpips_values(networks, render, photo, mask)
    if (halves := aligned_halves(render, photo, mask)) is not None:
        values = psnr(*halves), mean_ssim(*halves), *(network.distance(*halves) for network in networks)
        found |= dict(zip(aligned_names(networks), values, strict=True))
    return found


def aligned_names(networks: Sequence[Perceptual]) -> list[str]:
    """Names of what is measured of `aligned_halves`."""
    return ["psnr_aligned", "ssim_aligned", *(f"lpips_{network.net}_aligned" for network in networks)]


def lpips_values(
    networks: Sequence[Perceptual], render: Tensor, photo: Tensor, mask: Tensor | None = None
) -> dict[str, float]:
    """LPIPS of (3, H, W) images in [0, 1], as defined and unscaled, by name of the measure."""
    return {
        name: network.distance(render, photo, mask, unscaled)
        for network in networks
        for unscaled, name in zip((False, True), lpips_names([network]), strict=True)
    }


def lpips_names(networks: Sequence[Perceptual]) -> list[str]:
    """Names of what networks measure."""
    return [f"lpips_{network.net}{end}" for network in networks for end in ("", "_unscaled")]


def frames_per_second(views: Sequence[View], draw: Draw, warmup: int = 2, most: int = 20) -> float | None:
    """Frames a second of the median render, after `warmup` renders that do not count; None without views.

    Args:
        views: At most `most` of them are drawn, evenly chosen.
        draw: Makes the renders.
        warmup: Renders before the clock starts.
        most: Renders that count.
    """
    if not views:
        return None
    chosen = [views[i * len(views) // min(most, len(views))] for i in range(min(most, len(views)))]
    for i in range(warmup):
        _seconds(chosen[i % len(chosen)], draw)
    return 1 / statistics.median(_seconds(view, draw) for view in chosen)


def _seconds(view: View, draw: Draw) -> float:
    start = time.perf_counter()
    color = draw(view).need("color")
    if color.is_cuda:
        torch.cuda.synchronize(color.device)
    return time.perf_counter() - start


def _mean(values: Sequence[float]) -> float | None:
    return statistics.fmean(values) if values else None
