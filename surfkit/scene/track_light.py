"""How cameras changed the light, from the colours of sparse points: the same place in several photographs.

After Goldman, "Vignette and Exposure Calibration and Compensation" (PAMI 2010), with the model of `camera-response`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.ndimage import map_coordinates

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.scene.normal_equations import solved
from surfkit.scene.observations import Observations
from surfkit.scene.photos import read_draft
from surfkit.scene.response import (
    CENTRE,
    CURVE,
    FALLOFF,
    KNEE,
    MAX_SLOPE_CHANGE,
    OF_CAMERA,
    corner_light,
    curve_slope,
    curve_terms,
    curved,
    falloff,
    sensor_scale,
)
from surfkit.scene.scene import View
from surfkit.scene.srgb import from_linear, linear

PHASE = "comparing the light of photographs"
DRAFT_SIDE_PX = 256
"""Longer side at which photographs are read, pixels, or up to twice that: the colour of a place is a mean around it."""
DARK, BRIGHT = 0.03, 0.97
"""Colours beyond say little: noise there, and white that is cut off."""
MAX_POINTS_PER_PHOTO, MAX_SIGHTS = 300, 3_000_000
"""On average, and of all photographs, of which a million take a GB; other points are left out, chosen at random."""
ROUNDS = 20
"""Of the robust fit; each solves a linear problem."""
SHARES = (1.0, 0.5, 0.25, 0.125)
"""Of a step that are tried: where the problem is far from linear, a whole one may lead away."""
LEAST_PROGRESS = 1e-5
"""The fit ends where a round lowers its cost by a smaller share."""
ROBUST = 2.0
"""Differences of so many standard deviations count half (Cauchy)."""
UNEVEN_STOPS, UNEVEN_BALANCE, DARK_CORNER, UNEVEN_CURVE = 0.5, 0.1, 0.8, 0.03
"""Light is uneven from these on, see `LightSpread`."""
MIN_SEEN = 10
"""Points that a photograph must share with others to be compared with them."""
MEANS = 3
"""Reweighted means of the light of a point, from the median of its sights on."""
FIRST_DEVIATION, MIN_DEVIATION = 0.05, 1e-4
"""Of what is left: before the first round, and the least that is believed."""
SPREAD = {"stops": 3.0, "falloff": 1.0, "centre": 0.02, "curve": 0.3}
"""Standard deviations of what is expected before any photograph is seen, around no change at all. Lenses are centred:
where sights hardly tell, shine that depends on the direction would move the centre far off, and darken corners that no
sight reaches."""
SAME_CURVE = 1e-4
"""The same of the mean curve of all photographs."""


@dataclass(frozen=True)
class TrackColors:
    """Colours of sparse points in photographs, K of them.

    Attributes:
        photo: (K,) int64, the photograph.
        point: (K,) int64, the number of the point.
        place: (K, 2) float64 x and y on the sensor, from the principal point, in halves of the picture's diagonal.
        color: (K, 3) float64 sRGB in [0, 1].
    """

    photo: np.ndarray
    point: np.ndarray
    place: np.ndarray
    color: np.ndarray


@dataclass(frozen=True)
class TrackLight:
    """What a fit has found.

    Attributes:
        stops: (V, 3) of red, green and blue of each photograph, with a mean of 0.
        cameras: (C, 8) numbers of each camera, see `scene.response`.
        seen: (V,) int64, how many points each photograph shares with others; below `MIN_SEEN` its stops are a guess.
        deviation: Standard deviation of what is left, of sRGB colours in [0, 1].
    """

    stops: np.ndarray
    cameras: np.ndarray
    seen: np.ndarray
    deviation: float


def track_colors(views: Sequence[View], tracks: Observations) -> TrackColors:
    """Colours of the sparse points that two photographs and more show; a photograph that cannot be read shows none."""
    shown = [tracks.seen.get(view.name) for view in views]
    counts = sum((np.bincount(one.points, minlength=len(tracks.xyz)) for one in shown if one is not None), start=0)
    kept = np.flatnonzero(np.asarray(counts) > 1)
    total, most = int(np.asarray(counts)[kept].sum()), min(MAX_POINTS_PER_PHOTO * len(views), MAX_SIGHTS)
    if total > most:
        kept = np.sort(np.random.default_rng(0).permutation(kept)[: len(kept) * most // total])
    rows = np.full(len(tracks.xyz), -1)
    rows[kept] = np.arange(len(kept))

    def look(at: int) -> tuple[np.ndarray, ...] | None:
        one, camera = shown[at], views[at].camera
        if one is None:
            return None
        some = (rows[one.points] >= 0) & ((one.at > 0) & (one.at < 1)).all(1)
        try:
            pixels = read_draft(views[at].path, DRAFT_SIDE_PX, views[at].pixels)
        except BadInput:  # told where it is trained on
            return None
        share = one.at[some]
        height, width = pixels.shape[:2]
        spots = (share[:, 1] * height - 0.5, share[:, 0] * width - 0.5)
        colors = [map_coordinates(pixels[..., c].astype(np.float64), spots, order=1, mode="nearest") for c in range(3)]
        place = (share * (camera.width, camera.height) - (camera.cx, camera.cy)) * sensor_scale(camera)
        return np.full(len(share), at), rows[one.points[some]], place, np.stack(colors, 1) / 255

    found = []
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for done, one in enumerate(pool.map(look, range(len(views))), 1):
            emit(Progress(PHASE, done, len(views)))
            found += [one] if one is not None else []
    if not found:
        return TrackColors(
            *(np.zeros(shape, kind) for shape, kind in (((0,), int), ((0,), int), ((0, 2), float), ((0, 3), float)))
        )
    return TrackColors(*(np.concatenate(each) for each in zip(*found, strict=True)))


def rows_of(views: Sequence[View]) -> np.ndarray:
    """(V,) int64, the camera that took each view: cameras are numbered in the order of their first views."""
    names = {name: row for row, name in enumerate(dict.fromkeys(view.taken_by for view in views))}
    return np.array([names[view.taken_by] for view in views], np.int64)


@dataclass(frozen=True)
class LightSpread:
    """How far photographs differ.

    Attributes:
        stops: From the 10th to the 90th percentile of the exposures.
        balance: The same of red, or of blue, as shares of green; the larger one.
        corner: Light that is left half a diagonal away from the middle of the picture, as a share of that in the
            middle; of the camera with the darkest corners.
        curve: Largest difference, in colours in [0, 1], between the response curve of a camera and the mean one.
        cameras: How many cameras there are.
    """

    stops: float
    balance: float
    corner: float
    curve: float = 0.0
    cameras: int = 1

    @classmethod
    def of(cls, light: TrackLight) -> LightSpread:
        """That of a fit; photographs that share too few points do not count."""
        known = light.stops[light.seen >= MIN_SEEN]
        if not len(known):
            return cls(0.0, 0.0, 1.0)
        values = np.column_stack([known.mean(1), known[:, 0] - known[:, 1], known[:, 2] - known[:, 1]])
        low, high = np.percentile(values, [10, 90], axis=0)
        stops, *balance = (high - low).tolist()
        corner = min(map(corner_light, light.cameras))
        fine = np.linspace(0, 1, 101)
        curve = max(float(np.abs(curved(fine, numbers[CURVE]) - fine).max()) for numbers in light.cameras)
        return cls(stops, 2 ** max(balance) - 1, corner, curve, len(light.cameras))

    @property
    def is_uneven(self) -> bool:
        """Whether one colour for each place cannot explain the photographs."""
        uneven = self.stops >= UNEVEN_STOPS or self.balance >= UNEVEN_BALANCE
        return uneven or self.corner <= DARK_CORNER or self.curve >= UNEVEN_CURVE

    def remedy(self, has_tracks: bool, settings: Sequence[str]) -> str:
        """What is said of light that is uneven, with what to do.

        Args:
            has_tracks: Whether the data set tells which photographs show which points.
            settings: Dotted paths of the appearances to add.
        """
        if has_tracks:
            cure = (
                f"add {' '.join(f'{one}:camera-response' for one in settings)}, which finds all of it before training"
            )
        else:
            learned = " ".join(f"{one}:exposure" for one in settings)
            cure = (
                f"add {learned}, which learns an exposure for each, or give `surfkit prepare points` and choose "
                "camera-response"
            )
        return f"the same places look different: {self}; {cure}"

    def __str__(self) -> str:
        several = f", response curves of {self.cameras} cameras by {self.curve:.0%} of the range"
        return (
            f"exposures differ by {self.stops:.1f} stops and white balance by {self.balance:.0%} (10th to 90th "
            f"percentile){several * (self.cameras > 1)}; corners have {self.corner:.0%} of the light of the middle"
        )


def fit_light(colors: TrackColors, taken_by: np.ndarray) -> TrackLight:
    """Exposure and white balance of photographs, vignetting and curves of cameras that explain the colours of points.

    The logarithm of light is a sum: that of the point, the stops of the photograph, less the falloff of the camera. The
    sum is fitted by robust least squares, in which errors count as differences of sRGB colours.

    Args:
        colors: Of points in photographs.
        taken_by: (V,) int64, the camera of each photograph, 0 to C - 1.
    """
    count, cameras = len(taken_by), int(taken_by.max(initial=-1)) + 1
    stops, values = np.zeros((count, 3)), np.zeros((cameras, OF_CAMERA))
    usable = ((colors.color > DARK) & (colors.color < BRIGHT)).all(1)
    usable &= (np.bincount(colors.point[usable], minlength=colors.point.max(initial=-1) + 1) > 1)[colors.point]
    photo, point, place, color = (each[usable] for each in (colors.photo, colors.point, colors.place, colors.color))
    seen = np.bincount(photo, minlength=count)
    if not len(photo):
        return TrackLight(stops, values, seen, 0.0)
    camera = taken_by[photo]
    problem = _Problem(photo, point, camera, place, color, np.bincount(taken_by, minlength=cameras) / count)
    numbers, deviation = _Numbers(stops, values), FIRST_DEVIATION
    for _ in range(ROUNDS):
        deviation = max(MIN_DEVIATION, 1.4826 * float(np.median(np.abs(problem.residuals(numbers, deviation).left))))
        now = problem.residuals(numbers, deviation)
        step, cost = problem.step(now, numbers, deviation), problem.cost(now, numbers, deviation)
        for share in SHARES:
            tried = problem.moved(numbers, step, share)
            if (reached := problem.cost(problem.residuals(tried, deviation), tried, deviation)) < cost:
                numbers = tried
                break
        if reached > (1 - LEAST_PROGRESS) * cost:
            break
    return TrackLight(numbers.stops, numbers.cameras, seen, deviation)


@dataclass(frozen=True)
class _Numbers:
    """Stops (V, 3) and numbers of cameras (C, 8)."""

    stops: np.ndarray
    cameras: np.ndarray

    @property
    def flat(self) -> np.ndarray:
        """(V x 3 + C x 8,)."""
        return np.concatenate([self.stops.ravel(), self.cameras.ravel()])


@dataclass(frozen=True)
class _Residuals:
    """What numbers leave: (K, 3) colours before the response curve, as the numbers have them; log2 of the light of
    points as each sight has it; d colour / d stops; and the difference of that light to the mean of its point, as a
    difference of colours."""

    encoded: np.ndarray
    light: np.ndarray
    slope: np.ndarray
    left: np.ndarray


@dataclass(frozen=True)
class _Problem:
    """Sights of points: photographs, points and cameras (K,), places (K, 2), colours (K, 3); the share of photographs
    that each camera took, (C,)."""

    photo: np.ndarray
    point: np.ndarray
    camera: np.ndarray
    place: np.ndarray
    color: np.ndarray
    shares: np.ndarray

    def squared(self, numbers: _Numbers) -> tuple[np.ndarray, np.ndarray]:
        """(K, 2) places from where the vignetting is centred, and (K,) their squared distance."""
        offset = self.place - numbers.cameras[self.camera][:, CENTRE]
        return offset, (offset * offset).sum(1)

    def moved(self, numbers: _Numbers, step: np.ndarray, share: float) -> _Numbers:
        """The numbers after a share of a step, (V x 3 + C x 8,): with no mean stops or curve, and monotone curves."""
        stops = numbers.stops + share * step[: numbers.stops.size].reshape(-1, 3)
        cameras = numbers.cameras + share * step[numbers.stops.size :].reshape(-1, OF_CAMERA)
        cameras[:, CURVE] -= self.shares @ cameras[:, CURVE]
        size = np.abs(cameras[:, CURVE]).sum(1, keepdims=True).clip(1e-12)
        cameras[:, CURVE] *= (MAX_SLOPE_CHANGE / size).clip(max=1)
        return _Numbers(stops - stops.mean(0), cameras)

    def residuals(self, numbers: _Numbers, deviation: float) -> _Residuals:
        curve = numbers.cameras[self.camera][:, CURVE].T[..., None]
        shift = numbers.stops[self.photo] - falloff(numbers.cameras[self.camera].T, self.squared(numbers)[1])[:, None]
        encoded = _before_curve(self.color, curve)
        light, slope = np.log2(linear(encoded).clip(1e-6)) - shift, _stops_slope(encoded, curve)
        mean = self.medians(light)
        for _ in range(MEANS):
            left = (light - mean) * slope
            mean = self.means(light, slope**2 / (1 + (left / (ROBUST * deviation)) ** 2))
        # Where the point and the photograph have it: by its own colour, the noise of a sight would pass for a curve.
        encoded = from_linear((2 ** (mean + shift)).clip(0, 1))
        slope = _stops_slope(encoded, curve)
        return _Residuals(encoded, light, slope, (light - mean) * slope)

    def medians(self, value: np.ndarray) -> np.ndarray:
        """(K, 3) of (K, 3) values, the median of all sights of the same point."""
        counts = np.bincount(self.point)
        middle = np.cumsum(counts) - counts + (counts - 1) // 2
        columns = [column[np.lexsort((column, self.point))][middle.clip(max=len(column) - 1)] for column in value.T]
        return np.stack(columns, 1)[self.point]

    def means(self, value: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """(K, 3) of (K, 3) values, the weighted mean of all sights of the same point."""
        sums, total = (
            np.stack([np.bincount(self.point, column) for column in each.T], 1) for each in (weight * value, weight)
        )
        return (sums / total.clip(1e-12))[self.point]

    def cost(self, now: _Residuals, numbers: _Numbers, deviation: float) -> float:
        """What the fit minimises."""
        parts = np.log1p((now.left / (ROBUST * deviation)) ** 2).sum() * ROBUST**2
        mean = self.shares @ numbers.cameras[:, CURVE]
        return float(parts + ((numbers.flat / self.spread(numbers)) ** 2).sum() + ((mean / SAME_CURVE) ** 2).sum())

    def spread(self, numbers: _Numbers) -> np.ndarray:
        """Standard deviations of `numbers.flat` before any photograph is seen."""
        of_camera = np.repeat([SPREAD["falloff"], SPREAD["centre"], SPREAD["curve"]], [3, 2, 3])
        return np.concatenate([np.full(numbers.stops.size, SPREAD["stops"]), np.tile(of_camera, len(numbers.cameras))])

    def step(self, now: _Residuals, numbers: _Numbers, deviation: float) -> np.ndarray:
        """(V x 3 + C x 8,) a step of Gauss and Newton; the light of points is eliminated."""
        offset, squared = self.squared(numbers)
        a, b, c = numbers.cameras[self.camera][:, FALLOFF].T
        steep = 2 * (a + squared * (2 * b + 3 * squared * c))
        of_camera = numbers.stops.size + OF_CAMERA * self.camera[:, None] + np.arange(OF_CAMERA)
        width, each = len(numbers.flat), np.arange(len(self.photo))
        normal, pull = sparse.csr_matrix((width, width)), np.zeros(width)
        weights = now.slope**2 / (1 + (now.left / (ROBUST * deviation)) ** 2) / deviation**2
        curve = curve_terms(now.encoded)
        for channel in range(3):
            weight, light = weights[:, channel], now.light[:, channel]
            entries = [np.ones_like(squared), -squared, -(squared**2), -(squared**3), *(steep * offset.T)]
            entries += [term[:, channel] / now.slope[:, channel] for term in curve]
            columns = np.concatenate([3 * self.photo[:, None] + channel, of_camera], 1)
            matrix = sparse.csr_matrix(
                (np.stack(entries, 1).ravel(), (np.repeat(each, columns.shape[1]), columns.ravel())), (len(each), width)
            )
            points = sparse.csr_matrix((weight, (self.point, each)))
            inverse = sparse.diags(1 / (np.asarray(points.sum(1)).ravel() + 1e-12))
            across = points @ matrix
            weighted = matrix.T @ sparse.diags(weight)
            normal += weighted @ matrix - across.T @ inverse @ across
            pull += weighted @ light - across.T @ (inverse @ (points @ light))
        alike = sparse.hstack(
            [
                sparse.csr_matrix((3, numbers.stops.size)),
                sparse.kron(self.shares[None], np.eye(3, OF_CAMERA, CURVE.start)),
            ]
        ).tocsr()
        held = sparse.diags(self.spread(numbers) ** -2.0) + alike.T @ alike / SAME_CURVE**2
        return solved(normal + held, pull - held @ numbers.flat, numbers.cameras.size)


def _stops_slope(encoded: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """(K, 3) d colour / d stops at colours before response curves, (3, K, 1)."""
    steep = np.where(encoded <= KNEE, encoded, (encoded + 0.055) / 2.4)
    return math.log(2) * steep * curve_slope(encoded, curve)


def _before_curve(color: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """(K, 3) values that response curves, (3, K, 1), map to colours (K, 3); by Newton's method."""
    found = color
    for _ in range(6 if curve.any() else 0):
        found = (found - (curved(found, curve) - color) / curve_slope(found, curve)).clip(0, 1)
    return found
