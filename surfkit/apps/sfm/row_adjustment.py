"""Bundle adjustment of photographs whose rows were read one after another, and the readout time that fits best.

The row at the share s of the height, -1/2 to 1/2, sees from C + s v t, where C is the position of the middle row, v the
velocity of the camera and t the readout time. Turning is left out: drones for mapping hold their cameras still while
they fly on. Observations are moved to where the middle row would have seen their points, each with its own depth;
adjustment of these gives better points, and so on: each time leaves about a hundredth of the error.

A readout time t that nobody knows is the one that fits best. Where all else is adjusted, the derivative of half the sum
of squares S by t is that of the observations alone (envelope theorem). S is nearly a parabola of t, so two adjustments
tell where that derivative is 0, and its slope how exactly: t has the variance s^2 / S'', with s that of an observation.
At last the motion of each photograph is fitted, near that of the path (Vautherin et al., ISPRS Annals III-3, 2016).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from surfkit.apps.sfm.bundle_adjustment import adjust
from surfkit.apps.sfm.camera_motion import motion_of
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.georeference import centres_of
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.row_motion import RowMotion
from surfkit.apps.sfm.settings import Settings
from surfkit.core.events import Progress, emit

FIRST_MS = 30.0
"""A readout time to begin with where none is known."""
MIN_MS, MAX_MS = 5.0, 200.0
"""An estimate of less is that of a shutter as good as global; no camera takes longer."""
SEARCHING_PHASE, CORRECTING_PHASE = "looking for a rolling shutter", "correcting the rolling shutter"
"""What is done while cameras are adjusted."""
SECANTS = 2
"""Steps to the readout time that fits best."""
PASSES, FINAL_PASSES = 2, 3
"""Adjustments for one readout time, and with motions of each photograph."""
OUTLIER_SIGMAS = 4.0
"""Observations with larger residuals say nothing of the motion of a photograph."""
ACROSS_SHARE = 0.2
"""Along the axis of the camera a motion has this share of its standard deviation: there it looks like a tilt."""


@dataclass(frozen=True)
class Estimate:
    """A readout time by the photographs alone, seconds.

    Attributes:
        time: That fits best.
        sigma: Its standard deviation, if speeds are exact.
        total: The same with errors of the speeds. Where rows of all photographs point the same way along the path,
            only differences of the speeds tell the readout time, and errors of these make it too small.
    """

    time: float
    sigma: float
    total: float


@dataclass(frozen=True)
class _Seen:
    """Observations of a photograph: pixels in the file, whose points they are, and the share of the height."""

    name: str
    camera: int
    rows: np.ndarray
    points: list[int]
    pixels: np.ndarray
    share: np.ndarray


class RowAdjustment:
    """A model, and what it comes to with some readout times."""

    def __init__(self, model: Any, photos: Mapping[str, Photo], settings: Settings) -> None:
        self.photos, self.settings = photos, settings
        self.seen = {number: _observed(model, number) for number in sorted(model.reg_image_ids())}
        self.changes: dict[str, np.ndarray] = {}
        self.times: dict[int, float] = {}
        self.progress = Progress(SEARCHING_PHASE, 0, 1 + SECANTS * PASSES)
        alone = adjust(model, None, photos, settings, math.inf)  # motion may have bent it so far that EXIF fits badly
        self._tell(1)
        self.base = self.near = model if alone is None else alone
        self.motion = motion_of(centres_of(self.base), photos)

    def estimate(self, known: Mapping[int, float | None]) -> dict[int, Estimate | None]:
        """The readout time of each lens by the photographs alone.

        Args:
            known: Milliseconds that are known, by number of the camera.
        """
        times = {number: (FIRST_MS if ms is None else ms) / 1000 for number, ms in known.items()}
        before = dict.fromkeys(known, 0.0)
        found: dict[int, Estimate | None] = dict.fromkeys(known)
        model, slopes = self.base, self._slopes(self.base)
        for _ in range(SECANTS):
            moved = self._adjusted(model, times)
            if moved is None:
                self._tell(self.progress.total)
                return found
            first, model, slopes = slopes, moved, self._slopes(moved)
            for number, (slope, sigma, noise) in slopes.items():
                step = times[number] - before[number]
                bend = (slope - first[number][0]) / step if step else 0.0
                before[number] = times[number]
                if bend > 0:
                    best = times[number] - slope / bend
                    formal = sigma / math.sqrt(bend)
                    found[number] = Estimate(best, formal, math.hypot(formal, best * min(1.0, noise / bend)))
                    if MIN_MS <= abs(1000 * best) <= MAX_MS:
                        times[number] = best
        self.near = model
        return found

    def final(self, times: Mapping[int, float]) -> Any | None:
        """The model with these readout times, seconds, and motions of each photograph near those; None where it does
        not fit."""
        self.progress = Progress(CORRECTING_PHASE, 0, PASSES + FINAL_PASSES)
        model = self._adjusted(self.near, times)
        for _ in range(FINAL_PASSES):
            if model is None:
                self._tell(self.progress.total)
                return None
            self._fit_motions(model)
            model = self._adjusted(model, times, 1)
        return model

    def motions(self, model: Any) -> tuple[dict[str, RowMotion], list[float]]:
        """The motion of each photograph in the final model, and the length of its shift, pixels."""
        found, shifts = {}, []
        for number, seen in self.seen.items():
            image = model.image(number)
            if seen.camera not in self.times or (world := self._motion(seen)) is None or not len(seen.points):
                continue
            pose, camera = image.cam_from_world(), model.cameras[seen.camera]
            local, own = pose.rotation.matrix() @ world, _points(model, seen.points)
            depths = (pose * own)[:, 2]
            good = depths > 0
            if not good.any():
                continue
            size = (camera.width, camera.height)
            found[seen.name] = RowMotion.fitted(local, seen.pixels[good], depths[good], size)
            shifts.append(float(np.linalg.norm(found[seen.name].share[:2])) * camera.mean_focal_length())
        return found, shifts

    def _motion(self, seen: _Seen) -> np.ndarray | None:
        """(3,) motion of a camera during the readout, units of the model; None where its speed is not known."""
        velocity = self.motion.velocities.get(seen.name)
        if velocity is None or seen.camera not in self.times:
            return None
        return velocity.vector * self.times[seen.camera] + self.changes.get(seen.name, 0.0)

    def _adjusted(self, model: Any, times: Mapping[int, float], passes: int = PASSES) -> Any | None:
        """The model adjusted to observations that are corrected with some readout times."""
        self.times = dict(times)
        for _ in range(passes):
            self.motion = motion_of(centres_of(model), self.photos)  # a shutter bends the path too
            shifted = load_engine().Reconstruction(model)
            for number, seen in self.seen.items():
                world = self._motion(seen)
                pixels = seen.pixels if world is None else seen.pixels + _shift(model, number, seen, world)
                spots = shifted.image(number).points2D
                for row, pixel in zip(seen.rows, np.where(np.isfinite(pixels), pixels, seen.pixels), strict=True):
                    spots[row].xy = pixel
            model = adjust(shifted, None, self.photos, self.settings, math.inf)
            if model is None:
                return None
            self._tell(self.progress.done + 1)
        return model

    def _tell(self, done: int) -> None:
        """Say how many adjustments are done: of thousands of photographs, each takes long."""
        self.progress = replace(self.progress, done=done)
        emit(self.progress)

    def _slopes(self, model: Any) -> dict[int, tuple[float, float, float]]:
        """For each lens, the derivative of half the sum of squares by its readout time, the standard deviation of a
        coordinate of its residuals, and what errors of speeds add to the second derivative: of these, poses take up a
        part, but points do not, as each photograph has its own."""
        slopes: dict[int, float] = {}
        noises: dict[int, float] = {}
        squares: dict[int, list[np.ndarray]] = {}
        small = 1e-3
        for number, seen in self.seen.items():
            velocity = self.motion.velocities.get(seen.name)
            left, local = _residuals(model, number, seen)
            squares.setdefault(seen.camera, []).append((left**2).ravel())
            slopes.setdefault(seen.camera, 0.0)
            if velocity is not None:
                slope = _shift(model, number, seen, velocity.vector * small) / small
                slopes[seen.camera] += float(np.nansum(left * slope))
                good = local[:, 2] > 0
                pose, motion = _derivatives(local[good], seen.share[good], model.cameras[seen.camera])
                axes = np.linalg.qr(pose)[0]
                free = motion[:, :2] - axes @ (axes.T @ motion[:, :2])
                noises[seen.camera] = noises.get(seen.camera, 0.0) + velocity.sigma**2 * float((free**2).sum())
        return {
            at: (slope, float(np.sqrt(np.nanmean(np.concatenate(squares[at])))), noises.get(at, 0.0))
            for at, slope in slopes.items()
        }

    def _fit_motions(self, model: Any) -> None:
        """Change the motion of each photograph, together with its pose, to what its residuals say."""
        spread = [np.abs(_residuals(model, number, seen)[0]).ravel() for number, seen in self.seen.items()]
        sigma = max(float(np.nanmedian(np.concatenate(spread))) * 1.4826, 1e-3)
        for number, seen in self.seen.items():
            if (world := self._motion(seen)) is None or not np.linalg.norm(world):
                continue
            left, local = _residuals(model, number, seen)
            good = np.isfinite(left).all(1) & (np.abs(left).max(1) < OUTLIER_SIGMAS * sigma) & (local[:, 2] > 0)
            turn = model.image(number).cam_from_world().rotation.matrix()
            velocity = self.motion.velocities[seen.name]
            trust = np.array([1, 1, ACROSS_SHARE]) * velocity.sigma * abs(self.times[seen.camera])
            before = turn @ self.changes.get(seen.name, np.zeros(3))
            change = _fitted(
                left[good], local[good], seen.share[good], before, trust, sigma, model.cameras[seen.camera]
            )
            self.changes[seen.name] = turn.T @ (before + change)


def _fitted(
    left: np.ndarray,
    local: np.ndarray,
    share: np.ndarray,
    before: np.ndarray,
    trust: np.ndarray,
    sigma: float,
    camera: Any,
) -> np.ndarray:
    """(3,) change of the motion of a photograph, by least squares with its pose.

    Args:
        left: (K, 2) observations less where the model puts them, pixels.
        local: (K, 3) points in the camera's frame.
        share: (K,) of the height.
        before: (3,) by how much the motion differs from that of the path already, in the camera's frame.
        trust: (3,) standard deviation of that difference.
        sigma: That of an observation.
        camera: pycolmap's; its distortion is left out here.
    """
    columns = np.concatenate(_derivatives(local, share, camera), 1) / sigma
    prior = np.zeros(9)
    prior[6:] = 1 / np.maximum(trust, 1e-12)
    scale = np.linalg.norm(columns, axis=0) + prior
    matrix = np.vstack([columns, np.diag(prior)]) / scale
    right = np.concatenate([left.ravel() / sigma, np.zeros(6), -before * prior[6:]])
    return (np.linalg.lstsq(matrix, right, rcond=1e-9)[0] / scale)[6:]


def _derivatives(local: np.ndarray, share: np.ndarray, camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """(2 K, 6) derivatives of pixels by a small turn and a move of a camera, and (2 K, 3) by its motion during the
    readout; arguments as for `_fitted`."""
    x, y, z = local.T
    zero = np.zeros_like(z)
    by_place = np.stack([np.stack([1 / z, zero, -x / z**2], 1), np.stack([zero, 1 / z, -y / z**2], 1)], 1)
    by_place *= camera.mean_focal_length()
    cross = np.stack(
        [np.stack([zero, z, -y], 1), np.stack([-z, zero, x], 1), np.stack([y, -x, zero], 1)], 1
    )  # of a small turn w: w x p = cross @ w
    pose = np.concatenate([by_place @ cross, by_place], 2).reshape(-1, 6)
    return pose, (-share[:, None, None] * by_place).reshape(-1, 3)


def _observed(model: Any, number: int) -> _Seen:
    image = model.image(number)
    rows = np.array(image.get_observation_point2D_idxs(), int)
    spots = image.get_observation_points2D()
    pixels = np.array([spot.xy for spot in spots], np.float64).reshape(-1, 2)
    share = pixels[:, 1] / model.cameras[image.camera_id].height - 0.5
    return _Seen(image.name, image.camera_id, rows, [spot.point3D_id for spot in spots], pixels, share)


def _points(model: Any, numbers: list[int]) -> np.ndarray:
    """(K, 3) places of points."""
    points = model.points3D  # made anew each time that it is asked for
    return np.array([points[number].xyz for number in numbers], np.float64).reshape(-1, 3)


def _residuals(model: Any, number: int, seen: _Seen) -> tuple[np.ndarray, np.ndarray]:
    """(K, 2) observations of the model less where it puts them, and (K, 3) their points in the camera's frame."""
    image = model.image(number)
    local = np.asarray(image.cam_from_world() * _points(model, seen.points)).reshape(-1, 3)
    spots = image.points2D
    there = np.array([spots[int(row)].xy for row in seen.rows], np.float64).reshape(-1, 2)
    return there - np.asarray(model.cameras[seen.camera].img_from_cam(local)).reshape(-1, 2), local


def _shift(model: Any, number: int, seen: _Seen, world: np.ndarray) -> np.ndarray:
    """(K, 2) from where their own rows see points to where the middle row does, with (3,) a motion in the world."""
    pose, camera = model.image(number).cam_from_world(), model.cameras[seen.camera]
    local = np.asarray(pose * _points(model, seen.points)).reshape(-1, 3)
    own = local - seen.share[:, None] * (pose.rotation.matrix() @ world)
    return np.asarray(camera.img_from_cam(local)).reshape(-1, 2) - np.asarray(camera.img_from_cam(own)).reshape(-1, 2)
