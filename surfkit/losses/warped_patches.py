"""Photographs that agree over the rendered surface (PGSR, multi-view photometric consistency)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.losses.base import Loss, Neighbour, Target
from surfkit.losses.two_views import (
    MIN_DEPTH,
    Opposite,
    TwoViews,
    agreement,
    is_whole,
    motion,
    projected,
    round_trip,
    sampled,
    spread,
    surface_depth,
)
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera

GREY_WEIGHTS = (0.299, 0.587, 0.114)
"""Shares of red, green and blue in grey (ITU-R BT.601)."""
MIN_VIEW_COSINE = 0.1
"""Planes that are seen at a smaller cosine are too oblique to warp by."""
MIN_PATCH_DEVIATION = 0.01
"""Patches of which grey deviates less, as a standard deviation for white 1, are noise and are not compared."""


@dataclass(frozen=True)
class WarpedPatches(TwoViews, Loss):
    """One minus the normalised cross-correlation of patches and of what a neighbouring photograph shows in their
    place (PGSR, arXiv 2406.06521).

    A patch of the photograph is warped into the neighbour over the plane through its central pixel that the rendered
    depth and normal describe. Exposure does not matter. The loss is the mean of exp(-e) (1 - NCC), where e is the error
    of `reprojection`, held constant, over the patches with e below `limit`; the others are taken for occluded. Patches
    without texture, or that reach under a mask or out of either picture, do not count.
    """

    reads: ClassVar[tuple[str, ...]] = ("alpha", "depth", "median", "normal")

    weight: float = 0.15

    pixels: int = 4_096
    """Most patches in a step, spread evenly over the picture at random."""

    radius: int = 3
    """Pixels on each side of the central one: 3 compares patches of 7 x 7 pixels."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.pixels < 1 or self.radius < 1:
            raise BadInput(f"WarpedPatches has pixels {self.pixels}, radius {self.radius}; both must be 1 or more")

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        depth, camera, neighbour = surface_depth(maps, self.depth), target.view.camera, target.neighbour
        normals = maps.need("normal")
        nothing = 0 * (depth.sum() + normals.sum())
        at = self.centres(target)
        if neighbour is None or not len(at):
            return nothing
        z, normal = depth.flatten()[at], normals.flatten(1)[:, at]
        rays = camera.rays(depth.dtype, depth.device).flatten(1)[:, at]
        facing = -(normal * rays).sum(0) > MIN_VIEW_COSINE * normal.square().sum(0).sqrt() * rays.square().sum(0).sqrt()
        with torch.no_grad():
            opposite = Opposite.of(neighbour, self.depth)
            weight, counts = agreement(*round_trip(z, rays, camera, opposite), self.limit)
        kept = (counts & facing & (normal != 0).any(0)).nonzero()[:, 0]
        plane = normal[:, kept] / ((normal[:, kept] * rays[:, kept]).sum(0) * z[kept])  # plane . point = 1
        found, inside = self.warped(plane, rays[:, kept], camera, neighbour)
        correlation, textured = ncc(self.patches(target, at[kept]).to(found), found)
        right = inside & textured
        terms = torch.where(right, weight[kept] * (1 - correlation), 0.0)
        return nothing + terms.sum() / right.sum().clamp_min(1)

    def centres(self, target: Target) -> Tensor:
        """(K,) flat positions of the central pixels, spread over the picture; all of their patches counts."""
        height, width = target.photo.shape[1:]
        r = self.radius
        inner = (height - 2 * r, width - 2 * r)
        if min(inner) < 1:
            return torch.zeros(0, dtype=torch.int64, device=target.photo.device)
        side = max(1, math.ceil(math.sqrt(inner[0] * inner[1] / self.pixels)))
        while math.ceil(inner[0] / side) * math.ceil(inner[1] / side) > self.pixels:
            side += 1
        y, x = spread(inner, side, target.seed, target.photo.device)
        at = (y + r) * width + x + r
        if target.mask is None:
            return at
        return at[target.mask.flatten()[at[:, None] + self.offsets(width).to(at.device)].all(1)]

    def offsets(self, width: int) -> Tensor:
        """(S,) what to add to the flat position of a pixel to get those of its patch, in rows."""
        steps = torch.arange(-self.radius, self.radius + 1)
        return (steps[:, None] * width + steps).flatten()

    def patches(self, target: Target, at: Tensor) -> Tensor:
        """(K, S) grey values of the photograph around the pixels `at`."""
        return grey(target.photo).flatten()[at[:, None] + self.offsets(target.photo.shape[2]).to(at.device)]

    def warped(self, plane: Tensor, rays: Tensor, camera: Camera, neighbour: Neighbour) -> tuple[Tensor, Tensor]:
        """(K, S) grey values of the neighbour where planes take the pixels of patches, and whether all S are there.

        Args:
            plane: (3, K) with plane . point = 1 on it, in the frame of the first camera.
            rays: (3, K) directions of the central pixels, with z = 1.
            camera: The first one.
            neighbour: To look into.
        """
        rotation, shift = motion(camera, neighbour.view.camera, plane)
        steps = torch.arange(-self.radius, self.radius + 1, dtype=plane.dtype, device=plane.device)
        y, x = (part.flatten() for part in torch.meshgrid(steps / camera.fy, steps / camera.fx, indexing="ij"))
        around = rays[:, :, None] + torch.stack([x, y, torch.zeros_like(x)])[:, None]  # (3, K, S)
        inverse = (plane[:, :, None] * around).sum(0)  # of the depth of the plane along these rays
        # The point is around / inverse. Projection does not care for its length: all is multiplied by `inverse`.
        turned = (rotation @ around.flatten(1)).view_as(around)
        points = turned + shift[:, :, None] * inverse
        at = projected(neighbour.view.camera, points)
        counts = plane.new_ones(neighbour.photo.shape[1:]) if neighbour.mask is None else neighbour.mask
        inside = (inverse > MIN_DEPTH) & (points[2] > MIN_DEPTH) & is_whole(counts, at)
        return sampled(grey(neighbour.photo).to(at), at), inside.all(1)


def grey(photo: Tensor) -> Tensor:
    """(H, W) of (3, H, W)."""
    return torch.tensordot(photo.new_tensor(GREY_WEIGHTS), photo, 1)


def ncc(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """(K,) normalised cross-correlation in [-1, 1] of the rows of (K, S), and whether both rows have texture."""
    a, b = (rows - rows.mean(1, keepdim=True) for rows in (one, other))
    first, second = a.square().mean(1), b.square().mean(1)
    textured = (first > MIN_PATCH_DEVIATION**2) & (second > MIN_PATCH_DEVIATION**2)
    scale = torch.where(textured, first * second, 1.0).sqrt()
    return torch.where(textured, (a * b).mean(1) / scale, 0.0), textured
