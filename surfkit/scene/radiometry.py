"""How photographs were exposed, and what their light is multiplied by so that all show a place alike.

Linear light of a photograph is that of the surface, times its exposure and white balance, times the vignetting of its
camera (Goldman, Vignette and Exposure Calibration and Compensation, PAMI 2010). All three are found together by robust
least squares of logarithms, from the places that several photographs show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components

from surfkit.scene.camera import Camera
from surfkit.scene.normal_equations import solved
from surfkit.scene.srgb import from_linear, linear

MIN_SHARED_PLACES = 30
"""Places that two photographs must both show to be tied to one another."""
MAX_SHARED_PLACES = 300_000
"""Places that the light of photographs is found from, where there are more."""
MIN_USABLE_COLOR, MAX_USABLE_COLOR = 8, 247
"""Colours beyond these tell nothing of the light."""
VIGNETTING_TERMS = 2
"""Even powers of the distance from the principal point, from the second on, in the logarithm of the vignetting."""
SAME_FOCAL = 0.05
"""Photographs whose focal lengths, in widths of the picture, differ by about less than this share are of one camera."""
PRIOR_PLACES, PRIOR_SHARE, PRIOR_SIGMA = 2.0, 0.003, 0.5
"""How gains are held near 1: as if so many places showed it, and so large a share of those that the photograph shows.
The latter less and less beyond `PRIOR_SIGMA`, of the logarithm: some photographs were exposed quite otherwise. Without
it, errors of one sign, as a slope of brightness in all photographs gives, would add up along a strip."""
PRIOR_VIGNETTING = 3.0
"""How each factor of the vignetting is held near 0: as if so many places at the distance 1 showed it."""
REWEIGHTING_ROUNDS, CAUCHY_MADS, MIN_SCALE = 8, 2.385, 0.01
"""Rounds of weighing observations anew, and from how many standard deviations on they count little; these are no less
than `MIN_SCALE`, of the logarithm."""
MAX_GAIN = 4.0
"""No gain is larger, or smaller than the inverse: two stops."""
KNEE = float(linear(np.array(0.8)))
"""Light up to here is multiplied by the gain; brighter one comes to white where it is white in the photograph."""
MEAN_SAMPLES = 16
"""Samples along each side of a picture for the mean of a curve over it."""


@dataclass(frozen=True)
class Radiometry:
    """What the linear light of photographs is multiplied by, so that all of them show a place alike.

    Attributes:
        gain: (V, 3) factors for red, green and blue: exposure and white balance. Their geometric mean over all
            photographs that are tied to one another is 1: the whole is as bright as the photographs.
        vignetting: (V, T, 3) factors of `vignetting_terms` in the logarithm of what the light is multiplied by besides.
    """

    gain: np.ndarray
    vignetting: np.ndarray

    @classmethod
    def unchanged(cls, views: int) -> Radiometry:
        """That of photographs that stay as they are."""
        return cls(np.ones((views, 3)), np.zeros((views, VIGNETTING_TERMS, 3)))

    def gains_at(self, number: int, camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(n, 3) what the light of a photograph is multiplied by at places in pixels; of the camera at any size."""
        return self.at_terms(number, vignetting_terms(camera, x, y))

    def at_terms(self, number: int | np.ndarray, terms: np.ndarray) -> np.ndarray:
        """(..., 3) the same of photographs, one or one for each place, by (..., T) `vignetting_terms` of places."""
        found = self.gain[number] * np.exp(np.einsum("...t,...tc->...c", terms, self.vignetting[number]))
        return found.clip(1 / MAX_GAIN, MAX_GAIN)

    def corners(self, cameras: Sequence[Camera]) -> np.ndarray:
        """(V,) how bright the corners of photographs are, as a share of the middle."""
        found = []
        for camera, factors in zip(cameras, self.vignetting, strict=True):
            middle, corner = vignetting_terms(camera, np.array([camera.cx, 0.0]), np.array([camera.cy, 0.0]))
            found.append(np.exp((middle - corner) @ factors).mean())
        return np.array(found)


@dataclass(frozen=True)
class SharedPlaces:
    """Places as photographs show them: N observations of them.

    Attributes:
        place: (N,) number of the place, rising.
        photo: (N,) number of the photograph that shows it.
        color: (N, 3) uint8 its sRGB colour there.
        terms: (N, T) `vignetting_terms` where it lies in the photograph.
    """

    place: np.ndarray
    photo: np.ndarray
    color: np.ndarray
    terms: np.ndarray


def vignetting_terms(camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, T) even powers of the distance of places, in pixels, from the principal point, less their means over the
    picture; half the diagonal is 1."""
    across, down = np.meshgrid(*((np.arange(MEAN_SAMPLES) + 0.5) / MEAN_SAMPLES for _ in range(2)))
    middle = _powers(camera, across.ravel() * camera.width, down.ravel() * camera.height).mean(0)
    return _powers(camera, x, y) - middle


def camera_numbers(cameras: Sequence[Camera]) -> np.ndarray:
    """(V,) number of the camera that took each photograph, as its focal length and shape tell, at any size."""
    shape = [(c.fx / c.width, c.width / c.height) for c in cameras]
    return np.unique(np.rint(np.log(shape) / SAME_FOCAL), axis=0, return_inverse=True)[1].reshape(-1)


def estimate(shared: SharedPlaces, cameras: np.ndarray) -> Radiometry:
    """The light of photographs, from the places that they share.

    Photographs that are not tied to others by `MIN_SHARED_PLACES` stay near 1, and without any place they are 1.

    Args:
        shared: See there.
        cameras: (V,) number of the camera of each photograph: those of one have the same vignetting.
    """
    views = len(cameras)
    count = VIGNETTING_TERMS * (int(cameras.max()) + 1)
    place, photo, light, terms = _usable(shared)
    if not len(place):
        return Radiometry.unchanged(views)
    rows = np.arange(len(place))
    # what each observation adds to: the logarithm of the gain of its photograph, and the terms of its camera
    columns = views + VIGNETTING_TERMS * cameras[photo][:, None] + np.arange(VIGNETTING_TERMS)
    design = csr_matrix(
        (
            np.concatenate([np.ones(len(rows)), terms.ravel()]),
            (np.concatenate([rows, rows.repeat(VIGNETTING_TERMS)]), np.concatenate([photo, columns.ravel()])),
        ),
        (len(rows), views + count),
    )
    of_place = csr_matrix((np.ones(len(rows)), (place, rows)), (place[-1] + 1, len(rows)))
    found, weight = np.zeros((views + count, 3)), np.ones(len(rows))
    for _ in range(REWEIGHTING_ROUNDS):
        # the unknown light of each place is the mean of what photographs show; it is eliminated
        weighed = diags(weight) @ design
        total, sums = np.asarray(of_place @ weight), of_place @ weighed
        matrix = design.T @ weighed - sums.T @ diags(1 / total) @ sums
        mean = (of_place @ (weight[:, None] * light)) / total[:, None]
        side = -(weighed.T @ (light - mean[place]))
        large = (found[:views] ** 2).mean(1) / PRIOR_SIGMA**2
        held = PRIOR_PLACES + PRIOR_SHARE * np.bincount(photo, weight, views) / (1 + large)
        held = diags(np.concatenate([held, np.full(count, PRIOR_VIGNETTING)]))
        found = solved(matrix + held, side, count).reshape(-1, 3)
        shown = light + design @ found
        mean = (of_place @ (weight[:, None] * shown)) / total[:, None]
        away = np.sqrt(((shown - mean[place]) ** 2).mean(1))
        scale = max(1.4826 * float(np.median(away)), MIN_SCALE)
        weight = 1 / (1 + (away / (CAUCHY_MADS * scale)) ** 2)
    gain = np.exp(found[:views]).clip(1 / MAX_GAIN, MAX_GAIN)
    for group in _tied(place, photo, views):
        gain[group] /= np.exp(np.log(gain[group]).mean(0))
    return Radiometry(gain.clip(1 / MAX_GAIN, MAX_GAIN), found[views:].reshape(-1, VIGNETTING_TERMS, 3)[cameras])


def exposed(color: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """(..., 3) sRGB colours in [0, 1] of a photograph whose light is multiplied by a gain: in [0, 1] too.

    That is so for light up to `KNEE`, before or after. From there a monotone curve of one rational quadratic (Gregory
    and Delbourgo, Piecewise Rational Quadratic Interpolation to Monotonic Data, IMA Journal of Numerical Analysis,
    1982) goes to white, where it has the slope 1: as many colours are nearly white as in the photograph.

    Args:
        color: (..., 3).
        gain: (..., 3), see `Radiometry.gains_at`.
    """
    light = linear(color)
    start = KNEE / np.maximum(gain, 1)
    mean = (1 - gain * start) / (1 - start)
    t = ((light - start) / (1 - start)).clip(0, 1)
    beyond = (1 - gain * start) * (mean * t**2 + gain * t * (1 - t)) / (mean + (gain + 1 - 2 * mean) * t * (1 - t))
    return from_linear(np.where(light <= start, gain * light, gain * start + beyond))


def _powers(camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, T) even powers of the distance from the principal point."""
    square = ((x - camera.cx) ** 2 + (y - camera.cy) ** 2) / ((camera.width**2 + camera.height**2) / 4)
    return np.stack([square ** (i + 1) for i in range(VIGNETTING_TERMS)], axis=-1)


def _usable(shared: SharedPlaces) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Place, numbered anew, photograph, (N, 3) logarithms of light, and terms of the observations that count: neither
    black nor white, of places that two photographs and more show."""
    rows = np.flatnonzero(((shared.color > MIN_USABLE_COLOR) & (shared.color < MAX_USABLE_COLOR)).all(1))
    rows = rows[np.bincount(shared.place[rows], minlength=1)[shared.place[rows]] > 1]
    place = np.unique(shared.place[rows], return_inverse=True)[1].reshape(-1)
    light = np.log(linear(shared.color[rows] / 255.0))
    return place, shared.photo[rows], light, shared.terms[rows].astype(np.float64)


def _tied(place: np.ndarray, photo: np.ndarray, views: int) -> list[np.ndarray]:
    """Numbers of the photographs of each group that enough places tie to one another, of two photographs and more."""
    shows = coo_matrix((np.ones(len(place)), (photo, place))).tocsr()
    together = (shows @ shows.T).tocoo()
    strong = (together.data >= MIN_SHARED_PLACES) & (together.row != together.col)
    pairs = coo_matrix((np.ones(strong.sum()), (together.row[strong], together.col[strong])), (views, views))
    label = connected_components(pairs, directed=False)[1]
    size = np.bincount(label)
    return [np.flatnonzero(label == group) for group in np.flatnonzero(size > 1)]
