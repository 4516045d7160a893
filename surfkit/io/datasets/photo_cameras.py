"""Which camera took each photograph of a data set."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

from surfkit.io.datasets.raw_dataset import RawImage
from surfkit.scene.photos import read_exif_tags

EXIF_IFD = 0x8769
MAKE_TAG, MODEL_TAG, FOCAL_MM_TAG, BODY_SERIAL_TAG, LENS_SERIAL_TAG = 0x010F, 0x0110, 0x920A, 0xA431, 0xA435
"""Tags of EXIF."""
FULL_FOLDER = re.compile(r"[1-9]\d\d[A-Z0-9_]{5}")
"""Name of a folder as cameras number them (DCF): they begin a new one, such as 101MEDIA, when one is full."""


def cameras_of(shots: Sequence[RawImage]) -> list[str]:
    """A name for the camera of each photograph: photographs of one camera, with one lens, have the same.

    By EXIF: make, model, serial numbers of body and lens, focal length. Without a serial number, equal cameras are told
    apart by the folder of the photographs; numbered ones beside one another, as 100MEDIA and 101MEDIA, are one. Without
    make and model, by the folder and the data set's own camera; where that has a camera for each photograph, by the
    folder alone.
    """
    with ThreadPoolExecutor(4) as pool:
        words = list(pool.map(lambda shot: exif_words(shot.path), shots))
    folders = [_folder(shot.name) for shot in shots]
    numbers = {one: at + 1 for at, one in enumerate(dict.fromkeys(id(shot.camera) for shot in shots))}
    there: dict[str, Counter[int]] = defaultdict(Counter)
    for shot, folder in zip(shots, folders, strict=True):
        there[folder][id(shot.camera)] += 1
    found = []
    for shot, (exif, has_serial), folder in zip(shots, words, folders, strict=True):
        place = "" if folder == "." else f"in {folder}/"
        is_shared = len(there[folder]) == 1 or max(there[folder].values()) > 1
        own = exif or (f"camera {numbers[id(shot.camera)]}" if is_shared else "")
        found.append(own if has_serial else f"{own} {place}".strip())
    return found


def _folder(name: str) -> str:
    """The folder of a photograph, or the one above where a camera fills one after the other."""
    folder = PurePosixPath(name.replace("\\", "/")).parent
    return (folder.parent if FULL_FOLDER.fullmatch(folder.name) else folder).as_posix()


def exif_words(path: Path) -> tuple[str, bool]:
    """What EXIF says of the camera and lens of a photograph, empty without make and model; whether with a serial
    number. What is damaged counts as not said."""
    basic, more = read_exif_tags(path, EXIF_IFD)
    made = [_text(basic.get(tag)) for tag in (MAKE_TAG, MODEL_TAG)]
    serial = [_text(more.get(tag)) for tag in (BODY_SERIAL_TAG, LENS_SERIAL_TAG)]
    if not any(made):
        return "", False
    try:
        focal = f"{float(more[FOCAL_MM_TAG]):.3g} mm"
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        focal = ""
    return " ".join(filter(None, [*made, *serial, focal])), any(serial)


def _text(value: object) -> str:
    return " ".join(value.replace("\0", " ").split()) if isinstance(value, str) else ""
