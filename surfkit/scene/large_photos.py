"""Photographs that are too large for the memory of the machine, whatever made them so."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from PIL import Image

from surfkit.core.check import BadInput
from surfkit.core.memory import size as in_words
from surfkit.scene.available_memory import free_bytes

MEGAPIXELS_VARIABLE = "SURFKIT_MAX_MEGAPIXELS"
"""Environment variable: the most million pixels of a photograph that is decoded, whatever memory there is."""
MAX_UNCHECKED_PIXELS = 178_956_970
"""Pixels up to which memory is not asked about: where Pillow begins to refuse by itself."""
DECODE_MEMORY_SHARE = 0.8
"""Share of the free memory that decoding one photograph may take."""
DECODED_PIXEL_BYTES, OPACITY_PIXEL_BYTES, GREY16_PIXEL_BYTES, RGB16_PIXEL_BYTES = 8, 16, 12, 40
"""Bytes per pixel while a photograph is decoded and converted: of 8 bits, with an opacity, of 16 bits grey or RGB."""
RESULT_PIXEL_BYTES = 10
"""Bytes per pixel of the result, with what reducing it takes."""
_LIMIT_LOCK = threading.Lock()
_within: list[int | None] = []
"""What Pillow's own limit was, once for each that has put it away."""


@contextmanager
def any_size() -> Iterator[None]:
    """Within, Pillow refuses no size by itself, also in other threads: whoever decodes asks `refuse_too_large`."""
    with _LIMIT_LOCK:
        _within.append(_within[0] if _within else Image.MAX_IMAGE_PIXELS)
        Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        with _LIMIT_LOCK:
            limit = _within.pop()
            if not _within:
                Image.MAX_IMAGE_PIXELS = limit


def open_image(file: Path | IO[bytes]) -> Image.Image:
    """A picture of any size, whose header is read."""
    try:
        return Image.open(file)
    except Image.DecompressionBombError:
        with any_size():
            return Image.open(file)


def refuse_too_large(path: Path, shape: tuple[int, int], per_pixel: int, made: int = 0) -> None:
    """BadInput for a photograph that the memory does not hold, or that is above the limit of the user.

    Args:
        path: The file.
        shape: Width and height that it is decoded at.
        per_pixel: Bytes that this takes.
        made: Pixels of the result.
    """
    pixels, limit = shape[0] * shape[1], _limit()
    what = f"{path}: {shape[0]:,} x {shape[1]:,} px ({pixels / 1e6:,.0f} megapixels)"
    if limit is not None and pixels > limit * 1e6:
        raise BadInput(
            f"{what} is more than the limit {MEGAPIXELS_VARIABLE}={limit:g}; raise it, or reduce the photograph"
        )
    if limit is not None or pixels <= MAX_UNCHECKED_PIXELS:
        return
    need, free = per_pixel * pixels + RESULT_PIXEL_BYTES * made, free_bytes()
    if need > DECODE_MEMORY_SHARE * free:
        raise BadInput(
            f"{what} needs {in_words(need)} of memory to decode, and {in_words(free)} are free; reduce the photograph, "
            f"or set the limit {MEGAPIXELS_VARIABLE}={-(-pixels // 10**6)} to decode it whatever is free"
        )


def is_ordinary(shape: tuple[int, int]) -> bool:
    """Whether a photograph is decoded without a question."""
    return shape[0] * shape[1] <= MAX_UNCHECKED_PIXELS and _limit() is None


def _limit() -> float | None:
    """The most million pixels, if the user gives them."""
    text = os.environ.get(MEGAPIXELS_VARIABLE, "").strip()
    if not text:
        return None
    try:
        limit = float(text)
    except ValueError:
        limit = 0
    if not 0 < limit < float("inf"):
        raise BadInput(f"{MEGAPIXELS_VARIABLE}={text}: give the most million pixels of a photograph, such as 500")
    return limit
