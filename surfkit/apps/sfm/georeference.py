"""Where on Earth a reconstruction lies, by the positions that cameras wrote into EXIF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.similarity import MIN_AGREEING_POSITIONS, SimilarityFit, fit_robustly
from surfkit.apps.sfm.survey_plausibility import Handedness
from surfkit.core.check import BadInput, few
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.topocentric import Similarity
from surfkit.scene.crs import LATLON_CRS, MAX_UTM_LATITUDE, MAX_UTM_OFFSET_DEGREES, axes_of, exact, parsed, zone_of
from surfkit.scene.earth import LocalEarthFrame, utm

OFFSET_GRAIN_M = 100.0
"""Offsets are multiples of it."""
MAX_TURN_ERROR = 0.05
"""Standard error of the turn and the scale, as a share: beyond it positions do not determine them."""
MAX_LINE_SPREAD_RATIO = 0.05
"""Positions lie along a line where they spread across it by less than this share of the spread along it."""
MIN_SIGMA_M = 0.01
"""No position is trusted more."""
ASSUMED_M = 3.0
"""Standard deviation of each coordinate of a position that states none, beside others that do."""
NEAR_M = 0.1
"""A residual below it is not held against a position, nor half of it against a control point."""
MAX_WRONG_SHARE = 0.1
"""Where more positions that state no accuracy contradict the others, by no more than `ASSUMED_M`, they are not wrong:
what a receiver without corrections measures drifts, from one strip of a flight to the next by a metre."""
MAX_METRE_DIFFERENCE = 0.01
"""Units that differ from a metre by less are metres, as those of projections are."""


@dataclass(frozen=True)
class MapProjection:
    """A map that positions are put on.

    Attributes:
        crs: Coordinate reference system.
        offset: (3,) what coordinates of files leave out.
        metres: Per unit.
    """

    crs: str
    offset: tuple[float, float, float]
    metres: float = 1.0


@dataclass(frozen=True)
class NoSimilarity:
    """No similarity: why, in half a sentence."""

    reason: str


@dataclass(frozen=True)
class Placement:
    """A reconstruction on a map.

    Attributes:
        chart: The map.
        similarity: From the coordinates of the reconstruction to those of the map less the offset.
        names: Photographs with a position that is used.
        onto: (P, 3) their positions less the offset.
        fit: How well they agree.
        sigma: (P, 3) standard deviations of the positions, units of the map: what they state, else that of the
            residuals of those that state none.
        handed: Whether they are told from their mirror image: they are not all in a plane.
        plan: Whether the positions had no altitudes: heights are then above the middle of the ground, and those in
            `onto` are of the cameras.
        drifting: Positions without a stated accuracy that contradict the others a little, and count all the same.
    """

    chart: MapProjection
    similarity: Similarity
    names: tuple[str, ...]
    onto: np.ndarray
    fit: SimilarityFit
    sigma: np.ndarray
    handed: bool = False
    plan: bool = False
    drifting: int = 0


@dataclass(frozen=True)
class Levelling:
    """How a reconstruction stands level, for positions that have no altitudes.

    Attributes:
        turn: (3, 3) rotation that makes z up.
        ground: z of the middle of the ground, after it.
    """

    turn: np.ndarray
    ground: float


def chart_of(positions: np.ndarray, crs: str) -> MapProjection:
    """The map for positions, its offset near them.

    Args:
        positions: (P, 3) latitudes, longitudes, degrees, and altitudes, metres, or nan; a few may be wrong.
        crs: Coordinate reference system, or "auto" for the zone of UTM.

    Raises:
        BadInput: The coordinate reference system is not known, or is none of east, north and up.
    """
    heights = positions[np.isfinite(positions[:, 2]), 2]
    plan = np.column_stack([positions[:, 0], _unbroken(positions[:, 1])])
    middle = np.append(np.median(plan, axis=0), np.median(heights) if len(heights) else 0.0)
    if crs == "auto":
        if abs(middle[0]) > MAX_UTM_LATITUDE:
            raise BadInput(f"at latitude {middle[0]:.2f} there is no UTM; name a system with --crs, such as EPSG:3995")
        zone = int((middle[1] + 180) // 6) % 60 + 1
        crs = f"EPSG:{(32700 if middle[0] < 0 else 32600) + zone}"
    placed = to_chart(MapProjection(crs, (0.0, 0.0, 0.0)), middle[None])[0]
    if not np.isfinite(placed).all():
        raise BadInput(
            f"--crs {crs}: it does not reach {middle[0]:.4f}, {middle[1]:.4f} (latitude, longitude), the middle of the "
            "positions; name one of their country"
        )
    return chart_about(crs, placed)


def chart_about(crs: str, placed: np.ndarray) -> MapProjection:
    """The map about (3,) a place on it, its offset near it; BadInput for one that is not of east, north and up."""
    unit = LocalEarthFrame.at(crs, placed).unit
    metres = 1.0 if abs(unit - 1) < MAX_METRE_DIFFERENCE else axes_of(crs).metres
    east, north = (float(np.round(value / OFFSET_GRAIN_M) * OFFSET_GRAIN_M) for value in placed[:2])
    return MapProjection(crs, (east, north, 0.0), metres)


def to_chart(chart: MapProjection, positions: np.ndarray) -> np.ndarray:
    """(P, 3) east, north and height less the offset, of (P, 3) latitudes, longitudes and altitudes. East and north that
    are not finite say that the map does not reach them; a height is not finite where the altitude is not known."""
    zone = zone_of(chart.crs)
    if zone is not None:
        away = np.abs((positions[:, 1] - (6 * zone[0] - 183) + 180) % 360 - 180)
        reached = (np.abs(positions[:, 0]) <= MAX_UTM_LATITUDE) & (away < MAX_UTM_OFFSET_DEGREES)
        flat = np.full((len(positions), 2), np.nan)
        degrees = positions[reached, :2].tolist()
        flat[reached] = np.array([utm(latitude, longitude, *zone) for latitude, longitude in degrees]).reshape(-1, 2)
    else:
        flat = _by_pyproj(chart.crs, positions)
    return np.column_stack([flat, positions[:, 2] / chart.metres]) - chart.offset


def place(
    centres: Mapping[str, np.ndarray],
    photos: Sequence[Photo],
    chart: MapProjection,
    seed: int = 0,
    level: Levelling | None = None,
) -> Placement | NoSimilarity:
    """The similarity that brings camera centres to the positions of their photographs.

    Positions without an altitude are left out. Where what is left determines no similarity, all positions give one in
    plan, and `level` what is up.

    Args:
        centres: (3,) of each placed camera, by the name of its photograph.
        photos: With or without positions.
        chart: The map.
        seed: Of the draws.
        level: How the reconstruction stands level; None does without a similarity in plan.
    """
    given = [photo for photo in photos if photo.name in centres and photo.exif.position is not None]
    onto = to_chart(chart, np.array([photo.exif.position for photo in given], np.float64).reshape(-1, 3))
    reached = np.isfinite(onto[:, :2]).all(1)
    if far := [photo.name for photo, good in zip(given, reached, strict=True) if not good]:
        emit(Warned(f"{len(far)} positions are where {chart.crs} does not reach, and are left out: {few(far)}"))
    known, onto = [photo for photo, good in zip(given, reached, strict=True) if good], onto[reached]
    if len(known) < MIN_AGREEING_POSITIONS:
        return NoSimilarity(
            f"{len(known)} of {len(centres)} placed photographs have a position, {MIN_AGREEING_POSITIONS} are needed"
        )
    xyz = np.stack([centres[photo.name] for photo in known])
    high = np.isfinite(onto[:, 2])
    found: Placement | NoSimilarity = NoSimilarity(
        f"{high.sum()} of {len(known)} positions have an altitude, {MIN_AGREEING_POSITIONS} are needed"
    )
    if high.sum() >= MIN_AGREEING_POSITIONS:
        found = _fitted(
            [photo for photo, good in zip(known, high, strict=True) if good], xyz[high], onto[high], chart, seed
        )
    if isinstance(found, Placement) or high.all() or level is None:
        return found
    return _in_plan(known, xyz, onto, chart, seed, level)


def _fitted(
    known: Sequence[Photo], xyz: np.ndarray, onto: np.ndarray, chart: MapProjection, seed: int, axes: int = 3
) -> Placement | NoSimilarity:
    """The similarity of (P, 3) camera centres to (P, 3) places on the map, of which the first `axes` axes count."""
    stated = np.array([photo.exif.accuracy_m or (np.nan,) * 3 for photo in known], np.float64)
    stated = np.maximum(stated, MIN_SIGMA_M) / chart.metres
    silent = np.isnan(stated[:, 0])
    assumed = np.where(silent, ASSUMED_M / chart.metres, np.linalg.norm(stated[:, :axes], axis=1) / np.sqrt(axes))
    sigma, least = None if silent.all() else assumed, np.full(len(known), NEAR_M / chart.metres)
    fit, drifting = fit_robustly(xyz, onto, sigma, seed, least), 0
    if fit is not None and (drifting := _drifting(fit, silent, ASSUMED_M / chart.metres)):
        fit = fit_robustly(xyz, onto, sigma, seed, np.where(silent, ASSUMED_M / chart.metres, least))
    if fit is None:
        return NoSimilarity(f"of {len(known)} positions fewer than {MIN_AGREEING_POSITIONS} agree with the cameras")
    spread = np.linalg.svd(xyz[fit.inside] - xyz[fit.inside].mean(0), compute_uv=False)
    along, across = fit.similarity.scale * spread[:2] / np.sqrt(fit.inside.sum()) * chart.metres
    if along < NEAR_M:
        return NoSimilarity(f"{int(fit.inside.sum())} of {len(known)} positions are one place")
    if across < MAX_LINE_SPREAD_RATIO * along:
        return NoSimilarity(
            f"positions lie along a line: they spread by {along:.1f} m along it and {across:.2f} m across"
        )
    if not fit.turn_error(xyz) * np.sqrt(3 / axes) <= MAX_TURN_ERROR:
        rms = float(np.linalg.norm(fit.sigma)) * chart.metres
        return NoSimilarity(
            f"residuals of {rms:.1f} m are too large for positions that spread by {along:.1f} and {across:.1f} m"
        )
    hand = Handedness.of(xyz[fit.inside], onto[fit.inside], NEAR_M / chart.metres)
    if hand.wrong:
        mirrored, plain = hand.mirrored * chart.metres, hand.plain * chart.metres
        return NoSimilarity(
            f"positions fit mirrored only, to {mirrored:.2f} m for {plain:.1f} m: latitude and longitude are exchanged "
            "or have a wrong sign, or heights count down"
        )
    own = np.maximum(fit.deviation(silent), MIN_SIGMA_M / chart.metres)
    sigma = np.where(silent[:, None], own, stated)
    return Placement(
        chart, fit.similarity, tuple(photo.name for photo in known), onto, fit, sigma, hand.right, drifting=drifting
    )


def _drifting(fit: SimilarityFit, silent: np.ndarray, reach: float) -> int:
    """How many of the positions that state no accuracy contradict the others by a little; 0 where these are few."""
    near = np.linalg.norm(fit.residuals, axis=1) <= reach
    count = int((silent & near & ~fit.inside).sum())
    return count if count > MAX_WRONG_SHARE * silent.sum() else 0


def _in_plan(
    known: Sequence[Photo], xyz: np.ndarray, onto: np.ndarray, chart: MapProjection, seed: int, level: Levelling
) -> Placement | NoSimilarity:
    """The similarity in plan, by latitudes and longitudes alone, of a model that is made level."""
    flat = np.array([1.0, 1.0, 0.0])
    found = _fitted(known, xyz @ level.turn.T * flat, np.nan_to_num(onto) * flat, chart, seed, axes=2)
    if isinstance(found, NoSimilarity):
        return found
    turned = found.similarity  # about z, or about a level axis where the positions are mirrored
    sink = turned.scale * turned.turn @ (0.0, 0.0, level.ground)
    similarity = Similarity(turned.turn @ level.turn, turned.scale, turned.move - sink)
    heights = similarity.points(xyz)[:, 2:]
    return replace(found, similarity=similarity, onto=np.hstack([onto[:, :2], heights]), plan=True)


def centres_of(model: Any) -> dict[str, np.ndarray]:
    """(3,) centre of each placed camera of a pycolmap reconstruction, by name."""
    return {
        model.image(number).name: np.array(model.image(number).projection_center()) for number in model.reg_image_ids()
    }


def _by_pyproj(crs: str, positions: np.ndarray) -> np.ndarray:
    try:
        flat = parsed(crs).to_2d()
    except BadInput as error:
        raise BadInput(f"--crs: {error}; name one such as EPSG:2180") from error
    known = exact(LATLON_CRS, flat)
    if known is None:
        raise BadInput(f"--crs {crs}: the shift from WGS 84 to its datum is not known; name another, such as EPSG:2180")
    return np.stack(known.transform(positions[:, 1], positions[:, 0]), axis=1)


def _unbroken(longitudes: np.ndarray) -> np.ndarray:
    """(P,) longitudes without the jump from 180 to -180 degrees, where they lie on both sides of it."""
    if np.ptp(longitudes) <= 180:
        return longitudes
    turns = np.exp(1j * np.radians(longitudes))
    about = np.degrees(np.angle(turns.mean()))
    return about + (longitudes - about + 180) % 360 - 180
