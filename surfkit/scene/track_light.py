"""How cameras changed the light, from the colours of sparse points: the same place in several photographs.

After Goldman, "Vignette and Exposure Calibration and Compensation" (PAMI 2010), with the model of `camera-response`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from surfkit.scene.normal_equations import solved
from surfkit.scene.response import (
    CENTRE,
    CURVE,
    FALLOFF,
    KNEE,
    MAX_SLOPE_CHANGE,
    OF_CAMERA,
    curve_slope,
    curve_terms,
    curved,
    falloff,
)
from surfkit.scene.srgb import from_linear, linear
from surfkit.scene.track_colors import TrackColors

DARK, BRIGHT = 0.03, 0.97
"""Colours beyond say little: noise there, and white that is cut off."""
ROUNDS = 20
"""Of the robust fit; each solves a linear problem."""
SHARES = (1.0, 0.5, 0.25, 0.125)
"""Of a step that are tried: where the problem is far from linear, a whole one may lead away."""
LEAST_PROGRESS = 1e-5
"""The fit ends where a round lowers its cost by a smaller share."""
ROBUST = 2.0
"""Differences of so many standard deviations count half (Cauchy)."""
MIN_SEEN = 10
"""Points that a photograph must share with others to be compared with them."""
MEANS = 3
"""Reweighted means of the light of a point, from the median of its sights on."""
FIRST_DEVIATION, MIN_DEVIATION = 0.05, 0.004
"""Of what is left: before the first round, and the least that is believed, a step of 8 bits."""
SPREAD = {"stops": 3.0, "falloff": 1.0, "centre": 0.02, "curve": 0.3, "slope": 1.0}
"""Standard deviations of what is expected before any photograph is seen, around no change at all. Lenses are centred:
where sights hardly tell, shine that depends on the direction would move the centre far off, and darken corners that no
sight reaches."""
SAME_CURVE = 1e-4
"""The same of the mean curve of all photographs."""
HELD, HELD_STOPS, HELD_SLOPE = 0.003, 0.7, 25.0
"""Stops are held near 0 as if so large a share of the sights of a photograph showed it, less and less beyond so many
stops: some photographs were exposed quite otherwise. Without it, what all photographs have in common and no number
explains, such as haze towards their upper sides, adds up along a flight line to several stops. What a slope changes
within photographs is held near 0 so many times as strongly: it is a fifth, as a rule, of what exposures differ by. So
is the centre of a vignetting, by what a stop of it half a diagonal away would do: it could pass for a slope."""


@dataclass(frozen=True)
class TrackLight:
    """What a fit has found.

    Attributes:
        stops: (V, 3) of red, green and blue of each photograph, with a mean of 0.
        cameras: (C, 8) numbers of each camera, see `scene.response`.
        slope: (3, 3) of red, green and blue: stops that the light of all points gains with the direction it is seen in,
            along x, y and z of the world, see `sensor_axes`.
        seen: (V,) int64, how many points each photograph shares with others; below `MIN_SEEN` its stops are a guess.
        deviation: Standard deviation of what is left, of sRGB colours in [0, 1].
    """

    stops: np.ndarray
    cameras: np.ndarray
    slope: np.ndarray
    seen: np.ndarray
    deviation: float


def fit_light(colors: TrackColors, taken_by: np.ndarray, axes: np.ndarray) -> TrackLight:
    """Exposure and white balance of photographs, vignetting and curves of cameras that explain the colours of points.

    The logarithm of light is a sum: that of the point, the stops of the photograph, less the falloff of the camera, and
    a slope with the direction of the sight. The sum is fitted by robust least squares, in which errors count as
    differences of sRGB colours.

    Ground is brighter where it is seen with the sun behind the camera, so that every photograph of a flight has a
    bright side. Along a flight line, that cannot be told from exposures that rise from photograph to photograph over
    ground that becomes darker; a slope of 9 % in 160 photographs would pass for five stops. Both are held near 0: over
    a few photographs, it passes for exposures, over many for the slope that it is.

    Args:
        colors: Of points in photographs.
        taken_by: (V,) int64, the camera of each photograph, 0 to C - 1.
        axes: (V, 3, 2) `sensor_axes`; 0 for a photograph in which no slope is looked for.
    """
    count, cameras = len(taken_by), int(taken_by.max(initial=-1)) + 1
    stops, values, slope = np.zeros((count, 3)), np.zeros((cameras, OF_CAMERA)), np.zeros((3, 3))
    usable = np.flatnonzero(((colors.color > DARK) & (colors.color < BRIGHT)).all(1))
    usable = usable[shown_twice(colors.photo[usable], colors.point[usable])]
    photo, point, place, color = (each[usable] for each in (colors.photo, colors.point, colors.place, colors.color))
    seen = np.bincount(different(photo, point)[0], minlength=count)
    if not len(photo):
        return TrackLight(stops, values, slope, seen, 0.0)
    camera, aside = taken_by[photo], (axes[photo] @ place[:, :, None])[..., 0]
    problem = _Problem(photo, point, camera, place, aside, color, np.bincount(taken_by, minlength=cameras) / count)
    numbers, deviation = _Numbers(stops, values, slope), FIRST_DEVIATION
    for _ in range(ROUNDS):
        deviation = max(MIN_DEVIATION, 1.4826 * float(np.median(np.abs(problem.residuals(numbers, deviation).left))))
        now = problem.residuals(numbers, deviation)
        held = problem.held(now, count, deviation)
        step, cost = problem.step(now, numbers, held, deviation), problem.cost(now, numbers, held, deviation)
        for share in SHARES:
            tried = problem.moved(numbers, step, share)
            if (reached := problem.cost(problem.residuals(tried, deviation), tried, held, deviation)) < cost:
                numbers = tried
                break
        if reached > (1 - LEAST_PROGRESS) * cost:
            break
    return TrackLight(numbers.stops, numbers.cameras, numbers.slope, seen, deviation)


def shown_twice(photo: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(K,) bool, whether the point of a sight is shown by another photograph too.

    Args:
        photo, point: (K,) int64 of sights.
    """
    return (np.bincount(different(photo, point)[1]) > 1)[point]


def different(photo: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Photographs and points (K,) of sights, each pair once; tracks may hold a photograph twice."""
    return np.divmod(np.unique(photo * (most := point.max(initial=0) + 1) + point), most)


@dataclass(frozen=True)
class _Numbers:
    """Stops (V, 3), numbers of cameras (C, 8), and the slope (3, 3), see `TrackLight`."""

    stops: np.ndarray
    cameras: np.ndarray
    slope: np.ndarray

    @property
    def flat(self) -> np.ndarray:
        """(V x 3 + C x 8 + 9,)."""
        return np.concatenate([self.stops.ravel(), self.cameras.ravel(), self.slope.ravel()])

    @property
    def ends(self) -> tuple[int, int]:
        """Where stops and the numbers of cameras end in `flat`."""
        return self.stops.size, self.stops.size + self.cameras.size


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
class _Held:
    """How strongly numbers are held near 0: stops (V, 3), centres of vignettings (C, 2), and the slope of each colour,
    (3, 3, 3)."""

    stops: np.ndarray
    centre: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True)
class _Problem:
    """Sights of points: photographs, points and cameras (K,), places (K, 2), how far they lead aside of the optical
    axis in the world (K, 3), colours (K, 3); the share of photographs that each camera took, (C,)."""

    photo: np.ndarray
    point: np.ndarray
    camera: np.ndarray
    place: np.ndarray
    aside: np.ndarray
    color: np.ndarray
    shares: np.ndarray

    def squared(self, numbers: _Numbers) -> tuple[np.ndarray, np.ndarray]:
        """(K, 2) places from where the vignetting is centred, and (K,) their squared distance."""
        offset = self.place - numbers.cameras[self.camera][:, CENTRE]
        return offset, (offset * offset).sum(1)

    def moved(self, numbers: _Numbers, step: np.ndarray, share: float) -> _Numbers:
        """The numbers after a share of a step, as `flat`: with no mean stops or curve, and monotone curves."""
        of_stops, of_cameras, of_slope = np.split(share * step, numbers.ends)
        stops, slope = numbers.stops + of_stops.reshape(-1, 3), numbers.slope + of_slope.reshape(3, 3)
        cameras = numbers.cameras + of_cameras.reshape(-1, OF_CAMERA)
        cameras[:, CURVE] -= self.shares @ cameras[:, CURVE]
        size = np.abs(cameras[:, CURVE]).sum(1, keepdims=True).clip(1e-12)
        cameras[:, CURVE] *= (MAX_SLOPE_CHANGE / size).clip(max=1)
        return _Numbers(stops - stops.mean(0), cameras, slope)

    def residuals(self, numbers: _Numbers, deviation: float) -> _Residuals:
        curve = numbers.cameras[self.camera][:, CURVE].T[..., None]
        shift = numbers.stops[self.photo] - falloff(numbers.cameras[self.camera].T, self.squared(numbers)[1])[:, None]
        shift += self.aside @ numbers.slope.T
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

    def weights(self, now: _Residuals, deviation: float) -> np.ndarray:
        """(K, 3) of squared errors in stops."""
        return now.slope**2 / (1 + (now.left / (ROBUST * deviation)) ** 2) / deviation**2

    def held(self, now: _Residuals, photos: int, deviation: float) -> _Held:
        """By what the sights weigh."""
        weights = self.weights(now, deviation)
        stops = np.stack([np.bincount(self.photo, one, photos) for one in weights.T], 1)
        steep = (2 * self.place) ** 2 * weights.sum(1)[:, None]
        centre = np.stack([np.bincount(self.camera, one, len(self.shares)) for one in steep.T], 1)
        slope = np.einsum("kc,ki,kj->cij", weights, self.aside, self.aside)
        return _Held(HELD * stops, HELD * HELD_SLOPE * centre, HELD * HELD_SLOPE * slope)

    def cost(self, now: _Residuals, numbers: _Numbers, held: _Held, deviation: float) -> float:
        """What the fit minimises."""
        parts = np.log1p((now.left / (ROBUST * deviation)) ** 2).sum() * ROBUST**2
        parts += (held.stops * np.log1p((numbers.stops / HELD_STOPS) ** 2)).sum() * HELD_STOPS**2
        parts += (held.centre * numbers.cameras[:, CENTRE] ** 2).sum()
        parts += np.einsum("ci,cij,cj", numbers.slope, held.slope, numbers.slope)
        mean = self.shares @ numbers.cameras[:, CURVE]
        return float(parts + ((numbers.flat / self.spread(numbers)) ** 2).sum() + ((mean / SAME_CURVE) ** 2).sum())

    def spread(self, numbers: _Numbers) -> np.ndarray:
        """Standard deviations of `numbers.flat` before any photograph is seen."""
        of_camera = np.repeat([SPREAD["falloff"], SPREAD["centre"], SPREAD["curve"]], [3, 2, 3])
        parts = np.full(numbers.stops.size, SPREAD["stops"]), np.tile(of_camera, len(numbers.cameras))
        return np.concatenate([*parts, np.full(numbers.slope.size, SPREAD["slope"])])

    def step(self, now: _Residuals, numbers: _Numbers, held: _Held, deviation: float) -> np.ndarray:
        """As `flat`, a step of Gauss and Newton; the light of points is eliminated."""
        offset, squared = self.squared(numbers)
        a, b, c = numbers.cameras[self.camera][:, FALLOFF].T
        steep = 2 * (a + squared * (2 * b + 3 * squared * c))
        of_camera = numbers.ends[0] + OF_CAMERA * self.camera[:, None] + np.arange(OF_CAMERA)
        of_slope = np.broadcast_to(numbers.ends[1] + np.arange(3), (len(self.photo), 3))
        width, each = len(numbers.flat), np.arange(len(self.photo), dtype=np.int32)
        normal, pull = sparse.csr_matrix((width, width)), np.zeros(width)
        weights, curve = self.weights(now, deviation), curve_terms(now.encoded)
        for channel in range(3):
            weight, light = weights[:, channel], now.light[:, channel]
            entries = [np.ones_like(squared), -squared, -(squared**2), -(squared**3), *(steep * offset.T)]
            entries += [*(term[:, channel] / now.slope[:, channel] for term in curve), *self.aside.T]
            columns = np.concatenate(
                [3 * self.photo[:, None] + channel, of_camera, of_slope + 3 * channel], 1, dtype=np.int32
            )
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
                sparse.csr_matrix((3, numbers.slope.size)),
            ]
        ).tocsr()
        expected = self.spread(numbers) ** -2.0
        expected[: numbers.ends[0]] += (held.stops / (1 + (numbers.stops / HELD_STOPS) ** 2)).ravel()
        expected[numbers.ends[0] : numbers.ends[1]].reshape(-1, OF_CAMERA)[:, CENTRE] += held.centre
        rest = sparse.csr_matrix((numbers.ends[1], numbers.ends[1]))
        before = sparse.diags(expected) + alike.T @ alike / SAME_CURVE**2 + sparse.block_diag([rest, *held.slope])
        return solved(normal + before, pull - before @ numbers.flat, numbers.cameras.size + numbers.slope.size)


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
