"""JPEG files without the marker at their end, as copying or transmission sometimes leaves them."""

from __future__ import annotations

import io
import threading
from pathlib import Path

import numpy as np

from surfkit.core.events import Warned, emit
from surfkit.scene.large_photos import open_image

EOI_MARKER = b"\xff\xd9"
"""The marker EOI, which ends a JPEG file."""
MISSING_PIXEL_BYTES = b"\xa5\x5a" * 512
"""What would become pixels if some were missing."""
_WARNING_LOCK, _told = threading.Lock(), [False]


def with_end(path: Path) -> bytes | None:
    """The bytes of a JPEG file whose picture is whole and lacks but its end, with this; None if more is missing.

    A decoder takes missing pixels for grey and says nothing. So the file is decoded twice, with bytes that mean nothing
    after it and without: if pixels are missing, these become some.
    """
    data = path.read_bytes()
    if data.endswith(EOI_MARKER):
        return None
    data = data[:-1] if data.endswith(EOI_MARKER[:1]) else data
    plain, marked = (_pixels(data + more + EOI_MARKER) for more in (b"", MISSING_PIXEL_BYTES))
    if not np.array_equal(plain, marked):
        return None
    return data + EOI_MARKER


def tell(path: Path) -> None:
    """Say, once, that such files are read."""
    with _WARNING_LOCK:
        told, _told[0] = _told[0], True
    if not told:
        emit(
            Warned(
                f"{path}: a JPEG file without its end (the marker EOI), of which no pixel is missing: it is read, as "
                "are others of this kind; if it was copied, copy it again"
            )
        )


def _pixels(data: bytes) -> np.ndarray:
    with open_image(io.BytesIO(data)) as image:
        return np.asarray(image)
