"""From the maps of a view to what is fused: depth, slant and colour of each pixel, and how far they are trusted."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.mesh.lattice import FULL_WEIGHT, FusionImage, least_slant
from surfkit.raster.api import Maps
from surfkit.raster.native import kernels, module
from surfkit.scene.camera import Camera

F = np.float32
Which = Literal["median", "expected"]
MAX_PIXEL_WEIGHT = 255
"""Largest weight of a pixel that its shade can hold."""
MIN_DEPTH_ALPHA = 0.5
"""Least alpha of a pixel whose expected depth counts; the median depth has the same bound of its own."""


def depth_of(maps: Maps, which: Which) -> Tensor:
    """(H, W) camera z; 0 where there is none or it is not finite."""
    if which == "median":
        depth = maps.need("median")
    else:
        depth = torch.where(maps.need("alpha") >= MIN_DEPTH_ALPHA, maps.expected_depth(), 0.0)
    return torch.where(torch.isfinite(depth) & (depth > 0), depth, 0.0)


def picture(depth: Tensor, maps: Maps, camera: Camera, voxel: float, truncation: float) -> FusionImage:
    """What a view sees, with the weight of each pixel.

    A pixel counts by the cosine between its ray and the normal, and fully if it is no larger than a voxel at its depth,
    else by its inverse area: depth that is sampled more coarsely than the lattice says little about a voxel.

    Args:
        depth: (H, W) camera z, 0 where nothing is to be fused.
        maps: Colour, and normals if there are any.
        camera: Of the view.
        voxel: Local units.
        truncation: Local units.
    """
    color = maps.need("color").float().contiguous().numpy()
    normal = None if maps.normal is None else maps.normal.float().contiguous().numpy()
    near, plain = voxel * min(camera.fx, camera.fy), depth.float().contiguous().numpy()
    least = least_slant(voxel, truncation)
    if module() is None:
        made, slant = shade(plain, color, normal, camera, near, least)
        return FusionImage(plain, made, camera, slant)
    made, slant = np.empty(plain.shape, np.uint32), np.empty(plain.shape, F)
    lens, native = [camera.fx, camera.fy, camera.cx, camera.cy], kernels()
    native.shade(plain, color, normal, lens, near, least, made, slant, native.kernels_in_use(), torch.get_num_threads())
    return FusionImage(plain, made, camera, slant)


def shade(
    depth: np.ndarray, color: np.ndarray, normal: np.ndarray | None, camera: Camera, near: float, least: float
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) uint32 colours and weights, and (H, W) float32 slants, in numpy, with the bits of surfkit/mesh/cpu.

    `near` is the depth at which a pixel is as large as a voxel, `least` the least slant.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        share = F(near) / np.maximum(depth, F(1e-20))
        size = np.minimum(share, F(1))
        upright, slant = F(1), np.ones_like(depth)
        if normal is not None:
            x = (np.arange(depth.shape[1], dtype=F) + F(0.5) - F(camera.cx)) / F(camera.fx)
            y = ((np.arange(depth.shape[0], dtype=F) + F(0.5) - F(camera.cy)) / F(camera.fy))[:, None]
            along = -(normal[0] * x + normal[1] * y + normal[2])
            squares = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
            slant = np.fmax(along / np.fmax(np.sqrt(squares), F(1e-10)), F(least))
            length = np.sqrt(squares * (x * x + y * y + F(1)))
            upright = np.fmax(np.fmin(along / np.fmax(length, F(1e-10)), F(1)), F(0))
        weight = size * size * upright
        whole = np.maximum((weight * F(FULL_WEIGHT) + F(0.5)).astype(np.uint32), 1)
        planes = (np.fmin(np.fmax(color, F(0)), F(1)) * F(255) + F(0.5)).astype(np.uint32)
    counted = np.where((weight > 0) & (depth > 0), whole, 0).astype(np.uint32)
    return planes[0] | planes[1] << np.uint32(8) | planes[2] << np.uint32(16) | counted << np.uint32(24), slant


def weighed(shade: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """(H, W) uint32 shades whose weights are multiplied and rounded; what counts at all goes on doing so.

    Args:
        shade: (H, W) uint32, see `FusionImage`.
        trust: (H, W) float32, 0 or more; where it is 0, the pixel no longer counts. No weight becomes more than
        `MAX_PIXEL_WEIGHT`.
    """
    weight = (shade >> 24).astype(F)
    whole = np.clip((weight * trust.astype(F) + F(0.5)).astype(np.uint32), 1, MAX_PIXEL_WEIGHT)
    counted = np.where((weight > 0) & (trust > 0), whole, 0).astype(np.uint32)
    return shade & np.uint32(0xFFFFFF) | counted << np.uint32(24)
