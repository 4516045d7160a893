"""What is in .spz files; see `spz.py` for their layout."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.splats.bits import from_smallest_three, logits
from surfkit.io.splats.file_axes import AXES_NAMES, Axes
from surfkit.io.splats.safe_decompress import inflated, unpacked_zstd
from surfkit.io.splats.splat_table import SplatTable

SPZ_MAGIC = b"NGSP"
COLOR_SCALE = 0.15
"""What a coefficient of degree 0 is multiplied by: colours beyond [0, 1] have a place too."""
MIN_LOG_SCALE, MAX_LOG_SCALE = -10.0, 255 / 16 - 10
"""Logarithms of the smallest and largest scale."""
LOG_SCALE_STEP = 1 / 16
"""Between logarithms of scales."""
HEADER = 32
"""Bytes of the header of version 4."""
MAX_SH_DEGREE = 3
"""Of the spherical harmonics that are kept; files have up to 4."""
EXTENDED = 2
"""Flag of a file with records of extensions, each a number, the bytes that follow, and these."""
AXES_RECORD = 0xADBE0003
"""Number of the record with the number of the axes, 4 bytes (SPZ_ADOBE_coordinate_system)."""


def decoded(path: Path, data: bytes) -> tuple[SplatTable, Axes | None]:
    """The ellipsoids of the bytes of a file, in the axes that they have there, and those axes if the file names them.

    Raises:
        BadInput: No such data, or damaged; `path` begins messages.
    """
    header, streams, records = _streams(path, data)
    if header.degree > MAX_SH_DEGREE and header.count:
        emit(Warned(f"{path}: spherical harmonics of degree {header.degree} are cut to {MAX_SH_DEGREE}"))
    return _decoded(header, streams), _named_axes(path, records) if header.is_extended else None


@dataclass(frozen=True)
class Header:
    """What the header of a file says."""

    version: int
    count: int
    degree: int
    bits: int
    antialias: bool
    is_extended: bool = False

    @property
    def widths(self) -> list[int]:
        """Bytes of each attribute of one splat, those of none left out."""
        widths = [6 if self.version == 1 else 9, 1, 3, 3, 4 if self.version > 2 else 3]
        return widths + [3 * ((self.degree + 1) ** 2 - 1)] * (self.degree > 0)

    @property
    def sizes(self) -> list[int]:
        """Bytes of each attribute."""
        return [width * self.count for width in self.widths]


def _streams(path: Path, data: bytes) -> tuple[Header, list[bytes], bytes]:
    """The header of a file, the bytes of each attribute, and those of the records of extensions."""
    if data.startswith(SPZ_MAGIC):
        header = _header(path, data, (4,))
        return header, *_unpacked(path, data, header)
    if not data.startswith(b"\x1f\x8b"):
        raise BadInput(f"{path}: no .spz file: it begins neither as gzip nor with {SPZ_MAGIC.decode()}")
    header = _header(path, inflated(path, data, 16, part=True), (1, 2, 3))
    body, streams, at = inflated(path, data, 16 + sum(header.sizes)), [], 16
    for size in header.sizes:
        streams.append(body[at : at + size])
        at += size
    return header, streams, body[at:]


def _named_axes(path: Path, records: bytes) -> Axes | None:
    """The axes that the records of extensions name, the last of them if there are several; None where none does."""
    found, at = 0, 0
    while at + 8 <= len(records):
        kind, size = struct.unpack_from("<II", records, at)
        at += 8
        if kind == AXES_RECORD:
            if size != 4 or at + size > len(records):
                raise BadInput(f"{path}: damaged: the record of its axes is cut off; write or copy it again")
            found = struct.unpack_from("<I", records, at)[0]
        at += size
    if found > len(AXES_NAMES):
        raise BadInput(f"{path}: it names axes by the number {found}; 1 to {len(AXES_NAMES)} are known; write it again")
    return AXES_NAMES[found - 1] if found else None


def _header(path: Path, data: bytes, versions: tuple[int, ...]) -> Header:
    if len(data) < 16 or not data.startswith(SPZ_MAGIC):
        raise BadInput(f"{path}: no .spz file, or cut off: it has no header")
    version, count, degree, bits, flags = struct.unpack_from("<IIBBB", data, 4)
    if version not in versions:
        raise BadInput(f"{path}: version {version} of .spz; versions 1 to 4 are read")
    if degree > 4 or bits > 30:
        raise BadInput(f"{path}: damaged: degree {degree} of spherical harmonics, {bits} fractional bits")
    return Header(version, count, degree, bits, bool(flags & 1), bool(flags & EXTENDED))


def _unpacked(path: Path, data: bytes, header: Header) -> tuple[list[bytes], bytes]:
    """The attributes of a file of version 4, and its records of extensions."""
    if len(data) < HEADER:
        raise BadInput(f"{path}: cut off within the header; write or copy it again")
    number, table = struct.unpack_from("<BI", data, 15)
    sizes = header.sizes if header.count else []
    at = table + 16 * number
    if number != len(sizes) or table < HEADER or at > len(data):
        raise BadInput(f"{path}: damaged: {number} attributes, {len(sizes)} expected; write or copy it again")
    streams = []
    for i, wanted in enumerate(sizes):
        packed, size = struct.unpack_from("<QQ", data, table + 16 * i)
        if size != wanted or packed > len(data) - at:
            raise BadInput(f"{path}: damaged or cut off: attribute {i + 1} of {number} has another size than it should")
        streams.append(unpacked_zstd(path, data[at : at + packed], size))
        at += packed
    return streams or [b""] * len(header.sizes), data[HEADER:table]


def _decoded(header: Header, streams: list[bytes]) -> SplatTable:
    """The splats of the attributes; harmonics above MOST_DEGREE are left out."""
    raw = [
        np.frombuffer(stream, np.uint8).reshape(header.count, width)
        for stream, width in zip(streams, header.widths, strict=True)
    ]
    means, alphas, colors, scales, turns = raw[:5]
    rest = raw[5] if header.degree else np.zeros((header.count, 0), np.uint8)
    coefficients = rest.reshape(header.count, (header.degree + 1) ** 2 - 1, 3)[:, : (MAX_SH_DEGREE + 1) ** 2 - 1]
    return SplatTable(
        kind="gaussian",
        means=torch.from_numpy(_decoded_positions(means, header)),
        quats=torch.from_numpy(_decoded_rotations(turns, header)),
        log_scales=torch.from_numpy(scales.astype(np.float32) * LOG_SCALE_STEP + MIN_LOG_SCALE),
        opacity_logits=torch.from_numpy(logits(alphas.reshape(-1) / 255)),
        sh0=torch.from_numpy((colors.astype(np.float32) / 255 - 0.5) / COLOR_SCALE),
        sh_rest=torch.from_numpy((coefficients.astype(np.float32) - 128) / 128),
        antialias=header.antialias,
    )


def _decoded_positions(raw: np.ndarray, header: Header) -> np.ndarray:
    """(N, 3) float32 of halves or of numbers of 24 bits."""
    if header.version == 1:
        return np.ascontiguousarray(raw).view("<f2").reshape(-1, 3).astype(np.float32)
    wide = np.zeros((header.count, 3, 4), np.uint8)
    wide[..., 1:] = raw.reshape(-1, 3, 3)
    return ((wide.view("<i4")[..., 0] >> 8) / 2.0**header.bits).astype(np.float32)


def _decoded_rotations(raw: np.ndarray, header: Header) -> np.ndarray:
    """(N, 4) float32 wxyz."""
    if header.version < 3:
        xyz = raw.reshape(-1, 3) / 127.5 - 1
        w = np.sqrt((1 - (xyz**2).sum(1, keepdims=True)).clip(0))
        return np.concatenate([w, xyz], 1).astype(np.float32)
    word = np.ascontiguousarray(raw).view("<u4").reshape(-1)
    fields = np.stack([word >> shift & 1023 for shift in (20, 10, 0)], 1)
    three = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / 511
    return np.roll(from_smallest_three(word >> 30, three), 1, 1)
