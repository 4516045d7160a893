"""Ground control points, as OpenDroneMap lists them (gcp_list.txt): places on the map and where photographs show them.

The similarity to the map is that of the points, triangulated in the model; points held back check it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.sfm.georeference import (
    MAX_LINE_SPREAD_RATIO,
    MAX_TURN_ERROR,
    NEAR_M,
    MapProjection,
    NoSimilarity,
    chart_about,
    chart_of,
    to_chart,
)
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.similarity import MIN_AGREEING_POSITIONS, PARAMETERS, fit_robustly, umeyama
from surfkit.apps.sfm.survey_plausibility import MAX_ALTITUDE_ERROR_M, MAX_POSITION_ERROR_M, MIN_LAND_M, Handedness
from surfkit.core.check import BadInput, few
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.crs_names import system_of
from surfkit.io.datasets.topocentric import Similarity

MIN_CONTROL_POINTS, MIN_POINT_PHOTOS = 3, 2
"""Control points that determine a similarity; photographs that determine where a point is."""


@dataclass(frozen=True)
class GroundControlPoint:
    """A place on the map that photographs show.

    Attributes:
        name: As the list has it, or its line number.
        xyz: (3,) in the coordinates of the list.
        marks: By name of the photograph, the pixel: x to the right and y down from the corner of the file as stored.
    """

    name: str
    xyz: tuple[float, float, float]
    marks: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class GroundControl:
    """Ground control points on a map.

    Attributes:
        points: Of the list.
        chart: The map.
        onto: (P, 3) their places less the offset.
    """

    points: Sequence[GroundControlPoint]
    chart: MapProjection
    onto: np.ndarray


@dataclass(frozen=True)
class ControlResiduals:
    """Control points of a model on the map.

    Attributes:
        chart: The map.
        similarity: From the model to the map less the offset.
        residuals: By name, (3,) the place on the list less the one in the model, metres.
        control: Names of the points that determined it.
        checkpoints: Names of those held back.
        wrong: Names of those that contradict the others.
        unseen: Names of those that too few placed photographs show.
        handed: Whether they are told from their mirror image: they are not all in a plane.
    """

    chart: MapProjection
    similarity: Similarity
    residuals: Mapping[str, tuple[float, float, float]]
    control: tuple[str, ...]
    checkpoints: tuple[str, ...]
    wrong: tuple[str, ...]
    unseen: tuple[str, ...]
    handed: bool

    def facts(self) -> dict[str, Any]:
        """For the report."""
        return {
            "crs": self.chart.crs,
            "offset": list(self.chart.offset),
            "control_rms_m": self.rms(self.control),
            "checkpoints_rms_m": self.rms(self.checkpoints) if self.checkpoints else None,
            "residuals_m": {name: [round(value, 3) for value in row] for name, row in self.residuals.items()},
            "control": list(self.control),
            "checkpoints": list(self.checkpoints),
            "left_out": list(self.wrong),
            "in_too_few_photographs": list(self.unseen),
        }

    def rms(self, names: Sequence[str]) -> dict[str, float]:
        """Root mean square of the residuals of some points, by axis."""
        rows = np.array([self.residuals[name] for name in names])
        return dict(zip("enu", np.sqrt((rows**2).mean(0)).round(3).tolist(), strict=True))


def read_list(path: Path) -> tuple[str, list[GroundControlPoint]]:
    """The coordinate reference system of a list, and its points in their order.

    Raises:
        BadInput: The file cannot be read, or a line is not `x y z pixel_x pixel_y photograph [name]`.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise BadInput(f"--gcp {path}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"--gcp {path}: cannot be read as text; write it as OpenDroneMap's gcp_list.txt") from error
    rows = [(at, line.strip()) for at, line in enumerate(lines, 1) if line.strip() and not line.strip().startswith("#")]
    if not rows:
        raise BadInput(f"--gcp {path}: empty; its first line is a coordinate reference system, such as EPSG:32633")
    found: dict[str, GroundControlPoint] = {}
    for at, line in rows[1:]:
        words = line.split()
        try:
            x, y, z, across, down = (float(word) for word in words[:5])
            photo = words[5]
        except (ValueError, IndexError) as error:
            wanted = "x y z pixel_x pixel_y photograph [name]"
            raise BadInput(f"--gcp {path}: line {at} is {line[:60]!r}, not {wanted}") from error
        if not np.isfinite([x, y, z, across, down]).all():
            raise BadInput(f"--gcp {path}: line {at} has a number that is not finite")
        name = (
            words[6] if len(words) > 6 else next((p.name for p in found.values() if p.xyz == (x, y, z)), f"line {at}")
        )
        point = found.get(name, GroundControlPoint(name, (x, y, z), {}))
        if point.xyz != (x, y, z):
            raise BadInput(
                f"--gcp {path}: line {at} puts {name!r} elsewhere than a line before; one place for each name"
            )
        found[name] = replace(point, marks={**point.marks, photo: (across, down)})
    return rows[0][1], list(found.values())


def read_ground(path: Path, wanted: str, sizes: Mapping[str, tuple[int, int]], held_back: int = 0) -> GroundControl:
    """The points of a list on their map.

    Args:
        path: The list.
        wanted: `--crs`, which only coordinates in degrees leave open.
        sizes: Width and height of each photograph that can be used, as stored, by its name.
        held_back: How many points are to be checkpoints.

    Raises:
        BadInput: The list cannot be used; says where.
    """
    crs, listed = read_list(path)
    points = _marked(path, listed, sizes)
    enough = sum(len(point.marks) >= MIN_POINT_PHOTOS for point in points)
    if enough < MIN_CONTROL_POINTS + held_back:
        also = f" besides {held_back} --checkpoints" if held_back else ""
        raise BadInput(
            f"--gcp {path}: {enough} of its {len(points)} points are marked in {MIN_POINT_PHOTOS} or more "
            f"photographs of "
            f"the folder; {MIN_CONTROL_POINTS} are needed{also}"
        )
    xyz = np.array([point.xyz for point in points], np.float64)
    try:
        system = system_of(crs)
    except BadInput as error:
        raise BadInput(f"--gcp {path}: line 1: {error}") from error
    if system.degrees:
        if wrong := [point.name for point, (x, y, _) in zip(points, xyz, strict=True) if abs(x) > 180 or abs(y) > 90]:
            raise BadInput(
                f"--gcp {path}: {few(wrong)} is not in degrees, as line 1, {crs!r}, says; x is the longitude, y the "
                "latitude, or line 1 names another system, such as EPSG:32633"
            )
        positions = system.positions(xyz)
        chart = chart_of(positions, wanted)
        onto = to_chart(chart, positions)
        if not np.isfinite(onto).all():
            raise BadInput(f"--gcp {path}: some points are where {chart.crs} does not reach; x is the longitude")
        return GroundControl(points, chart, onto)
    crs = system.crs
    if wanted not in ("auto", crs):
        raise BadInput(f"--crs {wanted}: the list of --gcp is in {crs}, and the scene will be; leave --crs out")
    try:
        chart = chart_about(crs, np.median(xyz, axis=0))
    except BadInput as error:
        raise BadInput(f"--gcp {path}: {error} (line 1 names the system; x is east and y north in it)") from error
    return GroundControl(points, chart, xyz - chart.offset)


def _marked(
    path: Path, points: Sequence[GroundControlPoint], sizes: Mapping[str, tuple[int, int]]
) -> Sequence[GroundControlPoint]:
    """The points of a list with the full names of the photographs that show them, and without unknown ones."""
    folders: dict[str, list[str]] = {}
    for name in sizes:
        folders.setdefault(name.rpartition("/")[2], []).append(name)
    unknown: dict[str, None] = {}
    found = []
    for point in points:
        marks = {}
        for said, pixel in point.marks.items():
            names = [said] if said in sizes else folders.get(said, [])
            if not names:
                unknown[said] = None
                continue
            if len(names) > 1:
                raise BadInput(f"--gcp {path}: {said!r} may be {few(names)}; write the folder too")
            if not all(0 <= at <= size for at, size in zip(pixel, sizes[names[0]], strict=True)):
                width, height = sizes[names[0]]
                raise BadInput(
                    f"--gcp {path}: {point.name!r} is marked at {pixel[0]:g} {pixel[1]:g} in {said!r}, outside of its "
                    f"{width} x {height} pixels; they are counted from the upper left of the file as it is stored"
                )
            marks[names[0]] = pixel
        found.append(replace(point, marks=marks))
    if not any(point.marks for point in found):
        shown = f": {few(sorted(unknown))}" if unknown else ", as it has no points"
        raise BadInput(f"--gcp {path}: none of its photographs is in the folder{shown}; name those there")
    if unknown:
        emit(
            Warned(
                f"--gcp {path}: {len(unknown)} of its photographs are not in the folder, or cannot be used; their "
                f"marks are left out: {few(list(unknown))}"
            )
        )
    return found


def place_by_points(model: Any, ground: GroundControl, held_back: int) -> ControlResiduals | NoSimilarity:
    """The similarity that brings control points to their places.

    Args:
        model: pycolmap.Reconstruction.
        ground: The points.
        held_back: How many are checkpoints, spread over the list.
    """
    points, chart, onto = ground.points, ground.chart, ground.onto
    images = {model.image(number).name: model.image(number) for number in model.reg_image_ids()}
    found = [triangulate(images, point.marks) for point in points]
    placed = {at: xyz for at, xyz in enumerate(found) if xyz is not None}
    seen = list(placed)
    unseen = tuple(point.name for at, point in enumerate(points) if at not in set(seen))
    spread = np.linspace(0, len(seen) - 1, held_back + 2).round().astype(int)[1:-1].tolist() if held_back else []
    back = {seen[at] for at in spread} if len(seen) >= MIN_CONTROL_POINTS + held_back else None
    if back is None:
        also = f" besides {held_back} checkpoints" if held_back else ""
        return NoSimilarity(
            f"{len(seen)} of {len(points)} ground control points are in {MIN_POINT_PHOTOS} placed photographs or more, "
            f"{MIN_CONTROL_POINTS} are needed{also}"
        )
    control = [at for at in seen if at not in back]
    xyz = np.stack([placed[at] for at in control])
    fit = (
        fit_robustly(xyz, onto[control], least=NEAR_M / 2 / chart.metres)
        if len(control) > MIN_AGREEING_POSITIONS
        else None
    )
    inside = np.ones(len(control), bool) if fit is None else fit.inside
    given = umeyama(xyz, onto[control], np.ones(len(control))) if fit is None else fit.similarity
    sizes = np.linalg.svd(xyz[inside] - xyz[inside].mean(0), compute_uv=False)
    left = (onto[seen] - given.points(np.stack([placed[at] for at in seen]))) * chart.metres
    if not sizes[1] > MAX_LINE_SPREAD_RATIO * sizes[0]:
        return NoSimilarity("ground control points lie along a line")
    hand = Handedness.of(xyz[inside], onto[control][inside], NEAR_M / chart.metres)
    if hand.wrong:
        mirrored, plain = hand.mirrored * chart.metres, hand.plain * chart.metres
        return NoSimilarity(
            f"ground control points fit mirrored only, to {mirrored:.2f} m for {plain:.1f} m; x must be east and y "
            "north, and heights count up"
        )
    residuals = left[[seen.index(at) for at, good in zip(control, inside, strict=True) if good]]
    rms = float(np.sqrt((residuals**2).sum() / max(len(residuals) - PARAMETERS, 1)))
    across = given.scale * sizes[1] * chart.metres
    if rms / np.sqrt(3) > MAX_TURN_ERROR * across:
        return NoSimilarity(
            f"residuals of {rms:.1f} m are too large for {len(residuals)} ground control points that spread by "
            f"{across / np.sqrt(len(residuals)):.1f} m"
        )
    return ControlResiduals(
        chart,
        given,
        {points[at].name: tuple(row) for at, row in zip(seen, left.tolist(), strict=True)},
        tuple(points[at].name for at, good in zip(control, inside, strict=True) if good),
        tuple(points[at].name for at in sorted(back)),
        tuple(points[at].name for at, good in zip(control, inside, strict=True) if not good),
        unseen,
        hand.right,
    )


def doubts(control: ControlResiduals, centres: Mapping[str, np.ndarray], photos: Sequence[Photo]) -> list[str]:
    """What else is known of the photographs and contradicts the control points, a line for each.

    Args:
        control: Where the points put the model.
        centres: (3,) of each placed camera in the model, by the name of its photograph.
        photos: With or without positions.
    """
    found, metres = [], control.chart.metres
    low = float(np.median(control.similarity.points(np.stack(list(centres.values())))[:, 2])) * metres
    if low < MIN_LAND_M:
        found.append(
            f"the ground control points put the photographs {-low:.0f} m below zero, where little land is: do the "
            "heights of the list count up?"
        )
    exif = {photo.name: photo.exif for photo in photos if photo.exif.position is not None and not photo.exif.unsigned}
    known = [name for name in centres if name in exif]
    if not known:
        return found
    ours = control.similarity.points(np.stack([centres[name] for name in known]))
    away = (ours - to_chart(control.chart, np.array([exif[name].position for name in known], np.float64))) * metres
    apart = np.linalg.norm(away[:, :2], axis=1)
    across = float(np.median(np.where(np.isfinite(apart), apart, np.inf)))
    rise = float(np.median(away[np.isfinite(away[:, 2]), 2])) if np.isfinite(away[:, 2]).any() else 0.0
    if across > MAX_POSITION_ERROR_M:
        far = f"{across / 1000:.0f} km" if np.isfinite(across) else "out of reach"
        found.append(
            f"the ground control points put the photographs {far} from their positions in EXIF: is {control.chart.crs} "
            "the system of the list, with x east and y north?"
        )
    elif abs(rise) > MAX_ALTITUDE_ERROR_M:
        found.append(
            f"the ground control points put the photographs {abs(rise):.0f} m {'above' if rise > 0 else 'below'} their "
            "altitudes in EXIF: do the heights of the list count up, in the unit of its system?"
        )
    return found


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
