"""Photographs as tensors, reduced to the size of their cameras."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.optional import needed
from surfkit.scene.cache import Cache
from surfkit.scene.copies import Copies
from surfkit.scene.gate import Gate
from surfkit.scene.names import HEIF
from surfkit.scene.scene import View

T = TypeVar("T")
ORIENTATION = 0x0112
"""EXIF tag; 1 is upright."""
WIDTH, HEIGHT = 0x0100, 0x0101
"""Tags of TIFF: the size as stored."""
TURN = Image.Transpose
UNDONE = {
    2: TURN.FLIP_LEFT_RIGHT,
    3: TURN.ROTATE_180,
    4: TURN.FLIP_TOP_BOTTOM,
    5: TURN.TRANSPOSE,
    6: TURN.ROTATE_90,
    7: TURN.TRANSVERSE,
    8: TURN.ROTATE_270,
}
"""What brings a picture back that was turned as its EXIF says."""
# Photographs of 90 to 180 million pixels are no attack; larger ones are refused.
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
RECIPE = "1"
"""Changes when the same photograph would be read otherwise: copies on disk are then made again."""
MOST_OPEN = 256 << 20
"""Bytes of photographs, as large as they are on disk, that may be decoded at the same time; one always may."""
GATE = Gate(MOST_OPEN)


def photo_cache(
    views: Sequence[View], budget_bytes: int | None = None, copies: Copies | None = None, threads: int | None = None
) -> Cache[Tensor]:
    """The photographs of views by position, (3, H, W) uint8; with `copies`, decoded only once, also between runs."""
    sizes = [3 * view.camera.width * view.camera.height for view in views]
    if copies is None:
        return Cache(lambda at: view_photo(views[at]), sizes, budget_bytes, threads)

    def read(at: int) -> Tensor:
        view = views[at]
        shape = (3, view.camera.height, view.camera.width)
        key = f"{RECIPE} {shape} {view.white}"
        try:
            return torch.from_numpy(copies.get(view.path, key, shape, lambda: view_photo(view).numpy()))
        except FileNotFoundError as error:
            raise BadInput(f"{view.path}: no such photograph") from error

    return Cache(read, sizes, budget_bytes, threads)


def view_photo(view: View) -> Tensor:
    """(3, H, W) uint8 of the photograph of a view, at the size of its camera."""
    return read_photo(view.path, (view.camera.width, view.camera.height), view.white)


def photo_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, as stored: the rotation in EXIF is not applied, as COLMAP does not apply it.

    Raises:
        BadInput: The file is no picture that Pillow reads.
    """
    with _picture(path) as image:
        return _stored_size(image)


def is_turned(path: Path) -> bool:
    """Whether EXIF says to rotate or mirror a picture for display."""
    with _picture(path) as image:
        if image.format == "PNG" and "exif" not in image.info:  # Pillow would decode all of it, to look behind
            return False
        return image.getexif().get(ORIENTATION, 1) not in (0, 1)


def read_photo(path: Path, size: tuple[int, int], white: bool = False) -> Tensor:
    """(3, height, width) uint8 RGB of a picture, reduced with an antialiasing filter.

    Args:
        path: Any picture of 8 or 16 bits that Pillow reads.
        size: Width and height wanted.
        white: Whether transparent pixels lie over white, or over black.

    Raises:
        BadInput: The file is damaged or holds another kind of pixel.
    """

    def decode(image: Image.Image) -> np.ndarray:
        plain = _rgb(image, path, 255 if white else 0)
        if plain.size != size:
            plain = plain.resize(size, Image.Resampling.LANCZOS, reducing_gap=3.0)
        return np.array(plain)

    return torch.from_numpy(open_picture(path, decode)).permute(2, 0, 1).contiguous()


def read_draft(path: Path, longest: int) -> np.ndarray:
    """(h, w, 3) uint8 RGB of a picture at a fraction of its size, the longer side `longest` to twice that if it can be.

    All of the file is read, but a JPEG is never held at its full size.

    Raises:
        BadInput: As for `read_photo`.
    """

    def decode(image: Image.Image) -> np.ndarray:
        image.draft(image.mode, (longest, longest))
        plain = _rgb(image, path, 0)
        by = max(1, max(plain.size) // longest)
        return np.array(plain.reduce(by) if by > 1 else plain)

    return open_picture(path, decode)


def require_heif(what: str) -> None:
    """Teach Pillow to read HEIC; BadInput, which begins with `what`, without pillow-heif."""
    with needed("pillow_heif", what):
        from pillow_heif import register_heif_opener
    register_heif_opener()


def _rgb(image: Image.Image, path: Path, under: int) -> Image.Image:
    image = _as_stored(image)
    if image.mode.startswith("I"):  # 16 bits of grey; Pillow's own conversion to RGB clips at 255
        grey = np.asarray(image).astype(np.int64).clip(0, 65535)
        return Image.fromarray(((grey + 128) // 257).astype(np.uint8)).convert("RGB")
    if image.mode == "F":
        raise BadInput(f"{path}: pixels are floating point; convert it to 8 bits, for example to PNG")
    if "A" in image.getbands() or "a" in image.getbands() or "transparency" in image.info:
        image = image.convert("RGBA")
        return Image.alpha_composite(Image.new("RGBA", image.size, (under, under, under, 255)), image).convert("RGB")
    return image if image.mode == "RGB" else image.convert("RGB")


def _stored_size(image: Image.Image) -> tuple[int, int]:
    return (image.tag_v2[WIDTH], image.tag_v2[HEIGHT]) if image.format == "TIFF" else image.size


def _as_stored(image: Image.Image) -> Image.Image:
    """A picture before Pillow turns it: it does so, unasked, with the TIFF files among those that EXIF says to turn."""
    if image.format != "TIFF":
        return image
    turn = image.getexif().get(ORIENTATION, 1)
    image.load()
    return image.transpose(UNDONE[turn]) if turn in UNDONE and ORIENTATION not in image.getexif() else image


def open_picture(path: Path, use: Callable[[Image.Image], T]) -> T:
    """What `use` makes of the open picture; whatever Pillow finds wrong becomes BadInput."""
    with _picture(path) as image, GATE.taking(len(image.getbands()) * image.width * image.height):
        return use(image)


@contextmanager
def _picture(path: Path) -> Iterator[Image.Image]:
    """The open picture, not yet decoded; within, what Pillow finds wrong becomes BadInput."""
    if path.suffix.lower() in HEIF:
        require_heif(str(path))
    try:
        with Image.open(path) as image:
            yield image
    except BadInput:
        raise
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:
        reason = "no such photograph" if isinstance(error, FileNotFoundError) else f"not a whole picture: {error}"
        raise BadInput(f"{path}: {reason}".replace(f" '{path}'", "").replace("\n", " ")) from error
