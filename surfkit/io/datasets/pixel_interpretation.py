"""What the values of a data set's photographs mean: by the tags of each file, and by the values of all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput, few
from surfkit.scene.photos import open_header, open_picture
from surfkit.scene.pixels import (
    DEFAULT_PIXELS,
    MAX_UINT16,
    Alpha,
    PixelHeader,
    Pixels,
    is_opacity,
    kind_of,
    largest_of,
    opacity_of,
    white_level_of,
)

READER_THREADS = 4
ALPHA_OPTIONS = ("--alpha", "--white")
"""What users choose by what becomes of transparent pixels."""
ALPHA_REMEDIES = (
    ("--alpha", "--alpha mask ignores them"),
    ("--alpha", "--alpha ignore takes their colours as stored"),
    ("--white", "--white blends them over white"),
)
"""What to say of each, with the option that it is."""
MAX_EXAMINED_PHOTOS = 16
"""Photographs with an opacity of which all pixels are looked at, to say how much is transparent."""


@dataclass(frozen=True)
class PixelInterpretation:
    """What the values of photographs mean.

    Attributes:
        pixels: By name.
        lines: What is to be said of it, a sentence for each kind.
    """

    pixels: Mapping[str, Pixels]
    lines: Sequence[str]


def decide(
    files: Mapping[str, Path], alpha: Alpha | None = None, white: bool = False, options: Sequence[str] = ALPHA_OPTIONS
) -> PixelInterpretation:
    """What the values of the photographs of a data set mean. Files that cannot be read are told of where they are used.

    White of those of 16 bits is one for all, so that exposures stay comparable: the largest value of the fewest bits
    that hold all of their values, unless a tag of a file says what it is.

    Args:
        files: All photographs of the data set by name, not a part of them.
        alpha: What becomes of transparent pixels; by default they are blended, where the band is an opacity.
        white: Whether the user has them blended over white.
        options: Which of `ALPHA_OPTIONS` the command has, to be named where they may help.
    """
    with ThreadPoolExecutor(READER_THREADS) as pool:
        kinds = dict(zip(files, pool.map(_kind, files.values()), strict=True))
        levels, said = _levels(files, {name: kind for name, kind in kinds.items() if kind.wide}, pool)
        modes, more = _alphas(files, kinds, alpha, white, options, pool)
    pixels = {name: Pixels(levels.get(name, 0), modes.get(name, DEFAULT_PIXELS.alpha)) for name in files}
    return PixelInterpretation(pixels, [*said, *more])


def _kind(path: Path) -> PixelHeader:
    try:
        return open_header(path, kind_of)
    except BadInput:
        return PixelHeader()


def _levels(
    files: Mapping[str, Path], wide: Mapping[str, PixelHeader], pool: ThreadPoolExecutor
) -> tuple[dict[str, int], list[str]]:
    """The value that is white by name, where it is not the largest of 16 bits; and what to say."""
    tagged = {name: kind.white_level for name, kind in wide.items() if kind.white_level}
    others = [name for name in wide if name not in tagged]
    largest = max((wide[name].largest for name in others if wide[name].largest < MAX_UINT16), default=0)
    for value in _largest([files[name] for name in others], pool):
        largest = max(largest, value)
        if white_level_of(largest) == 0:
            break
    level = white_level_of(largest) if others else 0
    said = []
    if level and level < MAX_UINT16:
        what = f"{_photographs(len(others))} of 16 bits a value, {few(others)}, hold no value of more than"
        said.append(
            f"{what} {level.bit_length()} bits: {level:,} is taken for white in all of them, not {MAX_UINT16:,}"
        )
    elif level:
        said.append(f"{_photographs(len(others))} have values of more than 16 bits: {level:,} is taken for white")
    if short := {name: value for name, value in tagged.items() if value != MAX_UINT16}:
        named = sorted(set(short.values()))
        values = f"{named[0]:,}" if len(named) == 1 else f"{named[0]:,} to {named[-1]:,}"
        said.append(f"white is {values} by a tag in {_photographs(len(short))} of 16 bits a value, {few(list(short))}")
    return {**dict.fromkeys(others, level), **short}, said


def _largest(paths: Sequence[Path], pool: ThreadPoolExecutor) -> Iterator[int]:
    """The largest value in each file, a few files ahead; those that are damaged are passed over."""

    def look(path: Path) -> int:
        try:
            return open_picture(path, largest_of)
        except BadInput:
            return 0

    for at in range(0, len(paths), READER_THREADS):
        yield from pool.map(look, paths[at : at + READER_THREADS])


def _alphas(
    files: Mapping[str, Path],
    kinds: Mapping[str, PixelHeader],
    alpha: Alpha | None,
    white: bool,
    options: Sequence[str],
    pool: ThreadPoolExecutor,
) -> tuple[dict[str, Alpha], list[str]]:
    """What becomes of transparent pixels by name, of photographs that may have some; and what to say."""
    said = []
    if dropped := [name for name, kind in kinds.items() if kind.dropped > 0]:
        beyond = f"bands beyond red, green and blue of {_photographs(len(dropped))}, {few(dropped)}"
        said.append(f"{beyond}, are no opacity by their tag, and are not used")
    having = [name for name, kind in kinds.items() if kind.opacity]
    if alpha is not None:
        if not having:
            said.append(f"--alpha {alpha}: no photograph has an opacity, so it changes nothing")
        elif alpha == "mask":
            said.append(f"what is transparent is ignored in {len(having)} of {len(files)} photographs")
        return dict.fromkeys(having, alpha), said
    doubtful = [name for name in having if kinds[name].doubtful]
    looks = dict(zip(doubtful, pool.map(lambda name: _opacity(files[name]), doubtful), strict=True))
    if bands := [name for name, look in looks.items() if look is not None and not look.is_opacity]:
        said.append(
            f"the fourth band of {_photographs(len(bands))}, {few(bands)}, is no opacity by its values (infrared?), "
            "and is not used" + "; --alpha blend takes it for an opacity" * ("--alpha" in options)
        )
    rest = [name for name in having if name not in bands]
    if not white and (line := _transparent(files, rest, len(files), pool)):
        ways = [way for option, way in ALPHA_REMEDIES if option in options]
        said.append("; ".join([line, *([", ".join(ways)] if ways else [])]))
    return {name: "ignore" if name in set(bands) else "blend" for name in having}, said


def _transparent(files: Mapping[str, Path], having: Sequence[str], count: int, pool: ThreadPoolExecutor) -> str | None:
    """A line where photographs with an opacity have transparent pixels."""
    chosen = having[:: max(1, -(-len(having) // MAX_EXAMINED_PHOTOS))]
    looks = zip(chosen, pool.map(lambda name: _opacity(files[name]), chosen), strict=True)
    shares = {name: look.transparent for name, look in looks if look is not None and look.transparent > 0}
    if not shares:
        return None
    whole = len(chosen) == len(having)
    among = f"{count} photographs" if whole else f"{len(chosen)} photographs that were looked at, of {count},"
    return (
        f"{len(shares)} of {among} have transparent pixels, {few(list(shares))}, "
        f"{np.mean(list(shares.values())):.1%} of each on average: they are blended over black, which is learnt as "
        "empty space"
    )


@dataclass(frozen=True)
class _AlphaStats:
    """Whether a band is an opacity by its values, and the share of its pixels that are transparent."""

    is_opacity: bool
    transparent: float


def _opacity(path: Path) -> _AlphaStats | None:
    def look(values: np.ndarray) -> _AlphaStats:
        return _AlphaStats(is_opacity(values), float(1 - values.mean(dtype=np.float64) / 255))

    try:
        return open_picture(path, lambda image: look(opacity_of(image)))
    except BadInput:
        return None


def _photographs(count: int) -> str:
    return "1 photograph" if count == 1 else f"{count} photographs"
