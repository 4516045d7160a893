"""What a camera or drone wrote into a photograph: lens, time, orientation, position and how exact it is."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from PIL import Image

from surfkit.apps.sfm import xmp as xmp_names
from surfkit.apps.sfm.xmp import read_xmp

# What is damaged counts as not said.
warnings.filterwarnings("ignore", message="Corrupt EXIF", category=UserWarning)
EXIF_IFD, GPS_IFD = 0x8769, 0x8825
MAKE_TAG, MODEL_TAG, ORIENTATION_TAG = 0x010F, 0x0110, 0x0112
TAKEN_TAG, SUBSECOND_TAG, FOCAL_MM_TAG, FOCAL35_MM_TAG = 0x9003, 0x9291, 0x920A, 0xA405
BODY_SERIAL_TAG, LENS_SERIAL_TAG = 0xA431, 0xA435
"""Serial numbers."""
PIXELS_X_TAG, PER_UNIT_X_TAG, UNIT_TAG = 0xA002, 0xA20E, 0xA210
LATITUDE_REF_TAG, LATITUDE_TAG, LONGITUDE_REF_TAG, LONGITUDE_TAG, ALTITUDE_REF_TAG, ALTITUDE_TAG, ERROR_M_TAG = (
    1,
    2,
    3,
    4,
    5,
    6,
    31,
)
UNIT_MM = {2: 25.4, 3: 10.0}
"""Of the focal plane's resolution: inch, centimetre."""
DIAGONAL35_MM = math.hypot(36, 24)
"""Equivalent focal lengths compare angles along the diagonal (CIPA DCG-001)."""
WIDE_ASPECT, SMALL_SENSOR_FACTOR = 1.7, 3.5
"""From this aspect ratio on, a photograph is taken for a crop of the sensor, whose diagonal the equivalent focal length
is of: cameras keep it when they are set to 16:9. Sensors of 1/1.7 inch and less, which shorten it more than so many
times, are 4:3, larger ones 3:2."""
LIKELY_FOCAL_RANGE = (0.1, 10.0)
"""Focal lengths over the longer side that COLMAP's mapper accepts: beyond them a tag is wrong, as one of 72 dpi."""
MAX_ERROR_M = 1e4
"""An accuracy beyond it is no accuracy."""
MAX_SPEED_M = 100.0
"""No drone that takes photographs is faster, m/s."""
ABOVE_REFERENCES, BELOW_REFERENCES = (0, 2), (1, 3)
"""References of altitudes, see `_zero`."""
SEA_LEVEL_REFERENCES = (2, 3)
EXIF_VERSION_TAG = 36864
"""Tag of the version of EXIF: 0232, 0300."""
RTK_FLAG = "RtkFlag"
"""In XMP of DJI: 0 without RTK; 16, 34 or 50 where the position is of that receiver."""
Zero = Literal["sea level", "ellipsoid"]

Position = tuple[float, float, float | None]
"""Latitude and longitude, degrees on WGS 84, and altitude, metres; None where it is not known."""


@dataclass(frozen=True)
class Exif:
    """Facts of a photograph; None where it does not say.

    Attributes:
        camera: Make and model.
        serial: Serial numbers of body and lens, and the number in a rig: which one of several equal cameras it is.
        taken: Time, "2024:05:01 12:00:00.25", which sorts by time.
        orientation: 1 to 8, as EXIF numbers them; 1 is upright.
        focal_px: Focal length in pixels of the longer side's direction, at the size of the file.
        is_focal_held: Whether it was decided that the photographs have no say in it.
        position: Where it was taken, in EXIF; the altitude is as the file gives it.
        unsigned: Which of latitude and longitude have no letter of the hemisphere, so that their sign is not known; the
            position has them as positive.
        no_reference: Whether nothing says if the altitude is above or below its zero; it is taken as above.
        zero: What the altitude is counted from, by EXIF and XMP; None without one, or where it is from elsewhere.
        xmp_position: Where it was taken, in XMP.
        xmp_altitude: Altitude in XMP, metres, also where XMP has no position.
        above_start: Height above the place of the start in XMP, metres.
        accuracy_m: Standard deviations east, north and up, metres, of a receiver that states them (RTK).
        speed: Of the drone when it was taken, m/s, by XMP.
    """

    camera: str | None = None
    taken: str | None = None
    serial: str | None = None
    orientation: int = 1
    focal_px: float | None = None
    is_focal_held: bool = False
    position: Position | None = None
    unsigned: tuple[str, ...] = ()
    no_reference: bool = False
    zero: Zero | None = None
    xmp_position: Position | None = None
    xmp_altitude: float | None = None
    above_start: float | None = None
    accuracy_m: tuple[float, float, float] | None = None
    speed: float | None = None

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
    return facts(basic, camera, gps, read_xmp(image.info.get("xmp")), size)


def facts(
    basic: Mapping[int, Any],
    camera: Mapping[int, Any],
    gps: Mapping[int, Any],
    xmp: Mapping[str, float],
    size: tuple[int, int],
) -> Exif:
    """The facts in the tags of the three parts of EXIF and in the numbers of XMP."""
    names = [_text(basic.get(tag)) for tag in (MAKE_TAG, MODEL_TAG)]
    taken = _text(camera.get(TAKEN_TAG))
    part = _text(camera.get(SUBSECOND_TAG))
    turned = basic.get(ORIENTATION_TAG, 1)
    position, unsigned = _position(gps)
    return Exif(
        camera=" ".join(filter(None, names)) or None,
        serial=_serial(camera, xmp),
        taken=f"{taken}.{part}" if taken and part else taken,
        orientation=int(turned) if turned in range(1, 9) else 1,
        focal_px=_focal_px(camera, size),
        position=position,
        unsigned=unsigned,
        no_reference=position is not None and position[2] is not None and _reference(gps) is None,
        zero=_zero(gps, camera, xmp),
        xmp_position=_xmp_position(xmp),
        xmp_altitude=xmp.get(xmp_names.ALTITUDE),
        above_start=xmp.get(xmp_names.ABOVE_START),
        accuracy_m=_accuracy(gps, xmp),
        speed=_speed(xmp),
    )


def _serial(tags: Mapping[int, Any], xmp: Mapping[str, float]) -> str | None:
    found = [*(_text(tags.get(tag)) for tag in (BODY_SERIAL_TAG, LENS_SERIAL_TAG)), xmp.get("RigCameraIndex")]
    return " ".join(str(part) for part in found if part is not None) or None


def _focal_px(tags: Mapping[int, Any], size: tuple[int, int]) -> float | None:
    focal, equivalent = _number(tags.get(FOCAL_MM_TAG)), _number(tags.get(FOCAL35_MM_TAG))
    if equivalent:
        found = equivalent / DIAGONAL35_MM * _sensor_diagonal(size, equivalent / focal if focal else None)
        if _is_likely(found, size):
            return found
    density, unit = _number(tags.get(PER_UNIT_X_TAG)), UNIT_MM.get(tags.get(UNIT_TAG, 2))
    width = _number(tags.get(PIXELS_X_TAG))
    if not (focal and density and unit and width):
        return None
    sensor_mm = width / density * unit  # of the direction that was the width when the photograph was taken
    found = focal / sensor_mm * max(size)
    return found if _is_likely(found, size) else None


def _sensor_diagonal(size: tuple[int, int], factor: float | None) -> float:
    """Diagonal of the sensor in pixels of a photograph; `factor` is the ratio of equivalent and real focal length."""
    longer, shorter = max(size), min(size)
    if longer >= WIDE_ASPECT * shorter and factor is not None:
        shorter = round(longer * (3 / 4 if factor > SMALL_SENSOR_FACTOR else 2 / 3))
    return math.hypot(longer, shorter)


def _is_likely(focal_px: float, size: tuple[int, int]) -> bool:
    return LIKELY_FOCAL_RANGE[0] < focal_px / max(size) < LIKELY_FOCAL_RANGE[1]


def _position(tags: Mapping[int, Any]) -> tuple[Position | None, tuple[str, ...]]:
    """The position, and which of latitude and longitude have no sign."""
    latitude, north = _degrees(tags.get(LATITUDE_TAG), tags.get(LATITUDE_REF_TAG), "N", "S", 90)
    longitude, east = _degrees(tags.get(LONGITUDE_TAG), tags.get(LONGITUDE_REF_TAG), "E", "W", 180)
    if latitude is None or longitude is None or (latitude, longitude) == (0, 0):  # a receiver without a fix
        return None, ()
    altitude = _number(tags.get(ALTITUDE_TAG), negative=True)
    if altitude is not None and _reference(tags) in BELOW_REFERENCES:
        altitude = -abs(altitude)
    unsigned = tuple(name for name, known in (("latitude", north), ("longitude", east)) if not known)
    return (latitude, longitude, altitude), unsigned


def _degrees(value: Any, letter: Any, positive: str, negative: str, most: float) -> tuple[float | None, bool]:
    """Degrees, and whether their sign is known: by the letter, or as they are below 0. They are degrees, minutes and
    seconds, or fewer of these."""
    try:
        parts = [float(part) for part in (value if isinstance(value, (tuple, list)) else (value,))]
    except (TypeError, ValueError, ZeroDivisionError):
        return None, False
    if not 1 <= len(parts) <= 3:
        return None, False
    found = sum(abs(part) / 60**at for at, part in enumerate(parts))
    if not (math.isfinite(found) and found <= most):
        return None, False
    half, below = (_text(letter) or "")[:1].upper(), parts[0] < 0
    if half == negative or (below and half != positive):
        return -found, True
    return found, half == positive and not below


def _reference(tags: Mapping[int, Any]) -> int | None:
    """What the altitude is counted from; None where that is not said."""
    value: Any = tags.get(ALTITUDE_REF_TAG)
    try:
        found = value[0] if isinstance(value, bytes) else int(value)
    except (TypeError, ValueError, IndexError):
        return None
    return found if found in (*ABOVE_REFERENCES, *BELOW_REFERENCES) else None


def _zero(gps: Mapping[int, Any], camera: Mapping[int, Any], xmp: Mapping[str, float]) -> Zero | None:
    """What altitudes are counted from.

    References 2 and 3 are the sea level. 0 and 1 were it until EXIF 3.0, which made them the ellipsoid. Drones with RTK
    write heights above the ellipsoid under the old 0, as there was no other; some say so in XMP, as VertCS.
    """
    if ALTITUDE_TAG not in gps and xmp_names.ALTITUDE not in xmp:
        return None
    reference = _reference(gps)
    if reference in SEA_LEVEL_REFERENCES:
        return "sea level"
    if (stated := xmp.get(xmp_names.ELLIPSOIDAL)) is not None:
        return "ellipsoid" if stated else "sea level"
    is_new = reference is not None and (_text(camera.get(EXIF_VERSION_TAG)) or "") >= "0300"
    return "ellipsoid" if is_new or xmp.get(RTK_FLAG, 0.0) > 0 else "sea level"


def _xmp_position(xmp: Mapping[str, float]) -> Position | None:
    latitude, longitude = xmp.get(xmp_names.LATITUDE), xmp.get(xmp_names.LONGITUDE)
    if latitude is None or longitude is None or (latitude, longitude) == (0, 0):
        return None
    return latitude, longitude, xmp.get(xmp_names.ALTITUDE)


def _accuracy(gps: Mapping[int, Any], xmp: Mapping[str, float]) -> tuple[float, float, float] | None:
    rtk = tuple(xmp.get(name, 0.0) for name in ("RtkStdLon", "RtkStdLat", "RtkStdHgt"))
    across, up = xmp.get("GPSXYAccuracy", 0.0), xmp.get("GPSZAccuracy", 0.0)
    stated = _number(gps.get(ERROR_M_TAG)) or 0.0
    for found in (rtk, (across, across, up), (stated, stated, 2 * stated)):  # heights are half as exact by GPS
        if all(0 < value < MAX_ERROR_M for value in found):
            return found  # type: ignore[return-value]
    return None


def _speed(xmp: Mapping[str, float]) -> float | None:
    """Of DJI's three speeds, whose axes are north, east and height; which way these count does not matter here."""
    parts = [xmp.get(name) for name in ("FlightXSpeed", "FlightYSpeed", "FlightZSpeed")]
    given = [part for part in parts if part is not None]
    found = math.hypot(*given) if len(given) == len(parts) else math.inf
    return found if found <= MAX_SPEED_M else None


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
