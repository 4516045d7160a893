"""How well photographs agree on each of many depths: the cost volume of a plane sweep (Collins 1996)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from surfkit.scene.camera import Camera

MIN_WINDOW_DEVIATION = 0.004
"""Standard deviation of a colour, of 1, below which a window shows nothing to compare."""
BATCH_PIXELS = 1 << 19
"""Pixels, over all planes, that are compared at a time."""


@dataclass(frozen=True)
class PosedImage:
    """A camera and what it saw.

    Attributes:
        camera: At the size of the picture.
        color: (C, H, W) float32 in [0, 1].
    """

    camera: Camera
    color: Tensor

    @property
    def light(self) -> Tensor:
        """(H, W) mean of the colours."""
        return self.color.mean(0)


def cost_volume(here: PosedImage, others: Sequence[PosedImage], planes: Tensor, window: int, visible: float) -> Tensor:
    """1 - correlation of windows between a picture and others warped into it through planes of one depth each.

    Windows are compared by zero-mean normalised cross-correlation of all colours together, so exposure does not matter,
    and a pattern that runs along the parallax in one colour may be told by another. Of the others, only the part that
    agrees best counts, so the rest may be occluded.

    Args:
        here: The picture whose depth is sought.
        others: To compare it with.
        planes: (D,) inverse depths.
        window: Pixels on a side, odd.
        visible: Share of the others that counts.

    Returns:
        (D, H, W) in [0, 1].
    """
    mean, floor = _box(here.color, window), len(here.color) * MIN_WINDOW_DEVIATION**2
    contrast = _variance(here.color[None], mean[None], window) + floor
    best = max(1, round(visible * len(others)))
    volume = torch.empty(len(planes), *here.color.shape[1:], device=planes.device)
    for part in torch.arange(len(planes), device=planes.device).split(max(1, BATCH_PIXELS // here.color.numel())):
        least = [torch.ones(len(part), *here.color.shape[1:], device=planes.device) for _ in range(best)]
        for other in others:
            warped, inside = _warp(here.camera, other, planes[part])
            moved = _box(warped.flatten(0, 1), window).view_as(warped)
            variance = _variance(warped, moved, window).add_(floor)
            together = _box((warped * here.color).sum(1), window) - (moved * mean).sum(1)
            cost = 1 - together.mul_(variance.mul_(contrast).rsqrt_())
            cost = torch.where(inside, cost.clamp_(0, 1), 1)
            for i in range(best):  # insert into the sorted least costs
                least[i], cost = torch.minimum(least[i], cost), torch.maximum(least[i], cost)
        volume[part] = sum(least) / best
    return volume


def ray_map(here: Camera, there: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """(3, H, W) a and (3,) b, so that a + c b is where a pixel of `here` at inverse depth c lies in `there`.

    The first two components over the third are pixels there, and the third over c is the depth there.
    """
    turn, b = ray_way(here, there)
    x, y = here.ray_axes(torch.float64)
    a = (turn[:, :1] * x)[:, None] + (turn[:, 1:2] * y + turn[:, 2:])[..., None]  # A (x, y, 1) of all pixels
    return a.to(device, torch.float32), b.to(device, torch.float32)


def ray_way(here: Camera, there: Camera) -> tuple[Tensor, Tensor]:
    """(3, 3) A and (3,) b, float64: a of `ray_map` is A r for the ray r of a pixel, as `Camera.rays` has it."""
    turn = there.world_to_camera @ torch.linalg.inv(here.world_to_camera)
    lens = torch.tensor([[there.fx, 0, there.cx], [0, there.fy, there.cy], [0, 0, 1]], dtype=torch.float64)
    return lens @ turn[:3, :3], lens @ turn[:3, 3]


def way_numbers(here: Camera, there: Camera) -> list[float]:
    """What `ray_way` gives for compiled code: A by rows, then b."""
    return [number for part in ray_way(here, there) for number in part.flatten().tolist()]


def _warp(here: Camera, other: PosedImage, planes: Tensor) -> tuple[Tensor, Tensor]:
    """(D, C, H, W) of `other` as seen from here if all had one inverse depth; (D, H, W) where that is inside of it."""
    a, b = ray_map(here, other.camera, planes.device)
    c = planes[:, None, None]
    depth = a[2] + c * b[2]
    x = (a[0] + c * b[0]) / depth * (2 / other.camera.width) - 1
    y = (a[1] + c * b[1]) / depth * (2 / other.camera.height) - 1
    inside = (x.abs() < 1) & (y.abs() < 1) & (depth > 0)
    color = other.color.expand(len(planes), -1, -1, -1)
    warped = grid_sample(color, torch.stack([x, y], -1), padding_mode="border", align_corners=False)
    return warped, inside


def _variance(maps: Tensor, mean: Tensor, window: int) -> Tensor:
    """(D, H, W) variance within windows, summed over the colours of (D, C, H, W) maps."""
    return (_box(maps.square().sum(1), window) - mean.square().sum(1)).clamp_min_(0)


def _box(maps: Tensor, size: int) -> Tensor:
    """Means over square windows of maps (D, H, W); at the border, over the window that the border's pixels continue."""
    half, (height, width) = size // 2, maps.shape[1:]
    padded = pad(maps[None], (half, half, half, half), mode="replicate")[0]
    rows = padded[..., :width].clone()  # sums of shifted copies: several times faster than pooling on a CPU
    for shift in range(1, size):
        rows += padded[..., shift : shift + width]
    total = rows[:, :height].clone()
    for shift in range(1, size):
        total += rows[:, shift : shift + height]
    return total.div_(size**2)
