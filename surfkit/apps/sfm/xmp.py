"""What drones and cameras write into XMP: position, height above the start, how exact they are; and panoramas."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

FIELD_PATTERN = re.compile(r"([A-Za-z][\w.-]*):(\w+)(?:\s*=\s*[\"']|>)\s*([^\"'<>]*?)\s*(?=[\"'<])")
"""Prefix, name and value, as an attribute or an element."""
ANGLE_PATTERN = re.compile(
    r"([-+]?)(\d+(?:\.\d*)?)(?:,(\d+(?:\.\d*)?))?(?:,(\d+(?:\.\d*)?))?\s*([NSEW]?)", re.IGNORECASE
)
"""Signed degrees as DJI writes them, "+52.1"; degrees and minutes, or seconds too, and a letter as in the standard:
"52,6.5N", "52,6,30N"."""
DRONES = ("drone-dji", "Camera")
"""Prefixes of DJI, and of Pix4D's convention that Parrot, senseFly and others follow: all their numbers are kept."""
LATITUDE, LONGITUDE, ALTITUDE, ABOVE_START = "latitude", "longitude", "altitude", "above start"
"""Names under which positions are kept, degrees and metres."""
ELLIPSOIDAL = "ellipsoidal"
"""Name under which it is kept what `VertCS` of Pix4D's convention says heights are above: 1 the ellipsoid, 0 sea
level."""
VERTICAL_SYSTEMS = {
    **dict.fromkeys(("ellipsoidal", "ellipsoid", "wgs84", "epsg:4979", "epsg:7030"), 1.0),
    **dict.fromkeys(("orthometric", "egm84", "egm96", "egm2008", "epsg:5798", "epsg:5773", "epsg:3855"), 0.0),
}
FIELD_NAMES = {
    "gpslatitude": LATITUDE,
    "gpslongitude": LONGITUDE,
    "gpslongtitude": LONGITUDE,  # of older DJI drones
    "absolutealtitude": ALTITUDE,
    "gpsaltitude": ALTITUDE,
    "relativealtitude": ABOVE_START,
}
"""By the name in small letters, under any prefix: drone-dji, drone (Autel), drone-parrot, exif and others."""
DRONE_FIELD_NAMES = {"latitude": LATITUDE, "longitude": LONGITUDE}
"""Names that count under a prefix of a drone only, as Skydio's."""
PANORAMA_PROJECTIONS = ("equirectangular", "cylindrical")
"""Projections of photographs that no lens takes, as GPano:ProjectionType names them."""
MAX_FIELD_VALUES = {LATITUDE: 90.0, LONGITUDE: 180.0, ALTITUDE: 1e5, ABOVE_START: 1e5}


def read_xmp(packet: bytes | str | None) -> dict[str, float]:
    """The numbers of an XMP packet that say something of a position, by name; what is damaged counts as not said."""
    fields = _fields(packet)
    below = any(name.lower() == "gpsaltituderef" and value in ("1", "3") for _, name, value in fields)
    found: dict[str, float] = {}
    for prefix, name, value in fields:
        small = name.lower()
        if prefix in DRONES and (number := _number(value)) is not None:
            found[name] = number
        if prefix in DRONES and small == "vertcs" and (zero := VERTICAL_SYSTEMS.get(value.lower())) is not None:
            found[ELLIPSOIDAL] = zero
        what = FIELD_NAMES.get(small) or (DRONE_FIELD_NAMES.get(small) if prefix.startswith("drone") else None)
        if what is None or (what == ALTITUDE and small == "gpsaltitude" and ALTITUDE in found):
            continue
        read: Callable[[str], float | None] = _angle if what in (LATITUDE, LONGITUDE) else _fraction
        if (number := read(value)) is not None and abs(number) <= MAX_FIELD_VALUES[what]:
            found[what] = -abs(number) if what == ALTITUDE and small == "gpsaltitude" and below else number
    return found


def panorama_kind(packet: bytes | str | None) -> str | None:
    """The projection of a panorama by its XMP packet, one of `PANORAMA_PROJECTIONS`; None for a photograph of a
    lens."""
    said = [value.lower() for _, name, value in _fields(packet) if name == "ProjectionType"]
    return said[0] if said and said[0] in PANORAMA_PROJECTIONS else None


def _fields(packet: bytes | str | None) -> list[tuple[str, str, str]]:
    """Prefix, name and value of each field of a packet."""
    text = packet or ""
    return FIELD_PATTERN.findall(text if isinstance(text, str) else text.decode("utf-8", "replace"))


def _angle(text: str) -> float | None:
    """Degrees, or None; without a sign or a letter only a decimal number has one."""
    if not (found := ANGLE_PATTERN.fullmatch(text)):
        return None
    sign, degrees, minutes, seconds, letter = found.groups()
    if minutes is not None and not (letter or sign):
        return None
    value = float(degrees) + float(minutes or 0) / 60 + float(seconds or 0) / 3600
    return -value if sign == "-" or letter.upper() in ("S", "W") else value


def _fraction(text: str) -> float | None:
    above, _, below = text.partition("/")
    number, parts = _number(above), _number(below or "1")
    return number / parts if number is not None and parts else None


def _number(text: str) -> float | None:
    try:
        found = float(text)
    except ValueError:
        return None
    return found if math.isfinite(found) else None
