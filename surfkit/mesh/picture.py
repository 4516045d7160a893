"""From the maps of a view to what is fused: one depth a pixel, a colour, and how far both are to be trusted."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.mesh.lattice import FULL, Picture
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera

Which = Literal["median", "expected"]
OPAQUE = 0.5
"""Least alpha of a pixel whose expected depth counts; the median depth has the same bound of its own."""


def depth_of(maps: Maps, which: Which) -> Tensor:
    """(H, W) camera z; 0 where there is none or it is not finite."""
    depth = maps.median if which == "median" else torch.where(maps.alpha >= OPAQUE, maps.expected_depth(), 0.0)
    return torch.where(torch.isfinite(depth) & (depth > 0), depth, 0.0)


def picture(depth: Tensor, maps: Maps, camera: Camera, voxel: float) -> Picture:
    """What a view sees, with the weight of each pixel.

    A pixel counts by the cosine between its ray and the normal, and fully if it is no larger than a voxel at its depth,
    else by its inverse area: depth that is sampled more coarsely than the lattice says little about a voxel.

    Args:
        depth: (H, W) camera z, 0 where nothing is to be fused.
        maps: Colour, and normals if there are any.
        camera: Of the view.
        voxel: Local units.
    """
    weight = (voxel * min(camera.fx, camera.fy) / depth.clamp_min(1e-20)).clamp(max=1) ** 2
    if maps.normal is not None:
        rays = camera.rays()
        length = maps.normal.norm(dim=0) * rays.norm(dim=0)
        weight = weight * (-(maps.normal * rays).sum(0) / length.clamp_min(1e-10)).clamp(0, 1)
    weight = torch.where(weight > 0, (FULL * weight).round().clamp(1, FULL), 0.0).nan_to_num(0)
    color = (maps.color.clamp(0, 1) * 255).round().nan_to_num(0)
    planes = [*color, torch.where(depth > 0, weight, 0.0)]
    shade = torch.stack([plane.to(torch.uint8) for plane in planes], dim=-1).contiguous()
    return Picture(depth.float().contiguous().numpy(), shade.numpy().view(np.uint32)[..., 0], camera)
