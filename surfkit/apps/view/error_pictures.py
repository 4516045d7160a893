"""What a camera saw, what the model draws there, and how they differ, as pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from surfkit.apps.render.frame_files import depth_of, shown, spread
from surfkit.core.check import BadInput
from surfkit.evaluate.images.comparison_pictures import RAMP, colour_normal
from surfkit.raster.api import Maps
from surfkit.raster.psnr import psnr
from surfkit.scene.photos import read_draft, view_photo
from surfkit.scene.scene import Frame, View

Kind = Literal["photograph", "render", "depth", "normal", "error"]
PICTURE_KINDS: tuple[Kind, ...] = get_args(Kind)
MAX_DRAWN_PX = 1600
"""Of the pictures that are drawn, pixels."""
WORST_ERROR = 0.25
"""Error from which on the colour is the palest, of values from 0 to 1."""


def picture(view: View, kind: Kind, draw: Callable[[View], Maps] | None, frame: Frame) -> tuple[np.ndarray, str]:
    """(H, W, 3) uint8 of a camera, and a line that says how to read it.

    Args:
        view: At most LONGEST pixels of it are drawn.
        kind: What to show.
        draw: Maps of a view; None where nothing can be drawn.
        frame: For the unit of depths.

    Raises:
        BadInput: The photograph cannot be read, or the model draws no such maps.
    """
    view = replace(view, camera=view.camera.fitted(MAX_DRAWN_PX))
    if kind == "photograph":
        return _bytes(view_photo(view).float() / 255), f"{view.camera.width} × {view.camera.height} pixels"
    if draw is None:
        raise BadInput(f"{kind}: this model cannot be drawn, as its splats are unknown")
    maps = draw(view)
    if kind == "error":
        return error_picture(maps, view_photo(view).float() / 255)
    if kind == "normal":
        if maps.normal is None:
            raise BadInput("what this run has made draws no normals")
        return _bytes(colour_normal(maps.normal)), "red to the right, green up, blue towards the camera"
    if kind == "depth":
        bounds = spread(maps)
        if bounds is None:
            return _bytes(torch.zeros(3, *depth_of(maps).shape)), "nothing is seen"
        unit = (frame.metres or 1.0) / frame.scale
        name = "m" if frame.metres else "units"
        told = f"near is pale: {bounds[0] * unit:.4g} {name}; far is dark: {bounds[1] * unit:.4g} {name}"
        return _bytes(shown(maps, "depth", bounds)), told
    return _bytes(shown(maps, "color", None)), "drawn by surfkit, as in training"


def error_picture(maps: Maps, photo: Tensor) -> tuple[np.ndarray, str]:
    """(H, W, 3) uint8 of the mean over the channels of |render - photograph|, and its mean and PSNR in words.

    Args:
        maps: With colours.
        photo: (3, H, W) in [0, 1].
    """
    color = maps.need("color").detach().cpu().float().clamp(0, 1)
    error = (color - photo).abs().mean(0)
    steps = np.linspace(0, WORST_ERROR, len(RAMP))
    colors = np.stack([np.interp(error.numpy(), steps, RAMP[:, i]) for i in range(3)], axis=2)
    ratio = f"{psnr(color, photo):.2f} dB" if error.any() else "infinite"
    ends = f"dark is 0, the palest {WORST_ERROR:.0%} and more"
    told = f"|render - photograph|: {ends}; mean {float(error.mean()):.1%}, PSNR {ratio}"
    return np.round(colors * 255).astype(np.uint8), told


def thumbnail(view: View, longest: int) -> np.ndarray:
    """(h, w, 3) uint8 of a photograph, a side of `longest` to twice that."""
    return read_draft(view.path, longest, view.pixels)


def _bytes(image: Tensor) -> np.ndarray:
    return (image.detach().cpu().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
