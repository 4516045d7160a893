"""What makes surfels a surface (2DGS, section 5): normals that agree with depth, and no spread along rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from surfkit.core.schedule import Steps
from surfkit.losses.base import Loss, Sample
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera


def normals_of(depth: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Normals of the surface that a depth map describes, and where there are any.

    Points are back-projected through the rasterizer's own pixel centres and differenced centrally, so a normal needs
    the depths of the four neighbours; border pixels have none.

    Args:
        depth: (H, W) camera z, 0 where there is none.
        camera: That the map was rendered for.

    Returns:
        (3, H - 2, W - 2) unit normals of the inner pixels in the camera frame, facing the camera, and a mask.
    """
    x = (torch.arange(camera.width, dtype=depth.dtype) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=depth.dtype) + 0.5 - camera.cy) / camera.fy
    px, py = depth * x, depth * y[:, None]
    right = [p[1:-1, 2:] - p[1:-1, :-2] for p in (px, py, depth)]
    down = [p[2:, 1:-1] - p[:-2, 1:-1] for p in (px, py, depth)]
    normal = torch.stack(
        [
            down[1] * right[2] - down[2] * right[1],
            down[2] * right[0] - down[0] * right[2],
            down[0] * right[1] - down[1] * right[0],
        ]
    )
    there = depth > 0
    valid = there[1:-1, 2:] & there[1:-1, :-2] & there[2:, 1:-1] & there[:-2, 1:-1]
    length = normal.square().sum(0).clamp_min(1e-30).rsqrt()
    return normal * length, valid


@dataclass(frozen=True)
class NormalConsistency(Loss):
    """Splats' normals against the normals of the rendered depth (2DGS, eq. 14)."""

    reads: ClassVar[tuple[str, ...]] = ("alpha", "depth", "median", "normal")

    weight: float = 0.0125
    """Share in the objective."""

    start: Steps = 7_000
    """First step that counts: a surface must have formed."""

    depth: Literal["median", "expected"] = "median"
    """Which rendered depth is the surface."""

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if index > self.start else 0.0

    def __call__(self, maps: Maps, sample: Sample) -> Tensor:
        depth = maps.median if self.depth == "median" else maps.expected_depth()
        surface, valid = normals_of(depth, sample.view.camera)
        inner = maps.normal[:, 1:-1, 1:-1]
        agreement = (inner * surface).sum(0) * maps.alpha.detach()[1:-1, 1:-1]
        return ((1 - agreement) * valid).sum() / valid.numel()


@dataclass(frozen=True)
class Distortion(Loss):
    """Spread of the splats along each ray, in inverse depth (2DGS, eq. 13)."""

    reads: ClassVar[tuple[str, ...]] = ("distortion",)

    weight: float = 0.0
    """Share in the objective; the paper finds that it harms large scenes."""

    start: Steps = 3_000
    """First step that counts."""

    unit: float = 0.04
    """Depth at which the inverse depth counts as 1, as a share of the scene extent (2DGS: 0.2 scene units)."""

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if index > self.start else 0.0

    def __call__(self, maps: Maps, sample: Sample) -> Tensor:
        return maps.distortion.mean() * self.unit**2
