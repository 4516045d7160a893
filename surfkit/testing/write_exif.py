"""EXIF written into JPEG files as cameras do, for tests: the pixels stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from surfkit.apps.sfm.exif import (
    ALTITUDE_REF_TAG,
    ALTITUDE_TAG,
    EXIF_IFD,
    GPS_IFD,
    LATITUDE_REF_TAG,
    LATITUDE_TAG,
    LONGITUDE_REF_TAG,
    LONGITUDE_TAG,
)

RATIONAL_DENOMINATOR = 10**7
"""Parts of a second of arc and of a metre."""


def write_exif(
    path: Path,
    position: tuple[float, float, float] | None = None,
    basic: Mapping[int, Any] | None = None,
    camera: Mapping[int, Any] | None = None,
    gps: Mapping[int, Any] | None = None,
) -> None:
    """Write EXIF into a JPEG file.

    Args:
        path: The file, which has none.
        position: Latitude and longitude in degrees and altitude in metres.
        basic: Tags of the first part, by number.
        camera: Tags of the part of the camera.
        gps: Tags of the part of GPS, besides those of the position.
    """
    tags = Image.Exif()
    tags.update(basic or {})
    tags.get_ifd(EXIF_IFD).update(camera or {})
    place = tags.get_ifd(GPS_IFD)
    if position is not None:
        latitude, longitude, altitude = position
        place[LATITUDE_REF_TAG], place[LATITUDE_TAG] = "N" if latitude >= 0 else "S", _parts(latitude)
        place[LONGITUDE_REF_TAG], place[LONGITUDE_TAG] = "E" if longitude >= 0 else "W", _parts(longitude)
        place[ALTITUDE_REF_TAG] = b"\x01" if altitude < 0 else b"\x00"
        place[ALTITUDE_TAG] = IFDRational(round(abs(altitude) * 1000), 1000)
    place.update(gps or {})
    block = tags.tobytes()
    block = block if block.startswith(b"Exif\0\0") else b"Exif\0\0" + block
    picture = path.read_bytes()
    path.write_bytes(picture[:2] + b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block + picture[2:])


def _parts(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Degrees, minutes and seconds."""
    total = round(abs(degrees) * 3600 * RATIONAL_DENOMINATOR)
    minutes, seconds = divmod(total, 60 * RATIONAL_DENOMINATOR)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(seconds, RATIONAL_DENOMINATOR)
