"""Photographs as tensors, reduced to the size of their cameras."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.optional import needed
from surfkit.scene.byte_semaphore import ByteSemaphore
from surfkit.scene.cache import Cache
from surfkit.scene.decoded_photos import DecodedPhotoCache
from surfkit.scene.jpeg import tell, with_end
from surfkit.scene.large_photos import (
    DECODED_PIXEL_BYTES,
    GREY16_PIXEL_BYTES,
    OPACITY_PIXEL_BYTES,
    RGB16_PIXEL_BYTES,
    any_size,
    is_ordinary,
    open_image,
    refuse_too_large,
)
from surfkit.scene.photo_names import HEIF_SUFFIXES
from surfkit.scene.pixels import DEFAULT_PIXELS, ORIENTATION_TAG, Pixels, kind_of, to_rgb
from surfkit.scene.scene import View

T = TypeVar("T")
WIDTH_TAG, HEIGHT_TAG = 0x0100, 0x0101
"""Tags of TIFF: the size as stored."""
# Whether a photograph is too large, `surfkit.scene.large_photos` says.
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
CACHE_VERSION = "1"
"""Changes when the same photograph would be read otherwise: copies on disk are then made again."""
MAX_OPEN_BYTES = 256 << 20
"""Bytes of photographs, as large as they are on disk, that may be decoded at the same time; one always may."""
DECODE_GATE = ByteSemaphore(MAX_OPEN_BYTES)


def photo_cache(
    views: Sequence[View],
    budget_bytes: int | None = None,
    copies: DecodedPhotoCache | None = None,
    threads: int | None = None,
) -> Cache[Tensor]:
    """The photographs of views by position, (3, H, W) uint8; with `copies`, decoded only once, also between runs."""
    sizes = [3 * view.camera.width * view.camera.height for view in views]
    if copies is None:
        return Cache(lambda at: view_photo(views[at]), sizes, budget_bytes, threads)

    def read(at: int) -> Tensor:
        view = views[at]
        shape = (3, view.camera.height, view.camera.width)
        key = f"{CACHE_VERSION} {shape} {view.white}" + (f" {view.pixels}" if view.pixels != DEFAULT_PIXELS else "")
        try:
            return torch.from_numpy(copies.get(view.path, key, shape, lambda: view_photo(view).numpy()))
        except FileNotFoundError as error:
            raise BadInput(f"{view.path}: no such photograph") from error

    return Cache(read, sizes, budget_bytes, threads)


def view_photo(view: View) -> Tensor:
    """(3, H, W) uint8 of the photograph of a view, at the size of its camera."""
    return read_photo(view.path, (view.camera.width, view.camera.height), view.white, view.pixels)


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
        return image.getexif().get(ORIENTATION_TAG, 1) not in (0, 1)


def read_exif_tags(path: Path, ifd: int) -> tuple[dict[int, Any], dict[int, Any]]:
    """The tags of EXIF in a picture, and those of the part of it that has a number; none where it is damaged."""
    with _picture(path) as image:
        if image.format == "PNG" and "exif" not in image.info:  # see `is_turned`
            return {}, {}
        try:
            tags = image.getexif()
            return dict(tags), dict(tags.get_ifd(ifd))
        except Exception:  # Pillow raises whatever the bytes of a damaged block lead to
            return {}, {}


def read_photo(path: Path, size: tuple[int, int], white: bool = False, pixels: Pixels = DEFAULT_PIXELS) -> Tensor:
    """(3, height, width) uint8 RGB of a picture, reduced with an antialiasing filter.

    Args:
        path: Any picture of 8 or 16 bits that Pillow reads.
        size: Width and height wanted.
        white: Whether transparent pixels lie over white, or over black.
        pixels: What its values mean.

    Raises:
        BadInput: The file is damaged or holds another kind of pixel.
    """

    def decode(image: Image.Image) -> np.ndarray:
        plain = to_rgb(image, path, 255 if white else 0, pixels)
        if plain.size != size:
            masked = plain.mode == "RGBA"  # what rings at the edge of a mask would be no colour of the photograph
            way = Image.Resampling.HAMMING if masked else Image.Resampling.LANCZOS
            plain = plain.resize(size, way, reducing_gap=3.0)
        return np.array(plain.convert("RGB") if plain.mode == "RGBA" else plain)

    return torch.from_numpy(open_picture(path, decode, size)).permute(2, 0, 1).contiguous()


def read_draft(path: Path, longest: int, pixels: Pixels = DEFAULT_PIXELS) -> np.ndarray:
    """(h, w, 3) uint8 RGB of a picture at a fraction of its size, the longer side `longest` to twice that if it can be.

    All of the file is read, but a JPEG is never held at its full size.

    Raises:
        BadInput: As for `read_photo`.
    """

    def decode(image: Image.Image) -> np.ndarray:
        plain = to_rgb(image, path, 0, pixels)
        by = max(1, max(plain.size) // longest)
        plain = plain.reduce(by) if by > 1 else plain
        return np.array(plain.convert("RGB") if plain.mode == "RGBA" else plain)

    return open_picture(path, decode, (longest, longest), draft=True)


def require_heif(what: str) -> None:
    """Teach Pillow to read HEIC; BadInput, which begins with `what`, without pillow-heif."""
    with needed("pillow_heif", what):
        from pillow_heif import register_heif_opener
    register_heif_opener()


def _stored_size(image: Image.Image) -> tuple[int, int]:
    tags: Any = getattr(image, "tag_v2", None)  # of TIFF files only
    return image.size if tags is None or image.format != "TIFF" else (tags[WIDTH_TAG], tags[HEIGHT_TAG])


def open_header(path: Path, use: Callable[[Image.Image], T]) -> T:
    """What `use` makes of the header of a picture of any size; whatever Pillow finds wrong becomes BadInput."""
    with _picture(path) as image:
        return use(image)


def open_picture(
    path: Path, use: Callable[[Image.Image], T], size: tuple[int, int] | None = None, draft: bool = False
) -> T:
    """What `use` makes of the open picture; whatever Pillow finds wrong becomes BadInput.

    Args:
        path: The file.
        use: Called twice where the first time fails for the lack of a JPEG file's end.
        size: Width and height of what is made, if it is a smaller picture.
        draft: Whether any JPEG may be decoded at a fraction of its size for it, or only large ones.
    """
    with _picture(path) as image:
        allowed = nullcontext() if is_ordinary(image.size) else any_size()
        _ready(path, image, size, draft)
        with allowed, DECODE_GATE.taking(len(image.getbands()) * image.width * image.height):
            try:
                return use(image)
            except OSError:
                if image.format not in ("JPEG", "MPO") or (data := with_end(path)) is None:
                    raise
            with open_image(io.BytesIO(data)) as whole:
                _ready(path, whole, size, draft)
                made = use(whole)
            tell(path)
            return made


def refuse_large(path: Path, stored: tuple[int, int], size: tuple[int, int]) -> None:
    """BadInput if a photograph of a width and height is too large to be read at another size; it is not decoded."""
    if not is_ordinary(stored):
        with _picture(path) as image:
            _ready(path, image, size, False)


def _ready(path: Path, image: Image.Image, size: tuple[int, int] | None, draft: bool) -> None:
    """Have a JPEG decoded at a half, a quarter or an eighth where that is enough; BadInput if a picture is too large.

    Of a large one, twice the size that is wanted is enough.
    """
    if size is not None and (draft or not is_ordinary(image.size)):
        image.draft(image.mode, size if draft else (2 * size[0], 2 * size[1]))
    kind = kind_of(image)
    per_pixel = OPACITY_PIXEL_BYTES if kind.opacity else DECODED_PIXEL_BYTES
    if kind.wide:
        per_pixel = GREY16_PIXEL_BYTES if image.mode.startswith("I") else RGB16_PIXEL_BYTES
    refuse_too_large(path, image.size, per_pixel, size[0] * size[1] if size else 0)


@contextmanager
def _picture(path: Path) -> Iterator[Image.Image]:
    """The open picture, not yet decoded; within, what Pillow finds wrong becomes BadInput."""
    if path.suffix.lower() in HEIF_SUFFIXES:
        require_heif(str(path))
    try:
        with open_image(path) as image:
            yield image
    except BadInput:
        raise
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        reason = "no such photograph" if isinstance(error, FileNotFoundError) else f"not a whole picture: {error}"
        raise BadInput(f"{path}: {reason}".replace(f" '{path}'", "").replace("\n", " ")) from error
