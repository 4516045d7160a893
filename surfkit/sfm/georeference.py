"""Where on Earth a reconstruction lies, by the positions that cameras wrote into EXIF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from surfkit.core.check import BadInput, few
from surfkit.core.events import Warned, emit
from surfkit.readers.georeference import BESIDE, POLAR, Similarity, zone_of
from surfkit.scene.crs import DEGREES, axes_of, exact, parsed
from surfkit.scene.earth import Site, utm
from surfkit.sfm.photographs import Photo
from surfkit.sfm.similarity import FEWEST, Fit, fit_robustly

GRAIN_M = 100.0
"""Offsets are multiples of it."""
MOST_TURN = 0.05
"""Standard error of the turn and the scale, as a share: beyond it positions do not determine them."""
LINE = 0.05
"""Positions lie along a line where they spread across it by less than this share of the spread along it."""
NEAR_M = 0.1
"""A residual below it is not held against a position, nor half of it against a control point."""
METRIC = 0.01
"""Units that differ from a metre by less are metres, as those of projections are."""


@dataclass(frozen=True)
class Chart:
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
class Refused:
    """No similarity: why, in half a sentence."""

    reason: str


@dataclass(frozen=True)
class Placement:
    """A reconstruction on a map.

    Attributes:
        chart: The map.
        similarity: From the coordinates of the reconstruction to those of the map less the offset.
        names: Photographs with a position.
        onto: (P, 3) their positions less the offset.
        fit: How well they agree.
    """

    chart: Chart
    similarity: Similarity
    names: tuple[str, ...]
    onto: np.ndarray
    fit: Fit


def chart_of(positions: np.ndarray, crs: str) -> Chart:
    """The map for positions, its offset near them.

    Args:
        positions: (P, 3) latitudes, longitudes, degrees, and altitudes, metres; a few may be wrong.
        crs: Coordinate reference system, or "auto" for the zone of UTM.

    Raises:
        BadInput: The coordinate reference system is not known, or is none of east, north and up, or pyproj is missing.
    """
    middle = np.median(np.column_stack([positions[:, 0], _unbroken(positions[:, 1]), positions[:, 2]]), axis=0)
    if crs == "auto":
        if abs(middle[0]) > POLAR:
            raise BadInput(f"at latitude {middle[0]:.2f} there is no UTM; name a system with --crs, such as EPSG:3995")
        zone = int((middle[1] + 180) // 6) % 60 + 1
        crs = f"EPSG:{(32700 if middle[0] < 0 else 32600) + zone}"
    placed = to_chart(Chart(crs, (0.0, 0.0, 0.0)), middle[None])[0]
    if not np.isfinite(placed).all():
        raise BadInput(
            f"--crs {crs}: it does not reach {middle[0]:.4f}, {middle[1]:.4f} (latitude, longitude), the middle of the "
            "positions; name one of their country"
        )
    return chart_about(crs, placed)


def chart_about(crs: str, placed: np.ndarray) -> Chart:
    """The map about (3,) a place on it, its offset near it; BadInput for one that is not of east, north and up."""
    unit = Site.at(crs, placed).unit
    metres = 1.0 if abs(unit - 1) < METRIC else axes_of(crs).metres
    east, north = (float(np.round(value / GRAIN_M) * GRAIN_M) for value in placed[:2])
    return Chart(crs, (east, north, 0.0), metres)


def to_chart(chart: Chart, positions: np.ndarray) -> np.ndarray:
    """(P, 3) east, north and height less the offset, of (P, 3) latitudes, longitudes and altitudes; what is not finite
    in a row says that the map does not reach it."""
    zone = zone_of(chart.crs.upper())
    if zone is not None:
        away = np.abs((positions[:, 1] - (6 * zone[0] - 183) + 180) % 360 - 180)
        reached = (np.abs(positions[:, 0]) <= POLAR) & (away < BESIDE)
        flat = np.full((len(positions), 2), np.nan)
        flat[reached] = np.array([utm(*row, *zone) for row in positions[reached, :2].tolist()]).reshape(-1, 2)
    else:
        flat = _by_pyproj(chart.crs, positions)
    return np.column_stack([flat, positions[:, 2] / chart.metres]) - chart.offset


def place(
    centres: Mapping[str, np.ndarray], photos: Sequence[Photo], chart: Chart, seed: int = 0
) -> Placement | Refused:
    """The similarity that brings camera centres to the positions of their photographs.

    Args:
        centres: (3,) of each placed camera, by the name of its photograph.
        photos: With or without positions.
        chart: The map.
        seed: Of the draws.
    """
    given = [photo for photo in photos if photo.name in centres and photo.exif.position is not None]
    onto = to_chart(chart, np.array([photo.exif.position for photo in given], np.float64).reshape(-1, 3))
    reached = np.isfinite(onto).all(1)
    if far := [photo.name for photo, good in zip(given, reached, strict=True) if not good]:
        emit(Warned(f"{len(far)} positions are where {chart.crs} does not reach, and are left out: {few(far)}"))
    known, onto = [photo for photo, good in zip(given, reached, strict=True) if good], onto[reached]
    if len(known) < FEWEST:
        return Refused(f"{len(known)} of {len(centres)} placed photographs have a position, {FEWEST} are needed")
    xyz = np.stack([centres[photo.name] for photo in known])
    stated = [photo.exif.accuracy_m for photo in known]
    sigma = None if None in stated else np.linalg.norm(np.array(stated, np.float64), axis=1) / np.sqrt(3)
    fit = fit_robustly(xyz, onto, sigma, seed, NEAR_M / chart.metres)
    if fit is None:
        return Refused(f"of {len(known)} positions fewer than {FEWEST} agree with the cameras")
    spread = np.linalg.svd(xyz[fit.inside] - xyz[fit.inside].mean(0), compute_uv=False)
    along, across = fit.similarity.scale * spread[:2] / np.sqrt(fit.inside.sum()) * chart.metres
    rms = float(np.linalg.norm(fit.sigma)) * chart.metres
    if along < NEAR_M:
        return Refused(f"{int(fit.inside.sum())} of {len(known)} positions are one place")
    if across < LINE * along:
        return Refused(f"positions lie along a line: they spread by {along:.1f} m along it and {across:.2f} m across")
    if rms / np.sqrt(3) > MOST_TURN * across * np.sqrt(fit.inside.sum()):
        return Refused(
            f"residuals of {rms:.1f} m are too large for positions that spread by {along:.1f} and {across:.1f} m"
        )
    return Placement(chart, fit.similarity, tuple(photo.name for photo in known), onto, fit)


def centres_of(model: Any) -> dict[str, np.ndarray]:
    """(3,) centre of each placed camera of a pycolmap reconstruction, by name."""
    return {
        model.image(number).name: np.array(model.image(number).projection_center()) for number in model.reg_image_ids()
    }


def _by_pyproj(crs: str, positions: np.ndarray) -> np.ndarray:
    try:
        flat = parsed(crs).to_2d()
    except BadInput as error:
        raise BadInput(f"--crs {crs}: {error}; name one such as EPSG:2180") from error
    known = exact(DEGREES, flat)
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
