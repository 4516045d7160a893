"""Where a model lies on the map by ground control points, and how far each of them is off.

The similarity to the map is that of the points, triangulated in the model; points held back check it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from surfkit.apps.sfm.control_list import MIN_CONTROL_POINTS, MIN_POINT_PHOTOS, GroundControl
from surfkit.apps.sfm.control_marks import Images, WrongMark, images_of, mark_residuals, triangulate
from surfkit.apps.sfm.georeference import (
    MAX_LINE_SPREAD_RATIO,
    MAX_TURN_ERROR,
    NEAR_M,
    MapProjection,
    NoSimilarity,
    to_chart,
)
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.similarity import MIN_AGREEING_POSITIONS, PARAMETERS, fit_robustly, umeyama
from surfkit.apps.sfm.survey_plausibility import MAX_ALTITUDE_ERROR_M, MAX_POSITION_ERROR_M, MIN_LAND_M, Handedness
from surfkit.core.check import few
from surfkit.io.datasets.topocentric import Similarity

STATED_TIMES = 3.0
"""Residuals of a coordinate up to so many times the stated standard deviation are as good as the points are."""
MAX_SURVEY_SIGMA_M = 10.0
"""No receiver is less accurate: larger residuals are those of a wrong list."""


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
        places: By name, (3,) the place on the list less the offset, units of the map.
        marks: By name of the point and of the photograph, the mark less the pixel of the triangulated point.
        wrong_marks: Those left out.
        turn_error: Standard error of the scale and the turn of the similarity, as a share.
        adjustment: What the report says of the bundle adjustment with the points; empty without one.
    """

    chart: MapProjection
    similarity: Similarity
    residuals: Mapping[str, tuple[float, float, float]]
    control: tuple[str, ...]
    checkpoints: tuple[str, ...]
    wrong: tuple[str, ...]
    unseen: tuple[str, ...]
    handed: bool
    places: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    marks: Mapping[str, Mapping[str, tuple[float, float]]] = field(default_factory=dict)
    wrong_marks: tuple[WrongMark, ...] = ()
    turn_error: float = 0.0
    adjustment: Mapping[str, Any] = field(default_factory=dict)

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
            "marks_px": {
                point: {name: [round(value, 2) for value in left] for name, left in rows.items()}
                for point, rows in self.marks.items()
            },
            "wrong_marks": list(self.wrong_marks),
            "adjustment": dict(self.adjustment),
        }

    def role(self, name: str) -> str:
        """What a point is: "control", "checkpoint", "left out" or "in too few photographs"."""
        roles = {"control": self.control, "checkpoint": self.checkpoints, "left out": self.wrong}
        return next((role for role, names in roles.items() if name in names), "in too few photographs")

    def measured(self, images: Images, ground: GroundControl) -> ControlResiduals:
        """The same with residuals in the placed photographs (`images`) of a model that is on the map."""
        residuals, marks = dict[str, tuple[float, float, float]](), dict[str, dict[str, tuple[float, float]]]()
        for point, onto in zip(ground.points, ground.onto, strict=True):
            if (xyz := triangulate(images, point.marks)) is not None:
                residuals[point.name] = tuple(((onto - xyz) * self.chart.metres).tolist())
                left = mark_residuals(images, point.marks, xyz)
                marks[point.name] = {name: tuple(row.tolist()) for name, row in left.items()}
        return replace(self, residuals=residuals, marks=marks)

    def rms(self, names: Sequence[str]) -> dict[str, float]:
        """Root mean square of the residuals of some points, by axis."""
        rows = np.array([self.residuals[name] for name in names])
        return dict(zip("enu", np.sqrt((rows**2).mean(0)).round(3).tolist(), strict=True))


def place_by_points(
    model: Any, ground: GroundControl, held_back: int, named: Sequence[str] = (), sigma_m: float = 0.0
) -> ControlResiduals | NoSimilarity:
    """The similarity that brings control points to their places.

    Args:
        model: pycolmap.Reconstruction.
        ground: The points.
        held_back: How many are checkpoints, spread over the list.
        named: Names of checkpoints, instead of so many.
        sigma_m: Stated standard deviation of each surveyed coordinate, metres.
    """
    points, chart, onto = ground.points, ground.chart, ground.onto
    images = images_of(model)
    found = [triangulate(images, point.marks) for point in points]
    placed = {at: xyz for at, xyz in enumerate(found) if xyz is not None}
    seen = list(placed)
    unseen = tuple(point.name for at, point in enumerate(points) if at not in set(seen))
    back = {at for at in seen if points[at].name in named}
    count = max(held_back, len(back))
    if len(seen) < MIN_CONTROL_POINTS + count:
        also = f" besides {count} checkpoints" if count else ""
        return NoSimilarity(
            f"{len(seen)} of {len(points)} ground control points are in {MIN_POINT_PHOTOS} placed photographs or more, "
            f"{MIN_CONTROL_POINTS} are needed{also}"
        )
    spread = np.linspace(0, len(seen) - 1, held_back + 2).round().astype(int)[1:-1].tolist() if held_back else []
    back |= {seen[at] for at in spread}
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
    used = [seen.index(at) for at, good in zip(control, inside, strict=True) if good]
    rms = float(np.sqrt((left[used] ** 2).sum() / (3 * max(len(used) - PARAMETERS, 1))))
    along, across = given.scale * sizes[:2] * chart.metres
    if rms > MAX_TURN_ERROR * across and rms > STATED_TIMES * sigma_m:
        away = {points[seen[at]].name: float(np.linalg.norm(left[at])) for at in used}
        return NoSimilarity(_too_large(rms, away, along / np.sqrt(len(used)), across / np.sqrt(len(used))))
    return ControlResiduals(
        chart,
        given,
        {points[at].name: tuple(row) for at, row in zip(seen, left.tolist(), strict=True)},
        tuple(points[at].name for at, good in zip(control, inside, strict=True) if good),
        tuple(points[at].name for at in sorted(back)),
        tuple(points[at].name for at, good in zip(control, inside, strict=True) if not good),
        unseen,
        hand.right,
        {point.name: tuple(row) for point, row in zip(points, onto.tolist(), strict=True)},
        turn_error=float(rms / across),
    )


def _too_large(rms: float, away: Mapping[str, float], along: float, across: float) -> str:
    """What is said where residuals, `rms` a coordinate and `away` by the name of a point, do not fit the spread of the
    points; metres all."""
    worst = few([f"{name} ({away[name]:.1f} m)" for name in sorted(away, key=lambda name: -away[name])])
    less = f" If the points were surveyed no better, add --gcp-sigma {rms:.2g}" if rms <= MAX_SURVEY_SIGMA_M else ""
    return (
        f"residuals of {rms:.2f} m a coordinate are too large for {len(away)} ground control points that spread by "
        f"{along:.0f} and {across:.0f} m: {worst}. Are the marks on the points and in these photographs, and the "
        f"coordinates in the system that the list names?{less}"
    )


def doubts(control: ControlResiduals, centres: Mapping[str, np.ndarray], photos: Sequence[Photo]) -> list[str]:
    """What else is known of the photographs and contradicts the control points, a line for each.

    Args:
        control: Where the points put the model.
        centres: (3,) of each placed camera in the model, by the name of its photograph.
        photos: With or without positions.
    """
    found, metres = [], control.chart.metres
    if control.turn_error > MAX_TURN_ERROR:
        found.append(
            f"the ground control points agree so little that scale and tilt of the scene are known to "
            f"{100 * control.turn_error:.0f} % only"
        )
    if all(float(place[2]) + control.chart.offset[2] == 0 for place in control.places.values()):
        found.append(
            "all heights on the list are 0: if they were not surveyed, the heights of the scene are not absolute, and "
            "ground that is not level tilts it"
        )
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
