"""From a pixel of one view to another view and back, over the depth rendered in both (PGSR, arXiv 2406.06521)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor
from torch.nn.functional import pad

from surfkit.core.check import BadInput
from surfkit.core.schedule import Steps
from surfkit.losses.base import Neighbour
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera

MIN_SURFACE_ALPHA = 0.5
"""The expected depth counts as a surface where alpha is above this, as the median depth does."""
MIN_VALID_SHARE = 0.999
"""A bilinear sample counts if at least this share of it comes from pixels that count."""
CPU = torch.device("cpu")
MIN_DEPTH = 1e-4
"""Depths and inverse depths below this, in local units, are as good as none."""


@dataclass(frozen=True)
class TwoViews:
    """What losses between two views have in common; each is a `Loss` too."""

    needs_neighbour: ClassVar[bool] = True

    weight: float
    """Loss weight in the steps that have the term."""

    start: Steps = 7_000
    """Steps without this term, as a surface must form first; 0 has it from the first step."""

    every: int = 3
    """Only steps that are a multiple of this count; 1 has all. Terms with the same number share the rendered view."""

    limit: float = 1.0
    """Pixels that come back from the neighbour with an error of more pixels do not count."""

    depth: Literal["median", "expected"] = "expected"
    """Which rendered depth is the surface, in both views: the expected one moves all splats of a pixel."""

    def __post_init__(self) -> None:
        if not 0 <= self.weight < float("inf") or self.every < 1 or not self.limit > 0:
            given = f"weight {self.weight:g}, every {self.every}, limit {self.limit:g}"
            raise BadInput(f"{type(self).__name__} has {given}; give 0 or more, 1 or more, and a limit above 0")

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if index > self.start and index % self.every == 0 else 0.0


def surface_depth(maps: Maps, which: Literal["median", "expected"]) -> Tensor:
    """(H, W) camera z of the rendered surface; 0 where there is none."""
    if which == "median":
        return maps.need("median")
    return torch.where(maps.need("alpha") > MIN_SURFACE_ALPHA, maps.expected_depth(), 0.0)


def spread(size: tuple[int, int], side: int, seed: int, device: torch.device = CPU) -> tuple[Tensor, Tensor]:
    """Rows and columns, (K,) each, of one pixel at random in every square of a picture of (H, W) pixels.

    None comes twice, so that no gradient is added up in an order that threads decide. Of the squares that reach over
    the right and lower rim some have none, so that every pixel is as likely as any other.

    Args:
        size: (H, W).
        side: Of the squares, pixels.
        seed: Of the draw, which is the same on every device.
        device: That the two lie on.
    """
    y, x = (torch.arange(0, length, side) for length in size)
    draws = torch.randint(side, (2, len(y), len(x)), generator=torch.Generator().manual_seed(seed))
    y, x = y[:, None] + draws[0], x[None] + draws[1]
    inside = (y < size[0]) & (x < size[1])
    return y[inside].to(device), x[inside].to(device)


def motion(camera: Camera, other: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation (3, 3) and shift (3, 1) that take points from the frame of one camera to that of another.

    `like`: has the type and the device that both shall have.
    """
    both = other.world_to_camera @ torch.linalg.inv(camera.world_to_camera)
    return both[:3, :3].to(like), both[:3, 3:].to(like)


def projected(camera: Camera, points: Tensor) -> Tensor:
    """(2, ...) x and y in pixels of (3, ...) points of the camera's frame; those not before it fall on any place."""
    z = torch.where(points[2] > MIN_DEPTH, points[2], 1.0)
    return torch.stack([camera.fx * points[0] / z + camera.cx, camera.fy * points[1] / z + camera.cy])


def sampled(image: Tensor, at: Tensor) -> Tensor:
    """(...) bilinear samples of an image (h, w) at (2, ...) x and y in pixels, centres at +0.5; 0 outside.

    The image is held constant, and each place has a gradient of its own: nothing is added up in an order that the
    threads of a GPU decide, as `grid_sample` does.
    """
    (height, width), around = image.shape, pad(image.detach(), (1, 1, 1, 1))
    x, y = (
        (place.nan_to_num(nan=-1.0) + 0.5).clamp(0, size + 1)  # far outside is outside; in `around`, centres at +0
        for place, size in zip(at, (width, height), strict=True)
    )
    left, top = (place.detach().clamp_max(size).long() for place, size in ((x, width), (y, height)))
    right, below = x - left, y - top
    upper = (1 - right) * around[top, left] + right * around[top, left + 1]
    lower = (1 - right) * around[top + 1, left] + right * around[top + 1, left + 1]
    return (1 - below) * upper + below * lower


def is_whole(counts: Tensor, at: Tensor) -> Tensor:
    """(...) bool, whether all pixels (h, w) that a bilinear sample at (2, ...) takes its value from count."""
    with torch.no_grad():
        return sampled(counts.to(at), at.detach()) > MIN_VALID_SHARE


@dataclass(frozen=True)
class Opposite:
    """The surface that a neighbour shows, as it is looked into from another view.

    Attributes:
        camera: Of the neighbour.
        inverse: (h, w) inverse camera z, which is linear in the picture on a plane; 0 where there is none.
        counts: (h, w) bool, where there is one that no mask hides.
    """

    camera: Camera
    inverse: Tensor
    counts: Tensor

    @classmethod
    def of(cls, neighbour: Neighbour, which: Literal["median", "expected"]) -> Opposite:
        """Of the median or the expected depth."""
        surface = surface_depth(neighbour.maps, which)
        there = surface > MIN_DEPTH
        inverse = torch.where(there, 1 / torch.where(there, surface, 1.0), 0.0)
        return cls(neighbour.view.camera, inverse, there if neighbour.mask is None else there & neighbour.mask)


def round_trip(depth: Tensor, rays: Tensor, camera: Camera, opposite: Opposite) -> tuple[Tensor, Tensor]:
    """How far from itself a pixel comes back that goes to the neighbour's surface and from there to the first view.

    The point of the pixel is projected into the neighbour; its depth there is that of the neighbour's surface, sampled
    bilinearly in the inverse, which is exact on planes; and that point is projected into the first view.

    Args:
        depth: (P,) camera z of the pixels in the first view, 0 where there is none. The way back depends on it too.
        rays: (3, P) directions of the pixels in the frame of the first view, with z = 1.
        camera: Of the first view.
        opposite: The second view.

    Returns:
        (P,) distances in pixels, and (P,) bool where there is one: the place lies before the neighbour and in its
        picture, where it has a depth and no mask.
    """
    lens = opposite.camera
    rotation, shift = motion(camera, lens, depth)
    points = rotation @ (rays * depth) + shift
    at = projected(lens, points)
    inverse = sampled(opposite.inverse, at)
    valid = (depth > MIN_DEPTH) & (points[2] > MIN_DEPTH) & is_whole(opposite.counts, at) & (inverse > MIN_DEPTH)
    way = torch.stack([(at[0] - lens.cx) / lens.fx, (at[1] - lens.cy) / lens.fy, torch.ones_like(inverse)])
    back = rotation.T @ (way / torch.where(valid, inverse, 1.0) - shift)
    valid = valid & (back[2] > MIN_DEPTH)
    start = projected(camera, rays)
    square = (projected(camera, back) - start).square().sum(0)
    apart = valid & (square > 0)  # no root of 0, whose slope is infinite
    return torch.where(apart, torch.where(apart, square, 1.0).sqrt(), 0.0), valid


def agreement(error: Tensor, valid: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Constant weights exp(-error) of the pixels that come back nearer than a limit in pixels, and which these are."""
    counts = valid & (error.detach() < limit)
    return torch.where(counts, (-error.detach()).exp(), 0.0), counts
