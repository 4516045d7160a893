"""Looking at every photograph of a data set once, at a fraction of its size."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.datasets.masks import check_mask, read_mask
from surfkit.scene.photos import open_header, read_draft
from surfkit.scene.pixels import DEFAULT_PIXELS, Pixels
from surfkit.scene.scene import Mask

DRAFT_SIDE_PX = 256
"""Longer side at which photographs are looked at, pixels, or up to twice that."""
UPRIGHT_ORIENTATION = 1
ORIENTATION_TAG = 0x0112
"""What EXIF calls the way a photograph is to be turned."""


@dataclass(frozen=True)
class Photograph:
    """What is known of one photograph after a look.

    Attributes:
        bytes: Of the file.
        size: Width and height; None if the header cannot be read.
        kind: Format and pixels, such as "JPEG RGB".
        turned: Whether EXIF asks for a rotation, which no reader applies.
        fault: Why it cannot be used, in one line; None if it can.
        mask_fault: The same of its mask.
        kept: Share of the pixels that its mask keeps; None without a mask.
        flat: Whether all of it has one colour.
        colors: (S, 3) float32 in [0, 1] at the places asked for; NaN where they lie outside. None if unknown.
    """

    bytes: int = 0
    size: tuple[int, int] | None = None
    kind: str = ""
    turned: bool = False
    fault: str | None = None
    mask_fault: str | None = None
    kept: float | None = None
    flat: bool = False
    colors: np.ndarray | None = None


Places = Callable[[], np.ndarray]
"""Gives (S, 2) places in a photograph, as shares of its width and height; NaN for those outside."""


@dataclass(frozen=True)
class PhotoToExamine:
    """A photograph to look at.

    Attributes:
        path: Of the photograph.
        mask: Its mask.
        places: Where the colours are wanted, if anywhere.
        pixels: What the values of the photograph mean.
    """

    path: Path
    mask: Mask | None = None
    places: Places | None = None
    pixels: Pixels = DEFAULT_PIXELS


def look_at(wanted: Sequence[PhotoToExamine], quick: bool = False) -> Iterator[Photograph]:
    """A look at each photograph, in order; in memory are only those that threads have in hand.

    Args:
        wanted: The photographs.
        quick: Whether to look at headers only, which does not find files that are cut off.
    """
    threads = os.cpu_count() or 1
    with ThreadPoolExecutor(threads) as pool:
        waiting = iter(wanted)
        pending = [pool.submit(_look, one, quick) for one in islice(waiting, 4 * threads)]
        while pending:
            yield pending.pop(0).result()
            pending += [pool.submit(_look, one, quick) for one in islice(waiting, 1)]


def _look(wanted: PhotoToExamine, quick: bool) -> Photograph:
    found: dict = {}
    try:
        found["bytes"] = wanted.path.stat().st_size
        open_header(wanted.path, lambda image: found.update(_header(image)))
        if not quick:
            found |= _pixels(read_draft(wanted.path, DRAFT_SIDE_PX, wanted.pixels), wanted.places)
    except BadInput as error:
        found["fault"] = str(error)
    except OSError as error:
        found["fault"] = f"{wanted.path}: cannot be read: {error.strerror}"
    if wanted.mask is not None:
        found |= _mask(wanted.mask, found.get("size"), quick)
    return Photograph(**found)


def _header(image: Image.Image) -> dict:
    there = "exif" in image.info  # without it, some formats would decode all to search for it
    turned = there and image.getexif().get(ORIENTATION_TAG, UPRIGHT_ORIENTATION) != UPRIGHT_ORIENTATION
    return {"size": image.size, "kind": f"{image.format} {image.mode}", "turned": turned}


def _pixels(pixels: np.ndarray, places: Places | None) -> dict:
    flat = bool(np.ptp(pixels.reshape(-1, 3), axis=0).max() <= 2)
    return {"flat": flat, "colors": None if places is None else _colors(pixels, places())}


def _colors(pixels: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(S, 3) float32 in [0, 1] of a picture (h, w, 3) uint8 at places (S, 2), NaN outside."""
    height, width = pixels.shape[:2]
    found = np.full((len(places), 3), np.nan, np.float32)
    inside = np.isfinite(places).all(1)
    x, y = (np.minimum((places[inside, axis] * size).astype(int), size - 1) for axis, size in ((0, width), (1, height)))
    found[inside] = pixels[y, x] / np.float32(255)
    return found


def _mask(mask: Mask, size: tuple[int, int] | None, quick: bool) -> dict:
    try:
        if size is not None:
            check_mask(mask.path, size)
        if quick:
            return {}
        by = max(1, max(size or (DRAFT_SIDE_PX, DRAFT_SIDE_PX)) // DRAFT_SIDE_PX)
        width, height = size or (DRAFT_SIDE_PX, DRAFT_SIDE_PX)
        seen = read_mask(mask.path, (max(1, width // by), max(1, height // by)), mask.alpha)
        return {"kept": float(seen.float().mean())}
    except BadInput as error:
        return {"mask_fault": str(error)}
