"""COLMAP's binary files, measured before pycolmap reads them: it would read beyond the end of one that is cut off.

All of them begin with the number of their entries, as 8 bytes, little-endian.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput

MIN_ENTRY_BYTES = {"cameras": 40, "images": 73, "points3D": 51}
"""The files of a model, and the fewest bytes that an entry of the binary one takes."""
MIN_RIG_ENTRY_BYTES = {"rigs": 8, "frames": 68}
"""Further files of models with rigs."""
SPOT = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
"""What images.bin has of a place in an image, in pixels, and the number of the sparse point that is seen there."""
POSE_BYTES = 56
"""Bytes of a rotation and a translation."""


def refuse_cut_off(folder: Path) -> None:
    """BadInput where binary files of a model end before their entries do."""
    cut = []
    for part, least in (MIN_ENTRY_BYTES | MIN_RIG_ENTRY_BYTES).items():
        path = folder / f"{part}.bin"
        if part in MIN_RIG_ENTRY_BYTES and not path.is_file():
            continue
        size = path.stat().st_size
        with path.open("rb") as file:
            count = struct.unpack("<Q", file.read(8))[0] if size >= 8 else 1
            whole = size >= 8 + count * least
            if whole and count and part in ENTRY_READERS:
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
                    whole = _whole(raw, count, ENTRY_READERS[part])
        if not whole:
            cut.append(path)
    if cut:
        raise cut_off(*cut)


def spots_of_images(path: Path) -> dict[int, np.ndarray]:
    """(K,) `SPOT` by the number of the image, of a whole images.bin: millions, of which pycolmap makes objects."""
    raw, found, at = path.read_bytes(), {}, 8
    for _ in range(_LONG(raw, 0)[0]):
        name = raw.index(b"\0", at + 64)
        count = _LONG(raw, name + 1)[0]
        found[_SHORT(raw, at)[0]] = np.frombuffer(raw, SPOT, count, name + 9)
        at = name + 9 + SPOT.itemsize * count
    return found


def cut_off(path: Path, *others: Path) -> BadInput:
    """What is said of a file that ends too early, and of others that do."""
    also = f" (and so are {', '.join(other.name for other in others)})" if others else ""
    return BadInput(f"{path}: the file is cut off or no COLMAP file{also}; copy it whole")


def _whole(raw: mmap.mmap, count: int, end: Callable[[mmap.mmap, int], int]) -> bool:
    """Whether all entries end before the file does; `end` tells where the one ends that begins at a byte."""
    at, size = 8, len(raw)
    try:
        for _ in range(count):
            at = end(raw, at)
            if at > size:
                return False
    except struct.error:  # a number that `end` needs is beyond the end
        return False
    return True


def _image(raw: mmap.mmap, at: int) -> int:
    """64 bytes, a name that ends in 0, and a number of observations of 24 bytes."""
    name = raw.find(b"\0", at + 64)
    return len(raw) + 1 if name < 0 else name + 9 + 24 * _LONG(raw, name + 1)[0]


def _point(raw: mmap.mmap, at: int) -> int:
    """43 bytes, and a number of observations of 8 bytes."""
    return at + 51 + 8 * _LONG(raw, at + 43)[0]


def _rig(raw: mmap.mmap, at: int) -> int:
    """8 bytes that end in the number of sensors; 8 bytes for the first of them, 9 and maybe a pose for all others."""
    count = _SHORT(raw, at + 4)[0]
    if at + 9 * count > len(raw) + 1:
        return len(raw) + 1
    at += 8 + 8 * (count > 0)
    for _ in range(count - 1):
        at += 9 + (POSE_BYTES if raw[at + 8 : at + 9] != b"\0" else 0)
    return at


def _frame(raw: mmap.mmap, at: int) -> int:
    """64 bytes, and a number of pictures of 16 bytes."""
    return at + 68 + 16 * _SHORT(raw, at + 64)[0]


_LONG, _SHORT = struct.Struct("<Q").unpack_from, struct.Struct("<I").unpack_from
ENTRY_READERS = {"images": _image, "points3D": _point, "rigs": _rig, "frames": _frame}
"""Of the files whose entries differ in length; those of cameras are known when they are read."""
