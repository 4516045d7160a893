"""Coordinate reference systems of maps: their axes and units, and transformations by pyproj that guess nothing.

Where the grid of a datum or of a geoid is not installed, PROJ falls back to a "ballpark" transformation, which leaves
out the shift of the datum (some 100 m) or of the heights (up to 100 m) and says nothing. Here it never does:
`exact` transforms with what is known, or not at all, and `missing` names the grids that would do better.
"""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from pyproj import CRS, Geod, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from surfkit.core.check import BadInput

NUMBER = r"(-?[\d.]+(?:e-?\d+)?)"
TOPOCENTRIC = re.compile(rf"\+proj=topocentric \+ellps=WGS84 \+lat_0={NUMBER} \+lon_0={NUMBER} \+h_0={NUMBER}")
EGM96 = "+5773"
"""What the code of a map ends with where heights are above sea level by EGM96, the geoid that receivers of GPS know."""
UTM_PATTERN = re.compile(rf"EPSG:32([67])(0[1-9]|[1-5]\d|60)({re.escape(EGM96)})?", re.IGNORECASE)
MAX_UTM_LATITUDE, MAX_UTM_OFFSET_DEGREES = 84.0, 30.0
"""Degrees of latitude up to which UTM is used, and of longitude from its meridian."""
LATLON_CRS = "EPSG:4326"
UNIT_ABBREVIATIONS = {"metre": "m", "foot": "ft", "US survey foot": "US ft", "kilometre": "km"}
"""Short names of units of length, by those of EPSG."""
SAME_UNIT = 1e-5
"""Largest difference of two units that are one, as a share: feet of the two kinds differ by 2e-6."""
UNIT_OFF = 0.01
"""Largest difference, as a share, of a stated unit from that of the coordinate reference system."""
SCALE_STEP_M = 100.0
"""Over which lengths on the map are measured."""
AREA_MARGIN_DEGREES = 1.0
"""Degrees beyond the area of a transformation that it is still used in."""
COARSE_M = 2.0
"""Accuracy of a transformation from which on a better one is told of, where it lacks its grid only."""


@dataclass(frozen=True)
class AxisUnits:
    """Units of a system of easting and northing.

    Attributes:
        metres: Per unit of easting and northing.
        unit: Its name, such as "US survey foot".
        height_metres: Per unit of height; None where the system has no heights.
        height_unit: Its name; "" where it has none.
    """

    metres: float = 1.0
    unit: str = "metre"
    height_metres: float | None = None
    height_unit: str = ""

    @property
    def symbol(self) -> str:
        """The unit behind numbers, such as "m" or "US ft"."""
        return UNIT_ABBREVIATIONS.get(self.unit, self.unit)


def parsed(crs: str) -> CRS:
    """The system as pyproj has it.

    Raises:
        BadInput: pyproj does not know it.
    """
    try:
        return CRS(crs)
    except (ProjError, UnicodeEncodeError) as error:  # the latter of half a character, as JSON may have it
        said = " ".join(str(error).split())[:200].removeprefix(f"Invalid projection: {crs}: ")
        raise BadInput(f"coordinate reference system {crs!r}: pyproj cannot place it on Earth: {said}") from error


def from_wkt(where: str, text: str) -> CRS:
    """The system of a well-known text in a file.

    Raises:
        BadInput: It is none; names `where` it comes from.
    """
    try:
        return CRS.from_wkt(text)
    except (CRSError, UnicodeEncodeError) as error:
        said = " ".join(str(error).rpartition("proj_create: ")[2].removesuffix(")").split())[:200]
        raise BadInput(
            f"{where}: no coordinate reference system that pyproj reads: {said}; export it again, in another one such "
            "as UTM if that does not help"
        ) from error


def in_plan(crs: CRS) -> CRS:
    """A system without its heights, and without the shift of datum (TOWGS84) that its text may have."""
    flat = crs.sub_crs_list[0] if crs.is_compound else crs
    return _unbound(flat)


def _unbound(crs: CRS) -> CRS:
    """A system without the transformation that is bound to it."""
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


def code_in(crs: CRS) -> str | None:
    """The code that a text itself names, such as "EPSG:32632"; None where it names none.

    Not `CRS.to_epsg`, which looks for a system that is alike: it takes UTM on an unknown datum with the ellipsoid of
    1924 for ED50, some 100 m away.
    """
    named = crs.to_json_dict().get("id")
    return f"{named['authority']}:{named['code']}".upper() if named else None


def metres_of(crs: CRS) -> float | None:
    """Metres per unit of the first axis; None where that is no length."""
    metres = crs.axis_info[0].unit_conversion_factor if crs.axis_info else 0.0
    return metres if 0 < metres < 1e6 else None


def axes_of(crs: str) -> AxisUnits:
    """The units of a system.

    Raises:
        BadInput: It is not one of easting and northing in a unit of length, or heights are in another unit than
            those; or pyproj does not know it.
    """
    if is_plain(crs):
        return AxisUnits(height_metres=1.0, height_unit="metre") if crs.endswith(EGM96) else AxisUnits()
    given = parsed(crs)
    if given.is_geographic:
        raise BadInput(f"{crs}: it is in degrees, where lengths belong; name a projected one, such as EPSG:32633")
    if not given.is_projected:
        raise BadInput(f"{crs}: it has no easting and northing; name a projected one, such as EPSG:32633")
    x, y, *up = given.axis_info
    toward = {x.direction, y.direction}
    if toward != {"east", "north"} and toward not in ({"north"}, {"south"}):  # the latter about a pole
        raise BadInput(
            f"{crs}: its axes point {x.direction} and {y.direction}; convert the coordinates to a system whose axes "
            "point east and north, as those of EPSG:5514 do and of EPSG:5513 do not"
        )
    metres, heights = x.unit_conversion_factor, up[0].unit_conversion_factor if up else None
    if heights is not None and abs(heights / metres - 1) > SAME_UNIT:
        feet = "; feet of height have EPSG:6360 (US survey feet) and EPSG:8228 (feet)" if 0.3 < metres < 0.31 else ""
        raise BadInput(
            f"{crs}: easting and northing are in units of {x.unit_name}, heights in {up[0].unit_name}; a scene has one "
            f"unit on all axes: name a system with one{feet}"
        )
    return AxisUnits(metres, x.unit_name, heights, up[0].unit_name if up else "")


def is_plain(crs: str) -> bool:
    """Whether it is a zone of UTM on WGS 84, with or without heights by EGM96, or a topocentric frame, in metres: they
    are computed here, but for the heights of the geoid."""
    return bool(UTM_PATTERN.fullmatch(crs) or TOPOCENTRIC.fullmatch(crs))


def zone_of(crs: str) -> tuple[int, bool] | None:
    """Number of a zone of UTM on WGS 84, and whether it is south of the equator; None for any other system."""
    found = UTM_PATTERN.fullmatch(crs)
    return (int(found[2]), found[1] == "7") if found and not found[3] else None


def known_axes(crs: str) -> AxisUnits | None:
    """The same; None where it is none of a map with one unit."""
    try:
        return axes_of(crs)
    except BadInput:
        return None


def refuse_other_unit(crs: str, metres: float | None, place: np.ndarray) -> None:
    """BadInput where the metres per unit that were stated for coordinates contradict their system.

    Args:
        crs: The system.
        metres: Stated; None is not.
        place: (3,) easting, northing and height of the scene: a unit may also be as long as it is on the ground there.
    """
    axes = axes_of(crs)
    if metres is None or abs(metres / axes.metres - 1) <= UNIT_OFF:
        return
    if abs(metres / (axes.metres * scale_at(crs, place)) - 1) > UNIT_OFF:
        raise BadInput(
            f"{crs} is in units of {axes.unit} ({axes.metres:.9g} m), and the data set or --metres-per-unit says that "
            f"a unit is {metres:.9g} m; correct metres_per_unit in georeference.json, or name the system that the "
            "coordinates are in"
        )


def scale_at(crs: str, place: np.ndarray) -> float:
    """Length on the ground, as a share of that on the map, at an easting and northing; 1 where that is not known.

    It is the geometric mean of both axes, within 0.1 % of 1 in a zone of UTM, and the cosine of the latitude in web
    Mercator.
    """
    if is_plain(crs):
        return 1.0
    steps = SCALE_STEP_M / axes_of(crs).metres * np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
    lon, lat = degrees_of(crs, np.asarray(place, np.float64)[:2] + steps)
    if not np.isfinite([lon, lat]).all():
        return 1.0
    lengths = Geod(ellps="WGS84").inv(lon[[0, 2]], lat[[0, 2]], lon[[1, 3]], lat[[1, 3]])[2]
    return float(np.sqrt(np.prod(lengths)) / (2 * SCALE_STEP_M))


def degrees_of(crs: str, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P,) longitudes and latitudes of (P, 2) eastings and northings, degrees on the datum of the system itself."""
    flat = _unbound(parsed(crs).to_2d())
    geodetic = flat.geodetic_crs
    assert geodetic is not None, "a system in plan has one"
    own = geodetic.to_2d()
    found = Transformer.from_crs(flat, own, always_xy=True).transform(*np.asarray(places, np.float64)[:, :2].T)
    lon, lat = (np.degrees(np.asarray(at) * own.axis_info[0].unit_conversion_factor) for at in found)
    meridian = own.prime_meridian
    assert meridian is not None, "a geodetic system has one"
    return lon + np.degrees(meridian.longitude * float(meridian.unit_conversion_factor)), lat


def exact(source: Any, target: Any) -> Any | None:
    """A transformer of pyproj, x before y, that leaves out no shift of datum or heights; None where there is none.

    Args:
        source: A coordinate reference system, or what names one.
        target: Another one.
    """
    try:
        return Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)
    except ProjError:
        return None


def used_beyond(known: Any, lon: float, lat: float) -> bool:
    """Whether what a transformer did last is not meant for a place, in degrees: its shift may be far off there."""
    area = known.get_last_used_operation().area_of_use
    if area is None:
        return False
    wide = (area.east - area.west) % 360 or 360.0
    along = (lon - area.west + AREA_MARGIN_DEGREES) % 360 <= wide + 2 * AREA_MARGIN_DEGREES
    return not (along and area.south - AREA_MARGIN_DEGREES <= lat <= area.north + AREA_MARGIN_DEGREES)


def missing(source: Any, target: Any, lon: float, lat: float) -> tuple[list[str], float]:
    """Grids that the best transformation at a place in degrees lacks, and how exact it is, metres (-1: not known)."""
    area = AreaOfInterest(lon - 1e-3, max(lat - 1e-3, -90.0), lon + 1e-3, min(lat + 1e-3, 90.0))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the best one is not available, as is said here
            group = TransformerGroup(source, target, always_xy=True, area_of_interest=area, allow_ballpark=False)  # type: ignore[arg-type]
    except ProjError:
        return [], -1.0
    best = min(group.unavailable_operations, key=lambda each: each.accuracy if each.accuracy >= 0 else math.inf,
               default=None)  # fmt: skip
    if best is None:
        return [], -1.0
    return [grid.short_name for grid in best.grids if not grid.available], best.accuracy


def not_installed(grids: list[str]) -> str:
    """That grids of PROJ are missing, and what installs them; "" if none is."""
    if not grids:
        return ""
    named, get = " and ".join(grids), " and ".join(f"`pyproj sync --file {name}`" for name in grids)
    return f"PROJ needs the grid{'s' if len(grids) > 1 else ''} {named}, not installed here; {get} gets what is missing"
