"""Pictures as data URIs that fit into a budget of bytes together."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from surfkit.apps.report.elements import EmbeddedPicture
from surfkit.core.check import BadInput

MAX_PICTURE_BYTES = 12_000_000
"""Bytes of all pictures of a page, as they stand in it."""
LONGEST_SIDES_PX = (1200, 960, 720, 540, 400)
"""Longest sides in pixels; the first at which all pictures fit is taken."""
UNREADABLE = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)
"""What Pillow raises for files that are no pictures."""
WEBP_QUALITY = 82
"""Of WebP, 0 to 100."""


@dataclass(frozen=True)
class Encoded:
    """A picture as the page holds it: its data URI, and its size in pixels."""

    uri: str
    width: int
    height: int


def encode_all(pictures: Iterable[EmbeddedPicture], budget: int = MAX_PICTURE_BYTES) -> dict[EmbeddedPicture, Encoded]:
    """Every picture, no larger than it is and as large as the budget allows.

    Raises:
        BadInput: They do not fit at the least size, or a file is no picture.
    """
    wanted = list(dict.fromkeys(pictures))
    for side in LONGEST_SIDES_PX:
        found, left = {}, budget
        for picture in wanted:
            found[picture] = encode(picture, side)
            left -= len(found[picture].uri)
            if left < 0:
                break
        else:
            return found
    raise BadInput(
        f"report: {len(wanted)} pictures take more than {budget / 1e6:.3g} MB even at {LONGEST_SIDES_PX[-1]} pixels; "
        f"lower "
        "--views, name fewer runs, or give --no-pictures"
    )


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture, pixels.

    Raises:
        BadInput: The file is no picture.
    """
    try:
        with Image.open(path) as image:
            return image.size
    except UNREADABLE as error:
        raise BadInput(f"{path}: cannot be read as a picture ({error}); delete it") from error


def encode(picture: EmbeddedPicture, side: int) -> Encoded:
    """A picture as WebP, reduced to a longest side.

    Raises:
        BadInput: The file is no picture.
    """
    try:
        with Image.open(picture.path) as file:
            image = file.convert("RGB").crop(picture.box) if picture.box else file.convert("RGB")
    except UNREADABLE as error:
        raise BadInput(f"{picture.path}: cannot be read as a picture ({error}); delete it") from error
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "WEBP", quality=WEBP_QUALITY, method=4)
    return Encoded(f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}", *image.size)
