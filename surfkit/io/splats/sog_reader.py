"""What is in a .sog file; see `sog.py` for its layout."""

from __future__ import annotations

import io
import os
import stat
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.core.codec import from_json
from surfkit.io.splats.bits import from_smallest_three, logits
from surfkit.io.splats.safe_decompress import ALWAYS_ALLOWED_BYTES, refuse_implausible
from surfkit.io.splats.splat_table import SplatTable

MAX_WEBP_SIDE = 16_383
"""Most pixels of a WebP image along a side."""
WEBP_HEADER_BYTES = 30
"""Bytes of a WebP image in which its size stands."""
MAX_META_BYTES = 1 << 26
"""Bytes of a meta.json that are read."""
MAX_ARCHIVE_EXPANSION = 16
"""Times that files of the archive may grow: images are compressed already."""
KIND_OF_MODEL = {"2dgs": "surfel", "antialiased": "gaussian", "default": "gaussian"}


def is_sog(path: Path, head: bytes) -> bool:
    """Whether this is a .sog file, or the meta.json of one that is not in an archive."""
    if head.startswith(b"PK\x03\x04"):
        return path.suffix.lower() == ".sog" or b".webp" in head or b"meta.json" in head
    return path.name == "meta.json" and b'"version"' in head and b".webp" in head


def read_sog(path: Path) -> SplatTable:
    """See `Format.read`."""
    try:
        if path.name == "meta.json":
            return _decoded(path, lambda name: _beside(path, name))
        with zipfile.ZipFile(path) as archive:
            return _decoded(path, lambda name: _member(path, archive, name))
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror or error}") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, struct.error) as error:
        raise BadInput(f"{path}: damaged: {' '.join(str(error).split())}; write or copy it again") from error


def _member(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    """A file of the archive."""
    try:
        entry = archive.getinfo(name)
    except KeyError as error:
        raise BadInput(f"{path}: no .sog file, or damaged: it has no {name}") from error
    if entry.compress_size > path.stat().st_size:
        raise BadInput(f"{path}: damaged or cut off: {name} would be larger than the file; copy it again")
    refuse_implausible(path, entry.compress_size, entry.file_size, MAX_ARCHIVE_EXPANSION)
    return archive.read(entry)


def _beside(path: Path, name: str) -> bytes:
    """A file of an unpacked archive: a regular one in the folder of meta.json, no larger than what it can be of use."""
    folder, where = path.parent.resolve(), (path.parent / name).resolve(strict=True)
    if folder not in where.parents:
        raise BadInput(f"{path}: {name} is a link out of the folder; copy the file itself there")
    # a pipe would wait for someone to write
    descriptor = os.open(where, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    with os.fdopen(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise BadInput(f"{path}: {name} is no regular file; copy the files of the archive there again")
        head = file.read(WEBP_HEADER_BYTES)
        most = MAX_META_BYTES
        if name != "meta.json":
            width, height = _size(path, name, head)
            most = 4 * width * height + ALWAYS_ALLOWED_BYTES
        if found.st_size > most:
            raise BadInput(f"{path}: {name} has {found.st_size:,} bytes, more than it can be of use; copy it again")
        return head + file.read(most)


def _decoded(path: Path, member: Callable[[str], bytes]) -> SplatTable:
    """The splats, from the files that `member` gives by name."""
    meta = _Meta(path, member)
    count = meta.whole("count")
    if meta.whole("version") != 2:
        raise BadInput(f"{path}: version {meta.whole('version')} of .sog; version 2 is read")
    low, high = (meta.images("means", at, count)[:, :3].astype(np.float64) for at in (0, 1))
    first, last = (np.array(meta.numbers("means", end, 3)) for end in ("mins", "maxs"))
    bent = first + (last - first) * (low + 256 * high) / 65_535
    with np.errstate(over="ignore"):  # what is infinite then is refused below
        means = np.sign(bent) * np.expm1(np.abs(bent))
    turns, colors = meta.images("quats", 0, count), meta.images("sh0", 0, count)
    tag = turns[:, 3].astype(np.int64) - 252
    quats = from_smallest_three(tag.clip(0), turns[:, :3] / 127.5 - 1)
    quats[tag < 0] = (1, 0, 0, 0)
    model = meta.model()
    table = SplatTable(
        kind="gaussian",
        means=torch.from_numpy(meta.shifted(means)),
        quats=torch.from_numpy(quats),
        log_scales=torch.from_numpy(meta.codes("scales")[meta.images("scales", 0, count)[:, :3]]),
        opacity_logits=torch.from_numpy(logits(colors[:, 3] / 255)),
        sh0=torch.from_numpy(meta.codes("sh0")[colors[:, :3]]),
        sh_rest=torch.from_numpy(_harmonics(meta, count)),
        antialias=model == "antialiased",
    )
    table.refuse_unsound(path)
    return table.as_surfels() if KIND_OF_MODEL[model] == "surfel" else table


def _harmonics(meta: _Meta, count: int) -> np.ndarray:
    """(N, K - 1, 3) float32 coefficients of higher degree."""
    if "shN" not in meta.values:
        return np.zeros((count, 0, 3), np.float32)
    bands, size = meta.whole("shN", "bands"), meta.whole("shN", "count")
    if bands not in (1, 2, 3):
        raise BadInput(f"{meta.path}: meta.json has {bands} bands of spherical harmonics; 1 to 3 are read")
    rest = (bands + 1) ** 2 - 1
    picture = meta.image("shN", 0)
    if picture.shape[1] != 64 * rest or picture.shape[0] * 64 < size:
        there = f"{picture.shape[1]} x {picture.shape[0]} pixels"
        raise BadInput(f"{meta.path}: damaged: {there} cannot be a palette of {size} rows of {rest}")
    rows = meta.codes("shN")[picture[:, :, :3].reshape(-1, rest, 3)]
    pixels = meta.images("shN", 1, count).astype(np.int64)
    label = pixels[:, 0] + 256 * pixels[:, 1]
    if count and label.max() >= size:
        raise BadInput(f"{meta.path}: damaged: a splat has row {label.max()} of a palette of {size}")
    return rows[label]


class _Meta:
    """meta.json and the images that it names."""

    def __init__(self, path: Path, member: Callable[[str], bytes]) -> None:
        self.path, self.member = path, member
        text = member("meta.json").decode("utf-8", "replace")
        try:
            self.values = from_json(text)
        except BadInput as error:
            raise BadInput(f"{path}: damaged: meta.json: {error}") from error
        if not isinstance(self.values, dict):
            raise BadInput(f"{path}: meta.json has no entries; write the file again")

    def entry(self, *keys: str) -> Any:
        """The value at a path of keys; None where there is none."""
        value = self.values
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return value

    def whole(self, *keys: str) -> int:
        """A whole number of 0 or more."""
        value = self.entry(*keys)
        if type(value) is not int or not 0 <= value <= MAX_WEBP_SIDE**2:
            raise BadInput(f"{self.path}: meta.json: {'.'.join(keys)} is {_shown(value)}, no whole number that can be")
        return value

    def numbers(self, group: str, key: str, count: int) -> list[float]:
        """So many numbers."""
        value = self.entry(group, key)
        fits = isinstance(value, list) and len(value) == count and all(type(v) in (int, float) for v in value)
        if not fits or not all(abs(v) < 1e30 for v in value):
            raise BadInput(f"{self.path}: meta.json: {group}.{key} is {_shown(value)}, not {count} numbers")
        return [float(v) for v in value]

    def codes(self, group: str) -> np.ndarray:
        """(256,) float32 values of a codebook."""
        return np.array(self.numbers(group, "codebook", 256), np.float32)

    def model(self) -> str:
        """What the splats are."""
        model = self.entry("model")
        if not isinstance(model, str) or model not in KIND_OF_MODEL:
            model = "default"
        return "antialiased" if model == "default" and self.entry("antialias") is True else model

    def shifted(self, means: np.ndarray) -> np.ndarray:
        """Positions with the offset that surfkit left out; float64 then, else float32."""
        if self.entry("surfkit", "offset") is None:
            return means.astype(np.float32)
        return means + np.array(self.numbers("surfkit", "offset", 3))

    def image(self, group: str, at: int) -> np.ndarray:
        """(H, W, 4) pixels of an image that meta.json names."""
        names = self.entry(group, "files")
        name = names[at] if isinstance(names, list) and len(names) > at else None
        if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or "\\" in name or "\0" in name:
            raise BadInput(f"{self.path}: meta.json: {group}.files has no name of a file at {at}: {_shown(name)}")
        return _pixels(self.path, name, self.member(name))

    def images(self, group: str, at: int, count: int) -> np.ndarray:
        """(count, 4) pixels of an image that has one for each splat."""
        pixels = self.image(group, at).reshape(-1, 4)
        if len(pixels) < count:
            raise BadInput(f"{self.path}: damaged: {group} has {len(pixels):,} pixels for {count:,} splats")
        return pixels[:count]


def _pixels(path: Path, name: str, data: bytes) -> np.ndarray:
    """(H, W, 4) pixels of a WebP image, whose header is believed only if so many bytes can hold as much."""
    width, height = _size(path, name, data)
    refuse_implausible(path, len(data), 4 * width * height)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
                return np.asarray(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise BadInput(f"{path}: damaged: the image {name} cannot be read; write or copy it again") from error


def _size(path: Path, name: str, data: bytes) -> tuple[int, int]:
    """Width and height in the header of a WebP image."""
    if len(data) >= WEBP_HEADER_BYTES and data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        if data[12:16] == b"VP8L":
            bits = struct.unpack_from("<I", data, 21)[0]
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        if data[12:16] == b"VP8X":
            return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    raise BadInput(f"{path}: {name} is no lossless WebP image; other images are not read")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
