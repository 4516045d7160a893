"""On which map photographs lie, and where on it a reconstruction: positions of which the signs are not known have
several readings, and the cameras of the largest reconstruction decide which of them can be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from surfkit.apps.sfm.georeference import Levelling, MapProjection, NoSimilarity, Placement, centres_of, chart_of, place
from surfkit.apps.sfm.gravity_alignment import points_of, turn_upright, up_of
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.positions import Positions, no_letters
from surfkit.apps.sfm.survey_plausibility import upside_down
from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.crs_names import covers
from surfkit.scene.crs import EGM96, UTM_PATTERN, known_axes


@dataclass(frozen=True)
class PositionHypothesis:
    """What positions may mean.

    Attributes:
        photos: With positions whose signs are chosen.
        chart: The map for them.
    """

    photos: Sequence[Photo]
    chart: MapProjection

    @property
    def middle(self) -> tuple[float, float]:
        """Latitude and longitude of one of the positions."""
        return next(photo.exif.position for photo in self.photos if photo.exif.position is not None)[:2]

    def __str__(self) -> str:
        latitude, longitude = self.middle
        north, east = "N" if latitude >= 0 else "S", "E" if longitude >= 0 else "W"
        return f"{abs(latitude):.4f} {north} {abs(longitude):.4f} {east} ({self.chart.crs})"


def readings(positions: Positions, crs: str) -> list[PositionHypothesis]:
    """What positions may mean, each with its map; one reading where all signs are known, none without positions.

    Args:
        positions: Of the usable photographs.
        crs: Coordinate reference system, or "auto" for the map of a list, else for the zone of UTM.

    Raises:
        BadInput: No reading is on the map.
    """
    if not any(photo.exif.position is not None for photo in positions.photos):
        if crs != "auto":
            raise BadInput(f"--crs {crs} needs positions, and no photograph has one; leave it out")
        return []
    found, wrong = [], []
    choices = positions.readings()
    for photos in choices:
        known = np.array([photo.exif.position for photo in photos if photo.exif.position is not None], np.float64)
        try:
            if len(choices) > 1 and crs != "auto" and not covers(crs, *np.median(known[:, :2], axis=0)):
                raise BadInput(f"--crs {crs} is not meant for where the photographs are, whichever hemisphere it is")
            found.append(PositionHypothesis(photos, _chart(known, crs, positions.crs)))
        except BadInput as error:
            wrong.append(error)
    if not found:
        raise wrong[0]
    return found


def _chart(known: np.ndarray, crs: str, listed: str | None) -> MapProjection:
    if crs == "auto" and listed is not None:
        try:
            return chart_of(known, listed)
        except BadInput as error:
            emit(Warned(f"the positions are listed in {listed}, which a scene cannot be in ({error}); UTM is used"))
    return chart_of(known, crs)


def decide(
    model: Any, choices: Sequence[PositionHypothesis], positions: Positions, seed: int
) -> PositionHypothesis | NoSimilarity:
    """The reading that the cameras allow; refused where none or several do.

    Args:
        model: pycolmap.Reconstruction, the largest.
        choices: The readings.
        positions: What they are readings of.
        seed: Of the draws.
    """
    if not positions.open:
        return choices[0]
    letters = no_letters(positions.photos)
    tried = [(choice, locate(model, choice, seed)) for choice in choices]
    good = [choice for choice, where in tried if isinstance(where, Placement)]
    if len(good) == 1:
        emit(Warned(f"{letters}; the only place that fits the cameras is {good[0]}"))
        return good[0]
    remedy = "name the map with --crs, or give the positions with --positions"
    if good:
        return NoSimilarity(f"{letters}, and {' and '.join(map(str, good))} fit alike; {remedy}")
    reason = next(where.reason for _, where in tried if isinstance(where, NoSimilarity))
    return NoSimilarity(f"{letters}, and no sign fits ({reason}); {remedy}")


def locate(model: Any, reading: PositionHypothesis, seed: int) -> Placement | NoSimilarity:
    """Where a reconstruction lies by positions; refused where these do not tell, or put it upside down.

    Args:
        model: pycolmap.Reconstruction.
        reading: The positions, and the map.
        seed: Of the draws.
    """
    by_name: Mapping[str, Photo] = {photo.name: photo for photo in reading.photos}
    up = up_of(model, by_name)
    turn = turn_upright(up)
    level = Levelling(turn, float(np.median(points_of(model) @ turn[2])))
    found = place(centres_of(model), reading.photos, reading.chart, seed, level)
    if isinstance(found, NoSimilarity):
        return found
    if why := upside_down(model, found.similarity, up, found.chart.metres, found.handed):
        return NoSimilarity(f"by their positions {why}; are latitude and longitude, or their signs, exchanged?")
    return found


def heights_named(where: Placement, photos: Sequence[Photo], given: str) -> tuple[Placement, str]:
    """The placement on a map whose system says what heights are above, and what the user is to know of that.

    Args:
        where: With heights.
        photos: With positions.
        given: `--crs`, which is taken as it is, or "auto".
    """
    zeros = {photo.exif.zero for photo in photos if photo.name in where.names}
    crs, axes = where.chart.crs, known_axes(where.chart.crs)
    says_height = axes is not None and axes.height_metres is not None
    if zeros == {"sea level"} and given == "auto" and UTM_PATTERN.fullmatch(crs) and not says_height:
        chart = replace(where.chart, crs=crs + EGM96)
        return replace(where, chart=chart), (
            f"heights are above sea level, as is the rule in EXIF, so the scene is in {chart.crs} (EGM96); where the "
            f"drone counts them from the ellipsoid, give --crs {crs}"
        )
    if zeros == {"sea level"} and axes is not None and not says_height:
        return where, (
            f"--crs {crs} has no vertical part: heights are taken as they are, which EXIF counts from sea level by its "
            "rule"
        )
    if zeros == {"ellipsoid"}:
        above = "heights are above the ellipsoid, as RTK or VertCS (XMP) or GPSAltitudeRef in EXIF say"
        return (
            where,
            f"{above}, and --crs {crs} says something else; leave its vertical part out" if says_height else above,
        )
    if len(zeros) > 1 and None in zeros:
        return where, (
            "heights of some photographs are those of a list and of others those in EXIF, which may be counted from "
            "elsewhere, up to 100 m apart; they are taken as they are; give all of them with --positions"
        )
    if {"sea level", "ellipsoid"} <= zeros:
        return where, (
            "heights of some photographs are above the ellipsoid (RTK in XMP, or GPSAltitudeRef in EXIF) and of others "
            "above sea level, up to 100 m apart; they are taken as they are; give all of one kind with --positions"
        )
    return where, ""
