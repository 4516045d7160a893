"""Coordinate reference systems as OpenDroneMap, and lists of positions and of ground control points, name them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.scene.crs import MAX_UTM_LATITUDE, MAX_UTM_OFFSET_DEGREES, code_in, exact, from_wkt, zone_of
from surfkit.scene.earth import from_utm

WGS84_DEGREES = "EPSG:4326"
EPSG_NAME_PATTERN = re.compile(
    r"(?:.*\()?(?:urn:ogc:def:crs:)?EPSG\s*:{0,2}\s*(\d+(?:\+\d+)?)\)?", re.IGNORECASE | re.DOTALL
)
"""A code alone, as "EPSG:32633" or "epsg::4326", or after a name, as "WGS 84 (EPSG::4326)"."""
UTM_NAME_PATTERN = re.compile(r"WGS[ _]?84\s*/?\s*UTM(?:\s+zone)?\s*(\d+)\s*([A-Z])?", re.IGNORECASE)
"""OpenDroneMap's "WGS84 UTM 33N", and the name of EPSG, "WGS 84 / UTM zone 33N"."""
WGS84_NAMES = frozenset({"WGS84", "WGS 84", "WGS_84"})
WKT = re.compile(r"[A-Z_]+\s*\[", re.IGNORECASE)
"""How well-known text begins."""
PROJ = re.compile(
    r"\+(proj=(utm|longlat|latlong)|zone=\d+|south|(datum|ellps)=WGS84|towgs84=0(,0)*|units=m|no_defs|type=crs)(=True)?"
)
"""Words of PROJ that leave UTM and degrees on WGS 84, in metres. For pyproj, their datum is not known where they name
an ellipsoid only."""


@dataclass(frozen=True)
class System:
    """A coordinate reference system.

    Attributes:
        crs: As surfkit writes it: a code of EPSG where there is one.
        degrees: Whether coordinates are longitude, latitude and height; otherwise they are east, north and up.
    """

    crs: str
    degrees: bool

    @property
    def height_metres(self) -> float:
        """Metres per unit of heights: where a map has no heights of its own, they are in its unit, as those of control
        points and of scenes on it are."""
        if self.crs == WGS84_DEGREES or zone_of(self.crs):
            return 1.0
        axes = CRS(self.crs).axis_info
        if len(axes) < 3:
            return 1.0 if self.degrees else float(axes[0].unit_conversion_factor)
        return float(axes[2].unit_conversion_factor)

    @property
    def lost_heights(self) -> str:
        """What is to be said of a system in degrees that says what heights are above, as a scene in UTM does not; ""
        where nothing is lost."""
        if not self.degrees or self.crs == WGS84_DEGREES or not (given := CRS(self.crs)).is_compound:
            return ""
        name = given.sub_crs_list[1].name
        return (
            f"its heights are above {name}, which the zone of UTM that the scene is in does not say; for maps and "
            "tiles to say it, name the zone and its heights with --crs, such as EPSG:32633+5773 for EGM96"
        )

    def positions(self, xyz: np.ndarray) -> np.ndarray:
        """(P, 3) latitudes and longitudes, degrees on WGS 84, and heights, metres, of (P, 3) coordinates.

        Heights are those of the list, counted from what it counts them from; those that are not known are not finite,
        nor are latitude and longitude where the system does not reach.
        """
        if self.crs == WGS84_DEGREES:
            return xyz[:, [1, 0, 2]]
        if zone := zone_of(self.crs):
            found = np.column_stack([*from_utm(xyz[:, 0], xyz[:, 1], *zone), xyz[:, 2]])
            away = np.abs(found[:, 1] - (6 * zone[0] - 183))
            found[~((np.abs(found[:, 0]) <= MAX_UTM_LATITUDE) & (away < MAX_UTM_OFFSET_DEGREES)), :2] = np.nan
            return found
        given = CRS(self.crs)
        known = exact(given.to_2d(), WGS84_DEGREES)
        if known is None:
            emit(
                Warned(f"{self.crs}: the shift of its datum to WGS 84 is not known here; places may be some 100 m off")
            )
            known = Transformer.from_crs(given.to_2d(), WGS84_DEGREES, always_xy=True)
        flat = known.transform(xyz[:, 0], xyz[:, 1])
        return np.column_stack([flat[1], flat[0], xyz[:, 2] * self.height_metres])


def names_a_system(text: str) -> bool:
    """Whether a line looks like the name of a coordinate reference system, known or not."""
    text = text.strip().strip("'\"")
    return bool(
        EPSG_NAME_PATTERN.fullmatch(text)
        or UTM_NAME_PATTERN.fullmatch(text)
        or text.upper() in WGS84_NAMES
        or WKT.match(text)
    ) or text.startswith("+")


def system_of(text: str) -> System:
    """The system that a line names: a code of EPSG, "WGS84 UTM 33N", "WGS84", a text of PROJ or well-known text.

    Raises:
        BadInput: It is none.
    """
    text = text.strip().strip("'\"").strip()
    if found := UTM_NAME_PATTERN.fullmatch(text):
        return _utm(text, int(found[1]), (found[2] or "").upper())
    if text.startswith("+") and all(map(PROJ.fullmatch, text.split())):
        words = {word.removesuffix("=True") for word in text.split()}
        if words & {"+proj=longlat", "+proj=latlong"}:
            return System(WGS84_DEGREES, True)
        if number := next((int(word.removeprefix("+zone=")) for word in words if word.startswith("+zone=")), None):
            return _utm(text, number, "S" if "+south" in words else "N")
    named = code_in(from_wkt("well-known text", text)) if WKT.match(text) else None
    if found := EPSG_NAME_PATTERN.fullmatch(named or text):
        text = f"EPSG:{found[1]}"
    return _by_pyproj(text)


def covers(crs: str, latitude: float, longitude: float) -> bool:
    """Whether a system is meant for a place; True where it does not say what it is meant for."""
    if zone := zone_of(crs):
        away = abs((longitude - (6 * zone[0] - 183) + 180) % 360 - 180)
        return away < 6 and abs(latitude) <= MAX_UTM_LATITUDE and (latitude < 1 if zone[1] else latitude > -1)
    try:
        area = CRS(crs).area_of_use
    except ProjError:
        return True  # what is wrong with it is said where it is used
    if area is None:
        return True
    across = (area.east - area.west) % 360 or 360.0
    return area.south - 1 <= latitude <= area.north + 1 and (longitude - area.west + 1) % 360 <= across + 2


def _utm(text: str, number: int, letter: str) -> System:
    if not 1 <= number <= 60:
        raise BadInput(f"{text!r} names zone {number} of UTM; they are 1 to 60")
    if letter not in ("N", "S"):
        raise BadInput(
            f"{text!r} has {f'the letter {letter!r}' if letter else 'no letter'} after the zone of UTM; N or S belongs "
            f"there, north or south of the equator, as in 'WGS84 UTM {number}N'"
        )
    return System(f"EPSG:{(32700 if letter == 'S' else 32600) + number}", False)


def _by_pyproj(text: str) -> System:
    shown = text if len(text) <= 60 else f"{text[:60]}..."
    try:
        found = CRS(text)
    except (ProjError, UnicodeEncodeError) as error:
        raise BadInput(
            f"{shown!r} is no coordinate reference system that pyproj knows; name one such as EPSG:32633, "
            "WGS84 UTM 33N or EPSG:4326"
        ) from error
    if not (found.is_geographic or found.is_projected or found.is_compound):
        raise BadInput(f"{shown!r} is neither in degrees nor a map; name one such as EPSG:32633 or EPSG:4326")
    code = found.to_epsg(min_confidence=100)  # with less it may be another one of a like name
    if code is not None and not found.is_compound:
        text = f"EPSG:{code}"
    return System(text, found.is_geographic)
