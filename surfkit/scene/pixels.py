"""What the stored values of a photograph mean: how bright white is, and what a band beyond the colours is."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.scene.large_photos import open_image

Alpha = Literal["mask", "blend", "ignore"]
BITS_TAG, WHITE_LEVEL_TAG, MAX_SAMPLE_TAG, SAMPLES_TAG, EXTRA_SAMPLES_TAG = 258, 50717, 281, 277, 338
"""Tags of TIFF: BitsPerSample, WhiteLevel (DNG), MaxSampleValue, SamplesPerPixel, ExtraSamples."""
ORIENTATION_TAG = 0x0112
"""EXIF tag; 1 is upright."""
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
MAX_UINT16 = 65535
"""The largest value of 16 bits."""
MIN_EXTREME_SHARE = 0.5
"""Share of the pixels that an opacity leaves wholly transparent or wholly opaque, at least; infrared does not."""
ORDERS = {"L": "B", "B": "L", "N": "B" if sys.byteorder == "little" else "L"}
"""Orders of the two bytes of a value in a file, N for that of the machine, and the other one of each."""
OTHER_HALF = {
    f"{bands};16{order}": f"{bands};16{other}" for bands in ("RGB", "RGBA", "RGBX") for order, other in ORDERS.items()
}
"""How Pillow, which keeps the upper byte of 16 bits of colour, is told to keep the lower one: bytes exchanged."""


@dataclass(frozen=True)
class Pixels:
    """How the stored values of a photograph become colours.

    Attributes:
        white_level: The stored value that is white; 0 for the largest that its type holds. Of 16 bits only.
        alpha: What becomes of transparent pixels: `blend` lays them over black or white; `mask` and `ignore` keep their
            colours, and a mask leaves them out where it is `mask`.
    """

    white_level: int = 0
    alpha: Alpha = "blend"


DEFAULT_PIXELS = Pixels()
"""As almost all photographs are."""


@dataclass(frozen=True)
class PixelHeader:
    """What the header of a picture says of its values.

    Attributes:
        wide: Whether they have more than 8 bits.
        white_level: The value that is white, if a tag says so; else 0.
        largest: The largest value that a tag names; else 0.
        opacity: Whether there is a band that Pillow takes for an opacity.
        doubtful: Whether values must show that it is one, as it is the fourth band of a TIFF file, whose tag for it is
            often missing, or set by default.
        dropped: How many bands are neither colour nor opacity, by their tag, and are not read.
    """

    wide: bool = False
    white_level: int = 0
    largest: int = 0
    opacity: bool = False
    doubtful: bool = False
    dropped: int = 0


def kind_of(image: Image.Image) -> PixelHeader:
    """What the header of an open picture says, without decoding it."""
    tags = getattr(image, "tag_v2", {}) if image.format == "TIFF" else {}
    wide = image.mode.startswith("I") or _raw_mode(image) in OTHER_HALF
    bits = max(_numbers(tags.get(BITS_TAG, 8)))
    level = max(_numbers(tags.get(WHITE_LEVEL_TAG, 0))) or (2**bits - 1 if 8 < bits < 16 else 0)
    further = _numbers(tags[EXTRA_SAMPLES_TAG]) if EXTRA_SAMPLES_TAG in tags else ()
    opacity = has_opacity(image)
    return PixelHeader(
        wide=wide,
        white_level=level if wide else 0,
        largest=max(_numbers(tags.get(MAX_SAMPLE_TAG, 0))) if wide else 0,
        opacity=opacity,
        doubtful=opacity and bool(tags) and max(_numbers(tags.get(SAMPLES_TAG, 1))) > 2,
        dropped=len(further) - opacity,
    )


def has_opacity(image: Image.Image) -> bool:
    """Whether a picture has an opacity, by its mode or a colour that is transparent."""
    return bool({"A", "a"} & set(image.getbands())) or "transparency" in image.info


def opacity_of(image: Image.Image) -> np.ndarray:
    """(h, w) uint8 of the opacity of an open picture that has one."""
    return np.asarray(as_stored(image).convert("RGBA").getchannel("A"))


def is_opacity(values: np.ndarray) -> bool:
    """Whether the values of a band are those of an opacity, and not of infrared light."""
    top = values.max(initial=0) == 255
    return bool(top and np.mean((values == 0) | (values == 255)) >= MIN_EXTREME_SHARE)


def largest_of(image: Image.Image) -> int:
    """The largest value in an open picture of more than 8 bits; of colours as exact as its number of bits."""
    if image.mode.startswith("I"):
        return int(np.asarray(as_stored(image)).max(initial=0))
    upper = int(np.asarray(as_stored(image))[..., :3].max(initial=0))
    return upper * 256 + 255 if upper else 255


def white_level_of(largest: int) -> int:
    """The largest value of the fewest bits that hold a value, 8 at least; 0 for those of 15 and 16, which use them."""
    bits = max(8, int(largest).bit_length())
    return 0 if bits in (15, 16) else 2**bits - 1


def to_rgb(image: Image.Image, path: Path, under: int, pixels: Pixels) -> Image.Image:
    """A picture as RGB, or as RGBA whose opacity is to be dropped after it was reduced, where transparent pixels are
    masked: their colours do not spread into what is opaque then.

    Args:
        image: Open.
        path: Its file.
        under: Grey level that lies below transparent pixels.
        pixels: What its values mean.

    Raises:
        BadInput: It holds numbers of another kind.
    """
    level = pixels.white_level
    if image.mode.startswith("I"):  # 16 bits of grey; Pillow's own conversion to RGB clips at 255
        return Image.fromarray(_eight_bits(np.asarray(as_stored(image)), level or MAX_UINT16)).convert("RGB")
    if image.mode == "F":
        raise BadInput(f"{path}: pixels are floating point; convert it to 8 bits, for example to PNG")
    image = _stretched(image, path, level) if level and _raw_mode(image) in OTHER_HALF else as_stored(image)
    if not has_opacity(image) or pixels.alpha == "ignore":
        return image if image.mode == "RGB" else image.convert("RGB")
    image = image.convert("RGBA")
    if pixels.alpha == "mask":
        return image
    return Image.alpha_composite(Image.new("RGBA", image.size, (under, under, under, 255)), image).convert("RGB")


def as_stored(image: Image.Image) -> Image.Image:
    """A picture before Pillow turns it: it does so, unasked, with the TIFF files among those that EXIF says to turn."""
    if image.format != "TIFF":
        return image
    turn = image.getexif().get(ORIENTATION_TAG, 1)
    image.load()
    return image.transpose(UNDONE[turn]) if turn in UNDONE and ORIENTATION_TAG not in image.getexif() else image


def _eight_bits(values: np.ndarray, level: int) -> np.ndarray:
    """uint8 of values, of which `level` becomes 255."""
    if level > MAX_UINT16:
        return (values.clip(0, level) * (255 / level) + 0.5).astype(np.uint8)
    table = ((np.arange(level + 1, dtype=np.int64) * 510 + level) // (2 * level)).astype(np.uint8)
    return table[values.clip(0, level)]


def _stretched(image: Image.Image, path: Path, level: int) -> Image.Image:
    """16 bits of colour as 8, with `level` as 255; of an opacity, all 16 bits count."""
    with open_image(path) as opened:
        again: Any = opened  # `tile` is that of image files only
        place, raw = again.tile[0], _raw_mode(again)
        args = (OTHER_HALF[raw], *place.args[1:]) if isinstance(place.args, tuple) else OTHER_HALF[raw]
        again.tile = [tile._replace(args=args) for tile in again.tile]
        lower = np.asarray(as_stored(again)).astype(np.uint16)
    upper = np.asarray(as_stored(image))
    made = _eight_bits(upper[..., :3].astype(np.uint16) * 256 + lower[..., :3], level)
    return Image.fromarray(np.dstack([made, upper[..., 3:]]))


def _raw_mode(image: Image.Image) -> str:
    """How the values lie in the file of an open picture, in Pillow's words; of 16 bits, "RGB;16B" and the like."""
    tiles = getattr(image, "tile", None)
    args = tiles[0][3] if tiles else ""
    said = args[0] if isinstance(args, tuple) and args else args
    return said if isinstance(said, str) else ""


def _numbers(value: object) -> tuple[int, ...]:
    """The numbers of a tag, of which there may be one or several, or none that make sense."""
    values = value if isinstance(value, tuple) else (value,)
    return tuple(int(each) for each in values if isinstance(each, (int, float)) and 0 <= each < 2**32) or (0,)
