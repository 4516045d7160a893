"""The compiled PatchMatch: planes of a picture that are tried against other pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.depth.base import KnownSurface
from surfkit.depth.cost_volume import ray_map
from surfkit.raster.native import kernels, lacking, module
from surfkit.scene.camera import Camera

BRIGHTNESS_PIXELS = 2000
"""Pixels, about, by which the brightness of two pictures is compared."""
MAX_MATCHING_COST, MIN_MATCHING_PIXELS = 0.3, 50
"""Only pixels that match at less than this cost are used for that, if there are more than so many."""
MIN_FACING = 0.1
"""Cosine of the angle between ray and normal of a known surface; with less it is seen at a grazing angle."""
MAX_BRIGHTNESS_GAIN = 4.0
"""Largest gain, and one over the least."""


@dataclass(frozen=True, eq=False)
class GreyImage:
    """A camera and the grey values that it saw.

    Attributes:
        camera: At the size of the picture.
        value: (H, W) uint8.
    """

    camera: Camera
    value: np.ndarray

    @cached_property
    def in_pairs(self) -> np.ndarray:
        """(H + 2 b, W + 2 b + 1) uint16: a pixel and the one below, so that four bytes are what interpolation takes.

        Continued by a border of b pixels, and one more to the right.
        """
        border = kernels().STEREO_BORDER
        wide = np.pad(self.value, (border, border + 1), mode="edge").astype(np.uint16)
        return wide[:-1] | wide[1:] << 8

    def padded(self) -> np.ndarray:
        """(H + 2 r, W + 2 r) float32, continued by the radius of the windows."""
        return np.pad(self.value, kernels().STEREO_RADIUS, mode="edge").astype(np.float32)


@dataclass
class Planes:
    """A plane for each pixel of a picture, to be improved.

    Attributes:
        value: (H, W, 3) float32 inverse depth, and its change from a pixel to the next to the right and below.
        cost: (H, W) float32 of matching, smoothness and consistency.
        each: (H, W, V) uint8 costs by view, 255 is 1 and more.
    """

    value: np.ndarray
    cost: np.ndarray
    each: np.ndarray

    @classmethod
    def at(cls, inverse: np.ndarray, views: int) -> Planes:
        """Planes that face the camera, of these (H, W) inverse depths."""
        value = np.zeros((*inverse.shape, 3), np.float32)
        value[..., 0] = inverse
        return cls(value, np.full(inverse.shape, 2, np.float32), np.full((*inverse.shape, views), 255, np.uint8))

    def lie_in(self, surface: KnownSurface, camera: Camera, span: tuple[float, float]) -> None:
        """Take the planes of a surface where it is known, and between two inverse depths; see `PlaneMap.normals`.

        Where it is seen at a grazing angle, or its normal is not known, they face the camera.

        Args:
            surface: As the camera sees it.
            camera: Of the picture.
            span: Least and greatest inverse depth.
        """
        inverse, normal = surface.inverse.to("cpu"), surface.normal.to("cpu")
        rays = camera.rays().to(inverse.dtype)
        facing = (normal * rays).sum(0)
        steep = facing.abs() < MIN_FACING * rays.norm(dim=0)
        away = torch.where(steep, 0, normal[:2] * inverse / torch.where(steep, 1, facing))
        value = torch.stack([inverse, away[0] / camera.fx, away[1] / camera.fy], -1).numpy()
        there = ((inverse >= span[0]) & (inverse <= span[1])).numpy()
        self.value[there] = value[there]

    def resized(self, height: int, width: int) -> Planes:
        """The same planes at another size."""
        old_height, old_width = self.cost.shape
        x, y = (np.arange(width) + 0.5) * old_width / width - 0.5, (np.arange(height) + 0.5) * old_height / height - 0.5
        at_x, at_y = np.rint(x).astype(int).clip(0, old_width - 1), np.rint(y).astype(int).clip(0, old_height - 1)
        value = self.value[at_y[:, None], at_x].copy()
        value[..., 0] += value[..., 1] * (x - at_x) + value[..., 2] * (y - at_y)[:, None]
        value[..., 1] *= old_width / width
        value[..., 2] *= old_height / height
        rows = at_y[:, None], at_x
        return Planes(value, self.cost[rows].copy(), self.each[rows].copy())


@dataclass(frozen=True)
class MatchingSettings:
    """What makes a plane good, and how far one is changed.

    Attributes:
        low: Least inverse depth.
        high: Greatest inverse depth.
        parallax: Pixels by which a picture moves, a unit of inverse depth.
        jitter_px: Parallax by which planes are changed at random.
        smoothness: Cost of a difference of one pixel of parallax from the neighbours.
        consistency: Cost of a reprojection error of one pixel.
        spread: Difference of grey values, of 255, at which a pixel of the window counts 1 / e.
        brightness: Cost of a relative difference of brightness between the windows.
        samples: Pixels of a window that are compared; 16 or 32.
        best: Views that count for a pixel.
        window: Side of the windows compared, pixels; odd.
        survey: Look at all views anew, to choose those that count.
    """

    low: float
    high: float
    parallax: float
    jitter_px: float
    smoothness: float
    consistency: float
    spread: float
    brightness: float
    samples: int
    best: int
    window: int
    survey: bool


def improve(
    here: GreyImage,
    others: Sequence[GreyImage],
    planes: Planes,
    terms: MatchingSettings,
    seed: int,
    known: Sequence[Tensor | None] | None = None,
) -> None:
    """One pass over both colours of the checkerboard, in place; no number of threads changes a bit.

    Args:
        here: The picture whose planes are sought.
        others: To compare it with.
        planes: At the size of the picture.
        terms: See there.
        seed: Of the random changes.
        known: (h, w) float32 inverse depth of the others, for geometric consistency.
    """
    camera = here.camera
    ways = [[*way(camera, other.camera), *way(other.camera, camera)] for other in others]
    kernels().patch_match(
        here.padded(),
        [camera.fx, camera.fy, camera.cx, camera.cy],
        pattern(terms.window),
        [other.in_pairs for other in others],
        ways,
        gains(here, others, planes),
        [None if inverse is None else inverse.numpy() for inverse in known or [None] * len(others)],
        planes.value,
        planes.cost,
        planes.each,
        [terms.low, terms.high, terms.parallax, terms.jitter_px, terms.smoothness, terms.consistency]
        + [terms.spread, terms.brightness],
        terms.samples,
        terms.best,
        terms.survey,
        seed % 2**32,
        kernels().kernels_in_use(),
        torch.get_num_threads(),
    )


def require_native() -> None:
    """BadInput where surfkit was installed without its compiled part."""
    if module() is None:
        raise BadInput(f"patch-match needs the compiled kernels: {lacking()}, or use plane-sweep in its place")


def pattern(window: int) -> np.ndarray:
    """(3, S) float32: x and y of the S pixels of a window that are compared, and their weights; 0 for unused ones.

    The first half are those of a grid that is spread over the window, and the others those of a finer one that are
    nearest to the middle. Each has its opposite, but for one of these where an odd number of places is left for them.
    """
    room, half = kernels().STEREO_SAMPLES, window // 2
    side = np.rint(np.linspace(-half, half, min(window, math.isqrt(room // 2)))).astype(int).tolist()
    chosen = [(x, y) for y in side for x in side]
    step = max(1, half // 3)
    finer = range(-(half // step) * step, half + 1, step)
    rest = [(x, y) for y in finer for x in finer if (x, y) not in chosen]
    for _, ring in groupby(sorted(rest, key=from_middle), from_middle):
        around = list(ring)  # row by row, so that each end is the opposite of the other
        fits = min(len(around), room - len(chosen))
        first = (len(around) - fits) // 2
        chosen += around[first : first + fits]
    found = np.zeros((3, room), np.float32)
    at = np.array(chosen, np.float32).T
    found[:2, : at.shape[1]] = at
    found[2, : at.shape[1]] = np.exp(-np.square(at).sum(0) / (2 * half**2))
    return found


def from_middle(at: tuple[int, int]) -> int:
    """Squared distance of a pixel of a window from the middle."""
    return at[0] ** 2 + at[1] ** 2


def gains(here: GreyImage, others: Sequence[GreyImage], planes: Planes) -> list[float]:
    """Gain of each other picture: its grey values times this are as bright as those of `here`, whatever the exposure.

    The median ratio between pixels and what their planes show in the other picture; 1 where nothing is shown.

    Args:
        here: The picture that the planes belong to.
        others: V pictures.
        planes: At the size of `here`; their costs by view tell which pixels match.

    Returns:
        V gains, from 1 / `MAX_BRIGHTNESS_GAIN` to `MAX_BRIGHTNESS_GAIN`.
    """
    height, width = here.value.shape
    step = max(1, round((height * width / BRIGHTNESS_PIXELS) ** 0.5))
    y, x = (places.ravel() for places in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    ours, found = here.value[y, x].astype(np.float64), []
    for other, match in zip(others, planes.each[y, x].T, strict=True):
        numbers = np.array(way(here.camera, other.camera))
        at = numbers[:9].reshape(3, 3) @ np.stack([x, y, np.ones_like(x)])
        at += numbers[9:, None] * planes.value[y, x, 0]
        in_front = at[2] > 0
        u, v = np.rint(at[:2] / np.where(in_front, at[2], 1))
        shown = in_front & (u >= 0) & (v >= 0) & (u < other.camera.width) & (v < other.camera.height)
        matching = shown & (match < 255 * MAX_MATCHING_COST)
        counts = matching if matching.sum() > MIN_MATCHING_PIXELS else shown
        theirs = other.value[v[counts].astype(int), u[counts].astype(int)]
        ratio = float(np.median((ours[counts] + 1) / (theirs + 1.0))) if counts.any() else 1.0
        found.append(min(max(ratio, 1 / MAX_BRIGHTNESS_GAIN), MAX_BRIGHTNESS_GAIN))
    return found


def way(here: Camera, there: Camera) -> list[float]:
    """A (3, 3) and b (3,) in a row: a pixel (x, y) of inverse depth w falls on A (x, y, 1) + b w, over its third.

    Pixels are numbered from the middle of the first one.
    """
    turn = there.world_to_camera.numpy() @ np.linalg.inv(here.world_to_camera.numpy())  # faster than torch's for one
    into, out = lens(there), np.linalg.inv(lens(here))
    return [*(into @ turn[:3, :3] @ out).flatten().tolist(), *(into @ turn[:3, 3]).tolist()]


def lens(camera: Camera) -> np.ndarray:
    """(3, 3) from rays to pixels that are numbered from the middle of the first one."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


def parallax_of(here: GreyImage, others: Sequence[GreyImage], planes: Planes) -> float:
    """Pixels by which other pictures move, a unit of inverse depth, about the median of the planes; the mean of all."""
    middle, moves = float(np.median(planes.value[..., 0])), []
    low, high = 0.98 * middle, 1.02 * middle
    for other in others:
        a, b = (part.numpy() for part in ray_map(here.camera, other.camera, torch.device("cpu")))
        near, far = (a[:, ::16, ::16] + c * b[:, None, None] for c in (low, high))
        shift = near[:2] / near[2] - far[:2] / far[2]
        moves.append(float(np.median(np.hypot(*shift))) / (high - low))
    return float(np.mean(moves))
