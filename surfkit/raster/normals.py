"""Normals of rendered depth, and how far the splats' own normals are from them (2DGS, normal consistency)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from surfkit.raster import native
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
    x = (torch.arange(camera.width, dtype=depth.dtype, device=depth.device) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=depth.dtype, device=depth.device) + 0.5 - camera.cy) / camera.fy
    points = torch.stack([depth * x, depth * y[:, None], depth])
    across = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    down = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    normal = torch.linalg.cross(down, across, dim=0)
    there = depth > 0
    valid = there[1:-1, 2:] & there[1:-1, :-2] & there[2:, 1:-1] & there[:-2, 1:-1]
    return normal * normal.square().sum(0).clamp_min(1e-30).rsqrt(), valid


def disagreement(depth: Tensor, alpha: Tensor, normal: Tensor, camera: Camera) -> Tensor:
    """Mean over the inner pixels of 1 - alpha (splats' normal . normal of the depth), 0 where the depth has none.

    Differentiable in depth and normal; alpha counts as a constant.

    Args:
        depth: (H, W) camera z, 0 where there is none.
        alpha: (H, W).
        normal: (3, H, W) alpha-weighted, camera frame.
        camera: That the maps were rendered for.
    """
    if native.module() is not None and depth.device.type == "cpu" and depth.dtype == torch.float32:
        return _FusedNormals.apply(depth, alpha, normal, camera)  # type: ignore[no-untyped-call]
    return disagreement_reference(depth, alpha, normal, camera)


def disagreement_reference(depth: Tensor, alpha: Tensor, normal: Tensor, camera: Camera) -> Tensor:
    """`disagreement` of maps (H, W) and normals (3, H, W) in plain torch, in any precision."""
    surface, valid = normals_of(depth, camera)
    if valid.numel() == 0:
        return (depth * 0).sum()
    agreement = (normal[:, 1:-1, 1:-1] * surface).sum(0) * alpha.detach()[1:-1, 1:-1]
    return ((1 - agreement) * valid).sum() / valid.numel()


class _FusedNormals(torch.autograd.Function):
    """Value and gradients in one native pass."""

    @staticmethod
    def forward(ctx: Any, depth: Tensor, alpha: Tensor, normal: Tensor, camera: Camera) -> Tensor:
        maps = [t.detach().contiguous() for t in (depth, alpha, normal)]
        ctx.gradients = (torch.empty_like(maps[0]), torch.empty_like(maps[2]))
        lens = [camera.fx, camera.fy, camera.cx, camera.cy]
        value = native.kernels().normal_disagreement(*maps, lens, *ctx.gradients, torch.get_num_threads())
        return depth.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, Tensor, None]:
        by_depth, by_normal = ctx.gradients
        return upstream * by_depth, None, upstream * by_normal, None
