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
from surfkit.raster.api import Maps
from surfkit.raster.ssim import ssim
from surfkit.scene.scene import View

Draw = Callable[[View], Maps]
"""Renders a view."""

Show = Callable[[View, Tensor, Maps], None]
"""Gets a view, its photograph as (3, H, W) uint8 and its render."""

SMALLEST = 1e-10
"""Mean squared error at which PSNR ends, at 100 dB: equal images have a PSNR that JSON can hold."""


class Pictures(Protocol):
    """Photographs by the position of their view."""

    def __getitem__(self, at: int, /) -> Tensor:
        """(3, H, W) uint8."""


def psnr(render: Tensor, photo: Tensor) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1, at most 100.

    Args:
        render: (3, H, W), clamped to [0, 1] first, as a screen shows it.
        photo: (3, H, W) in [0, 1].
    """
    error = (render.clamp(0, 1).double() - photo.double()).square().mean()
    return float(-10 * error.clamp_min(SMALLEST).log10())


def color_corrected(render: Tensor, photo: Tensor) -> Tensor:
    """The render after the affine change of colour that brings it closest to the photograph, both (3, H, W).

    For photographs of changing exposure: what a held-out one's own exposure was is not known from training.
    """
    colors, wanted = render.flatten(1).double().T, photo.flatten(1).double().T
    inputs = torch.cat([colors, torch.ones_like(colors[:, :1])], 1)
    damped = inputs.T @ inputs + 1e-9 * torch.eye(4).to(inputs)  # a render of one colour has no unique answer
    change = torch.linalg.solve(damped, inputs.T @ wanted)
    return (inputs @ change).T.reshape(render.shape).to(render)


def evaluate_views(
    views: Sequence[View],
    photos: Pictures,
    draw: Draw,
    *,
    timed: Draw | None = None,
    show: Show | None = None,
    correct_color: bool = False,
) -> dict[str, Any]:
    """Mean PSNR and SSIM, both of each view under "per_image", and frames a second; None where there are no views.

    A photograph that cannot be read is left out, and `PhotoSkipped` tells so.

    Args:
        views: Held-out views.
        photos: By position in `views`.
        draw: Makes the renders that are measured and shown.
        timed: Makes the renders whose speed counts, where it is not `draw`: colours only, for one.
        show: Called once a view, to write pictures.
        correct_color: Also measure "psnr_corrected", of `color_corrected` renders.
    """
    per_image = {}
    for at, view in enumerate(views):
        try:
            photo = photos[at]
        except BadInput as error:
            emit(PhotoSkipped(view.name, str(error)))
            continue
        maps = draw(view)
        render, target = maps.color.clamp(0, 1), photo.to(maps.color) / 255
        per_image[view.name] = {"psnr": psnr(render, target), "ssim": float(ssim(render, target))}
        if correct_color:
            per_image[view.name]["psnr_corrected"] = psnr(color_corrected(render, target), target)
        if show is not None:
            show(view, photo, maps)
    names = ("psnr", "ssim", *["psnr_corrected"] * correct_color)
    means = {name: _mean([values[name] for values in per_image.values()]) for name in names}
    return {"images": {**means, "per_image": per_image}, "fps": frames_per_second(views, timed or draw)}


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
    maps = draw(view)
    if maps.color.is_cuda:
        torch.cuda.synchronize(maps.color.device)
    return time.perf_counter() - start


def _mean(values: Sequence[float]) -> float | None:
    return statistics.fmean(values) if values else None
