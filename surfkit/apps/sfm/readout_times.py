"""How long cameras take to read a photograph, from its first row to its last: what is known from sources.

Readout times differ between drones that are otherwise alike, and between the formats of one camera. So the list has
only what somebody has measured and published, each with its source; all other cameras are estimated from their
photographs.
"""

from __future__ import annotations

from dataclasses import dataclass

from surfkit.apps.sfm.inspect_photos import Photo


@dataclass(frozen=True)
class Readout:
    """A readout time.

    Attributes:
        ms: From the first row to the last, milliseconds; negative where the last row is read first.
        source: Whence it is known.
    """

    ms: float
    source: str


ZHOU = "Y. Zhou, github.com/micmacIGN/micmac/issues/142"
LED = "measured with a blinking LED, github.com/OpenDroneMap/ODM/pull/"
READOUT_TIMES: dict[str, dict[tuple[int, int] | None, Readout]] = {
    "dji fc220": {None: Readout(64, f"{LED}1568")},  # Mavic Pro, Mavic Pro Platinum
    "dji fc2103": {None: Readout(32, f"{LED}1574")},  # Mavic Air
    "dji fc8482": {  # Mini 4 Pro
        (8064, 6048): Readout(58, f"{LED}1859"),
        (8064, 4536): Readout(43, f"{LED}1859"),
        (4032, 3024): Readout(21, f"{LED}1859"),
        (4032, 2268): Readout(16, f"{LED}1859"),
    },
    # Mavic 2 Pro. 47 lines of an LED in its 3078 rows (pull request 1524) are 55.7 ms in 3648 rows; topodrone.com has
    # 62 ms.
    "hasselblad l1d-20c": {(5472, 3648): Readout(56, ZHOU), (5472, 3078): Readout(47, f"{LED}1524")},
    "yuneec e90": {None: Readout(44, f"{LED}1520")},  # H520
}
"""By make and model in EXIF, in small letters, and by width and height; None for all sizes."""


def known_readout(photo: Photo) -> Readout | None:
    """What is known of the camera of a photograph, at its size; None where nothing is."""
    sizes = READOUT_TIMES.get((photo.exif.camera or "").lower(), {})
    return sizes.get(photo.size, sizes.get(None))
