"""Pictures to look at: photograph, render, depth and normals side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from surfkit.core.files import replacing
from surfkit.raster.api import Maps
from surfkit.scene.photo_names import safe_path

RAMP = np.array(
    [
        [0.226, 0.031, 0.266],
        [0.359, 0.103, 0.307],
        [0.495, 0.177, 0.329],
        [0.629, 0.262, 0.333],
        [0.753, 0.362, 0.323],
        [0.843, 0.489, 0.330],
        [0.913, 0.625, 0.368],
        [0.964, 0.766, 0.447],
        [0.999, 0.908, 0.567],
    ]
)
"""sRGB at equal steps of lightness, from dark violet to pale yellow: Oklab L 0.26 to 0.93, hue 320 to 455 degrees."""


def colour_depth(depth: Tensor, bounds: tuple[float, float] | None = None) -> Tensor:
    """(3, H, W) in [0, 1]: near is pale, far is dark, black where the depth is 0 or not finite.

    Args:
        depth: (H, W) camera z.
        bounds: Depths of the ends of the colours; percentiles 2 and 98 of the valid pixels by default.
    """
    values = depth.detach().cpu().double().numpy()
    valid = np.isfinite(values) & (values > 0)
    if not valid.any():
        return torch.zeros(3, *depth.shape)
    near, far = bounds or np.percentile(values[valid], [2, 98])
    share = np.clip((far - np.where(valid, values, far)) / max(far - near, 1e-12), 0, 1)
    steps = np.linspace(0, 1, len(RAMP))
    channels = [np.where(valid, np.interp(share, steps, RAMP[:, i]), 0) for i in range(3)]
    return torch.from_numpy(np.stack(channels)).float()


def colour_normal(normal: Tensor) -> Tensor:
    """(3, H, W) in [0, 1]: red to the right, green up, blue towards the camera; black where there is no normal.

    Args:
        normal: (3, H, W) camera frame, of any length; shorter than 1/255 is none.
    """
    normal = normal.detach().cpu().float()
    length = normal.square().sum(0).sqrt()  # torch's norm takes 40 times as long on the CPU
    unit = normal / length.clamp_min(1e-10) * torch.tensor([1.0, -1.0, -1.0])[:, None, None]
    return torch.where(length > 1 / 255, (unit + 1) / 2, 0.0)


def panel(photo: Tensor, maps: Maps) -> Tensor:
    """(3, H, n W) in [0, 1]: photograph, render, and depth and normals where the maps have them.

    The depth is the median one if it is there, the expected one if not.

    Args:
        photo: (3, H, W) uint8.
        maps: Of the same view.
    """
    parts = [photo.cpu().float() / 255, maps.need("color").detach().cpu().float().clamp(0, 1)]
    if maps.median is not None:
        parts.append(colour_depth(maps.median))
    elif maps.depth is not None:
        parts.append(colour_depth(maps.expected_depth()))
    if maps.normal is not None:
        parts.append(colour_normal(maps.normal))
    return torch.cat(parts, dim=2)


def picture_path(folder: Path, name: str) -> Path:
    """The PNG of a view below `folder`: its photograph's name, folders included, with .png added."""
    path = safe_path(name)
    return folder / path.with_name(f"{path.name.replace(':', '_')}.png")


def write_picture(path: Path, image: Tensor) -> None:
    """Save a (3, H, W) image in [0, 1] as PNG, rounded to 8 bits; whole or not at all."""
    pixels = (image.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8)
    with replacing(path) as file:
        Image.fromarray(pixels.permute(1, 2, 0).numpy()).save(file, "PNG", compress_level=1)
