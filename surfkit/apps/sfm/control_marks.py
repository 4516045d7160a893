"""Marks of control points in photographs: where their rays meet, which of them is wrong, where others would be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from surfkit.apps.sfm.control_list import MIN_CONTROL_POINTS, MIN_POINT_PHOTOS, GroundControlPoint
from surfkit.core.codec import write_text

MARK_OUTLIER_SIGMAS = 4.0
"""A mark is wrong that is so many standard deviations from where the others of its point put it."""
MAX_ROUND_TRIP_PX = 0.1
"""A place whose pixel leads back to another ray, by more than this, is outside of what a lens model describes."""
STEP_SHARE = 1e-5
"""Of the distance of a point: steps of the differences by which its residuals change."""
RESIZED_SHARE, MIN_RESIZED = 0.2, 1.15
"""Marks are of photographs of another size where, at that size, residuals are at most this share of those as given,
and the sizes differ by this factor or more: a wrong mark here and there does not fit better at any size."""
RESIZED_RANGE, RESIZED_STEPS = 16.0, 161
"""Factors of size that are tried: from one over this to this, in so many steps."""
MIN_RESIZED_ERROR = 0.005
"""Marks that are off by less than this share of the width of the photographs are of their size."""
MIN_REDUNDANCY = 1e-3
"""A direction in which the other marks say less of a mark is not looked at."""
Images = Mapping[str, Any]
"""pycolmap.Image of each placed photograph, by its name."""


@dataclass(frozen=True)
class WrongMark:
    """A mark that contradicts the others of its point.

    Attributes:
        point: Name of the point.
        photograph: Where it is marked.
        pixels: How far it is from where the others put it; with two marks, by which neither is told to be wrong, how
            far each is from where their rays come nearest to each other; None where that is behind the photograph.
        certain: Whether the others agree without it, so that it is this one; not so with two marks.
    """

    point: str
    photograph: str
    pixels: float | None
    certain: bool


def images_of(model: Any) -> Images:
    """The placed photographs of a pycolmap.Reconstruction."""
    return {model.image(number).name: model.image(number) for number in model.reg_image_ids()}


def projected(image: Any, xyz: np.ndarray) -> np.ndarray | None:
    """(2,) the pixel of a place (3,) in a photograph; None behind it, or where its lens model does not reach."""
    ray = np.array(image.cam_from_world() * np.asarray(xyz, np.float64))
    if not ray[2] > 0:
        return None
    pixel = np.asarray(image.camera.img_from_cam(ray[None])).reshape(-1)[:2]
    back = np.asarray(image.camera.cam_from_img(pixel[None])).reshape(-1)[:2]
    away = np.abs(back - ray[:2] / ray[2]).max() * image.camera.mean_focal_length()
    return pixel if np.isfinite(pixel).all() and away <= MAX_ROUND_TRIP_PX else None


def mark_residuals(images: Images, marks: Mapping[str, tuple[float, float]], xyz: np.ndarray) -> dict[str, np.ndarray]:
    """(2,) pixels of each mark in a placed photograph less that of the place (3,), by name of the photograph."""
    found = {}
    for name, pixel in marks.items():
        if name in images and (there := projected(images[name], xyz)) is not None:
            found[name] = np.asarray(pixel) - there
    return found


def without_wrong_marks(
    images: Images, points: Sequence[GroundControlPoint], sigma_px: float
) -> tuple[list[GroundControlPoint], list[WrongMark]]:
    """Points without the marks that contradict the others of their point, and these marks.

    Surveyed places have no say. As long as one contradicts, the mark goes without which the sum of squares falls most
    (data snooping; Baarda, 1968). Two marks that contradict each other both go, and all whose rays meet behind a
    photograph, whichever is left out.

    Args:
        images: Of the model.
        points: With marks.
        sigma_px: Standard deviation of a coordinate of a mark, with the error of cameras, pixels.
    """
    limit = (MARK_OUTLIER_SIGMAS * sigma_px) ** 2
    kept, wrong = [], []
    for point in points:
        marks = {name: pixel for name, pixel in point.marks.items() if name in images}
        gone: list[str] = []
        while len(marks) > MIN_POINT_PHOTOS:
            drops = _drops(images, marks) or _misled(images, marks)
            name = max(drops, key=lambda one: drops[one], default="")
            if not drops or drops[name] <= limit:
                break
            gone.append(name)
            del marks[name]
        xyz = triangulate(images, marks)
        left = {} if xyz is None else mark_residuals(images, point.marks, xyz)
        meets = len(marks) < MIN_POINT_PHOTOS or marks.keys() <= left.keys()
        certain = meets and not (
            len(marks) == MIN_POINT_PHOTOS
            and sum(float(left[name] @ left[name]) for name in left if name in marks) > limit
        )
        gone += [] if certain else list(marks)
        off = {name: float(np.linalg.norm(rest)) for name, rest in left.items()}
        wrong += [WrongMark(point.name, name, off.get(name), certain) for name in gone]
        kept.append(replace(point, marks={name: at for name, at in point.marks.items() if name not in gone}))
    return kept, wrong


def size_ratio(images: Images, points: Sequence[GroundControlPoint]) -> float | None:
    """How many times as large as these photographs those are in which the points were marked; None where the marks fit
    these, or fit no size: a list is often made on photographs that were made smaller.

    Args:
        images: Of the model.
        points: With marks.
    """
    as_given, width = _error_at(images, points, 1.0), max(image.camera.width for image in images.values())
    if not MIN_RESIZED_ERROR * width < as_given < np.inf:
        return None
    tried = np.geomspace(1 / RESIZED_RANGE, RESIZED_RANGE, RESIZED_STEPS)
    errors = [_error_at(images, points, float(ratio)) for ratio in tried]
    best = int(np.argmin(errors))
    if errors[best] > RESIZED_SHARE * as_given or abs(np.log(tried[best])) < np.log(MIN_RESIZED):
        return None
    span = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
    found = minimize_scalar(lambda ratio: _error_at(images, points, ratio), bounds=span, method="bounded")
    return float(found.x)


def _error_at(images: Images, points: Sequence[GroundControlPoint], ratio: float) -> float:
    """Median over points of how far their marks are from where their rays meet (RMS), were they of photographs of
    `ratio` times the size; pixels of the marks, infinite where too few points tell."""
    errors = []
    for point in points:
        marks = {name: (x / ratio, y / ratio) for name, (x, y) in point.marks.items() if name in images}
        if (xyz := triangulate(images, marks)) is not None:
            left = list(mark_residuals(images, marks, xyz).values())
            errors.append(ratio * float(np.sqrt(np.square(left).sum(1).mean())) if len(left) == len(marks) else np.inf)
    return float(np.median(errors)) if len(errors) >= MIN_CONTROL_POINTS else np.inf


def _drops(images: Images, marks: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """By how much the sum of squared residuals of three or more marks falls without each of them, pixels squared.

    With residuals v and their cofactors Q = 1 - J (J' J)^-1 J', of which v_i and Q_i are those of one mark, that is
    v_i' Q_i^-1 v_i. Nothing where their rays do not meet.
    """
    xyz = triangulate(images, marks)
    left = {} if xyz is None else mark_residuals(images, marks, xyz)
    if xyz is None or len(left) < len(marks):
        return {}
    slope = _slope(images, marks, xyz)
    if slope is None:
        return {}
    moved, *_ = np.linalg.lstsq(slope, np.concatenate(list(left.values())), rcond=None)
    rest = np.concatenate(list(left.values())) - slope @ moved
    spare = np.eye(len(slope)) - slope @ np.linalg.pinv(slope)
    parts = {name: slice(2 * at, 2 * at + 2) for at, name in enumerate(marks)}
    return {
        name: float(rest[part] @ np.linalg.pinv(spare[part, part], rcond=MIN_REDUNDANCY) @ rest[part])
        for name, part in parts.items()
    }


def _misled(images: Images, marks: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Of marks whose rays meet behind a photograph, those without which the others meet in front of theirs: infinite
    for the one that leaves the least residuals."""
    squares = {}
    for name in marks:
        others = {other: pixel for other, pixel in marks.items() if other != name}
        xyz = triangulate(images, others)
        left = {} if xyz is None else mark_residuals(images, others, xyz)
        if others.keys() <= left.keys():
            squares[name] = sum(float(rest @ rest) for rest in left.values())
    return {min(squares, key=lambda name: squares[name]): np.inf} if squares else {}


def _slope(images: Images, marks: Mapping[str, tuple[float, float]], xyz: np.ndarray) -> np.ndarray | None:
    """(2 N, 3) by how much the residuals of N marks change as a place (3,) moves, pixels; None where one does not see
    it."""
    step = STEP_SHARE * min(float(np.linalg.norm(xyz - np.array(images[name].projection_center()))) for name in marks)
    slopes = []
    for name in marks:
        pixels = [projected(images[name], xyz + step * way) for way in (*np.eye(3), *-np.eye(3))]
        ways = [pixel for pixel in pixels if pixel is not None]
        if len(ways) < len(pixels):
            return None
        slopes.append(np.stack([(ways[at + 3] - ways[at]) / (2 * step) for at in range(3)], 1))
    return np.concatenate(slopes)


def located(
    images: Images, marks: Mapping[str, tuple[float, float]], sigma_px: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """(3,) the place of a point, and its (3, 3) covariance for marks of a standard deviation in pixels; None where
    their rays do not meet."""
    marks = {name: pixel for name, pixel in marks.items() if name in images}
    xyz = triangulate(images, marks)
    slope = None if xyz is None else _slope(images, marks, xyz)
    return None if xyz is None or slope is None else (xyz, sigma_px**2 * np.linalg.pinv(slope.T @ slope))


def triangulate(images: Mapping[str, Any], marks: Mapping[str, tuple[float, float]]) -> np.ndarray | None:
    """(3,) the point nearest to the rays through its marks, each weighted by how near its camera is; None of fewer than
    two.

    Args:
        images: pycolmap.Image of each placed photograph, by its name.
        marks: Pixels, by name of the photograph.
    """
    rays = []
    for name, pixel in marks.items():
        if (image := images.get(name)) is None:
            continue
        direction = np.append(np.asarray(image.camera.cam_from_img(np.array([pixel], np.float64))).ravel()[:2], 1.0)
        if not np.isfinite(direction).all():
            continue  # outside of what its lens model describes
        direction = np.array(image.cam_from_world().rotation.matrix()).T @ direction
        rays.append((np.array(image.projection_center()), direction / np.linalg.norm(direction)))
    if len(rays) < MIN_POINT_PHOTOS:
        return None
    point, weights = np.zeros(3), np.ones(len(rays))
    for _ in range(3):
        across = [weight * (np.eye(3) - np.outer(d, d)) for weight, (_, d) in zip(weights, rays, strict=True)]
        total = np.sum(across, axis=0)
        if np.linalg.cond(total) > 1e8:
            return None  # all rays are one
        point = np.linalg.solve(total, np.sum([m @ c for m, (c, _) in zip(across, rays, strict=True)], axis=0))
        weights = np.array([1 / max(float(np.linalg.norm(point - c)), 1e-9) ** 2 for c, _ in rays])
        weights /= weights.max()
    return point


def propose(
    path: Path, first: str, points: Sequence[GroundControlPoint], places: Mapping[str, np.ndarray], images: Images
) -> int:
    """Write a list of the marks that points would have in photographs that show them without one; how many there are.

    What hides a point is not looked at.

    Args:
        path: Of the list, in the format of the one that was given.
        first: Its first line, the coordinate reference system.
        points: With the marks that they have.
        places: (3,) in the model, by name of the point.
        images: Of the model.
    """
    rows = list(_proposals(points, places, images))
    note = "# where points would be in photographs without a mark, if nothing hides them: correct, or delete"
    write_text(path, "\n".join([first, note, *rows]) + "\n")
    return len(rows)


def _proposals(points: Sequence[GroundControlPoint], places: Mapping[str, np.ndarray], images: Images) -> Iterator[str]:
    for point in points:
        said = "" if " " in point.name else f" {point.name}"  # one without a name is known by its place
        where = " ".join(repr(value) for value in point.xyz)
        for name, image in sorted(images.items()):
            if point.name not in places or name in point.marks or len(name.split()) != 1:
                continue  # names in a list have no spaces
            pixel = projected(image, places[point.name])
            if pixel is not None and (pixel >= 0).all() and (pixel <= (image.camera.width, image.camera.height)).all():
                yield f"{where} {pixel[0]:.2f} {pixel[1]:.2f} {name}{said}"
