"""What a camera or drone wrote into a photograph: lens, time, orientation, position and how exact it is."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import Image

# What is damaged counts as not said.
warnings.filterwarnings("ignore", message="Corrupt EXIF", category=UserWarning)
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
MAKE, MODEL, ORIENTATION = 0x010F, 0x0110, 0x0112
TAKEN, SUBSECOND, FOCAL_MM, FOCAL35_MM = 0x9003, 0x9291, 0x920A, 0xA405
BODY, LENS = 0xA431, 0xA435
"""Serial numbers."""
PIXELS_X, PER_UNIT_X, UNIT = 0xA002, 0xA20E, 0xA210
LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, ALTITUDE_REF, ALTITUDE, ERROR_M = 1, 2, 3, 4, 5, 6, 31
UNIT_MM = {2: 25.4, 3: 10.0}
"""Of the focal plane's resolution: inch, centimetre."""
DIAGONAL35_MM = math.hypot(36, 24)
"""Equivalent focal lengths compare angles along the diagonal (CIPA DCG-001)."""
LIKELY = (0.1, 10.0)
"""Focal lengths over the longer side that COLMAP's mapper accepts: beyond them a tag is wrong, as one of 72 dpi."""
XMP = re.compile(r"(?:drone-dji|Camera):(\w+)(?:=[\"']|>)\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)(?=\s*[\"'<])")
"""Numbers that DJI, and cameras by Pix4D's convention, write into XMP, as attributes or elements."""
MOST_ERROR_M = 1e4
"""An accuracy beyond it is no accuracy."""


@dataclass(frozen=True)
class Exif:
    """Facts of a photograph; None where it does not say.

    Attributes:
        camera: Make and model.
        serial: Serial numbers of body and lens, and the number in a rig: which one of several equal cameras it is.
        taken: Time, "2024:05:01 12:00:00.25", which sorts by time.
        orientation: 1 to 8, as EXIF numbers them; 1 is upright.
        focal_px: Focal length in pixels of the longer side's direction, at the size of the file.
        position: Latitude and longitude in degrees on WGS 84, and altitude in metres as the file gives it.
        accuracy_m: Standard deviations east, north and up, metres, of a receiver that states them (RTK).
    """

    camera: str | None = None
    taken: str | None = None
    serial: str | None = None
    orientation: int = 1
    focal_px: float | None = None
    position: tuple[float, float, float] | None = None
    accuracy_m: tuple[float, float, float] | None = None

    @property
    def which(self) -> str | None:
        """Make and model, and which of several equal cameras it is."""
        return self.camera if self.serial is None else f"{self.camera} {self.serial}"


def read_exif(image: Image.Image, size: tuple[int, int]) -> Exif:
    """What an open picture says of itself; what is damaged in it counts as not said.

    Args:
        image: Of Pillow; its pixels are not decoded.
        size: Width and height of the file.
    """
    try:
        tags = image.getexif()
        basic, camera, gps = dict(tags), dict(tags.get_ifd(EXIF_IFD)), dict(tags.get_ifd(GPS_IFD))
    except Exception:  # Pillow raises whatever the bytes of a damaged block lead to
        basic, camera, gps = {}, {}, {}
    return facts(basic, camera, gps, _xmp(image.info.get("xmp")), size)


def facts(
    basic: Mapping[int, Any],
    camera: Mapping[int, Any],
    gps: Mapping[int, Any],
    xmp: Mapping[str, float],
    size: tuple[int, int],
) -> Exif:
    """The facts in the tags of the three parts of EXIF and in the numbers of XMP."""
    names = [_text(basic.get(tag)) for tag in (MAKE, MODEL)]
    taken = _text(camera.get(TAKEN))
    part = _text(camera.get(SUBSECOND))
    turned = basic.get(ORIENTATION, 1)
    return Exif(
        camera=" ".join(filter(None, names)) or None,
        serial=_serial(camera, xmp),
        taken=f"{taken}.{part}" if taken and part else taken,
        orientation=int(turned) if turned in range(1, 9) else 1,
        focal_px=_focal_px(camera, size),
        position=_position(gps),
        accuracy_m=_accuracy(gps, xmp),
    )


def _serial(tags: Mapping[int, Any], xmp: Mapping[str, float]) -> str | None:
    found = [*(_text(tags.get(tag)) for tag in (BODY, LENS)), xmp.get("RigCameraIndex")]
    return " ".join(str(part) for part in found if part is not None) or None


def _focal_px(tags: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    focal, equivalent = _number(tags.get(FOCAL_MM)), _number(tags.get(FOCAL35_MM))
    if equivalent and _is_likely(found := equivalent / DIAGONAL35_MM * math.hypot(*size), size):
        return found
    density, unit = _number(tags.get(PER_UNIT_X)), UNIT_MM.get(tags.get(UNIT, 2))
    width = _number(tags.get(PIXELS_X))
    if not (focal and density and unit and width):
        return None
    sensor_mm = width / density * unit  # of the direction that was the width when the photograph was taken
    found = focal / sensor_mm * max(size)
    return found if _is_likely(found, size) else None


def _is_likely(focal_px: float, size: tuple[int, int]) -> bool:
    return LIKELY[0] < focal_px / max(size) < LIKELY[1]


def _position(tags: Mapping[int, Any]) -> tuple[float, float, float] | None:
    latitude = _degrees(tags.get(LATITUDE), tags.get(LATITUDE_REF), "S", 90)
    longitude = _degrees(tags.get(LONGITUDE), tags.get(LONGITUDE_REF), "W", 180)
    altitude = _number(tags.get(ALTITUDE), negative=True)
    if latitude is None or longitude is None or altitude is None or (latitude, longitude) == (0, 0):
        return None
    below = tags.get(ALTITUDE_REF) in (1, b"\x01", 3, b"\x03")  # sea level; the ellipsoid, from EXIF 3.0 on
    return latitude, longitude, -altitude if below else altitude


def _degrees(value: Any, half: Any, negative: str, most: float) -> float | None:
    try:
        degrees, minutes, seconds = (float(part) for part in value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    found = degrees + minutes / 60 + seconds / 3600
    if not (math.isfinite(found) and abs(found) <= most):
        return None
    return -found if (_text(half) or "").upper().startswith(negative) else found


def _accuracy(gps: Mapping[int, Any], xmp: Mapping[str, float]) -> tuple[float, float, float] | None:
    rtk = tuple(xmp.get(name, 0.0) for name in ("RtkStdLon", "RtkStdLat", "RtkStdHgt"))
    across, up = xmp.get("GPSXYAccuracy", 0.0), xmp.get("GPSZAccuracy", 0.0)
    stated = _number(gps.get(ERROR_M)) or 0.0
    for found in (rtk, (across, across, up), (stated, stated, 2 * stated)):  # heights are half as exact by GPS
        if all(0 < value < MOST_ERROR_M for value in found):
            return found  # type: ignore[return-value]
    return None


def _xmp(packet: bytes | str | None) -> dict[str, float]:
    """The numbers of an XMP packet that say something of a position, by name."""
    if not packet:
        return {}
    text = packet if isinstance(packet, str) else packet.decode("utf-8", "replace")
    found = {}
    for name, value in XMP.findall(text):
        if (number := _number(value, negative=True)) is not None:
            found[name] = number
    return found


def _number(value: Any, negative: bool = False) -> float | None:
    """A finite number, or None; 0 and less count only if `negative`."""
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return found if math.isfinite(found) and (negative or found > 0) else None


def _text(value: Any) -> str | None:
    if isinstance(value, bytes):
        value = value.decode("ascii", "replace")
    return value.strip("\0 ") or None if isinstance(value, str) else None
