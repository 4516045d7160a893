"""The .spz files of Niantic: about a tenth of a PLY file.

All values of one attribute follow one another: positions as fixed-point numbers of 24 bits, opacities as bytes, colours
as bytes of 255 (0.15 f + 1/2), scales as bytes of 16 (log s + 10), rotations xyzw as the index of the largest component
in 2 bits and the others in a sign and 9 bits each (version 2: x, y, z in a byte each), coefficients of higher degree as
bytes of 128 f + 128. Versions 1 to 3 are one gzip stream with a header of 16 bytes; version 4 is a header of 32 bytes,
a table of sizes and a zstd stream for each attribute. Records of extensions stand before that table, and in the older
versions behind the attributes. Source: README.md, extensions/README.md and src/cc/load-spz.cc of nianticlabs/spz.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
import zstandard
from torch import Tensor

from surfkit.core.check import BadInput, require_within
from surfkit.core.events import Warned, emit
from surfkit.core.files import replacing
from surfkit.io.splats.base import Format
from surfkit.io.splats.bits import sigmoid, smallest_three, to_bytes
from surfkit.io.splats.file_axes import AXES_NAMES, PLY_AXES, FileAxes, turn_between
from surfkit.io.splats.ply import WRITTEN_ROWS
from surfkit.io.splats.rotate_splats import turned
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.io.splats.spz_reader import (
    AXES_RECORD,
    COLOR_SCALE,
    EXTENDED,
    HEADER,
    LOG_SCALE_STEP,
    MAX_LOG_SCALE,
    MIN_LOG_SCALE,
    SPZ_MAGIC,
    decoded,
)
from surfkit.scene.morton import morton_order
from surfkit.scene.rotations import unit
from surfkit.scene.scene import Frame

FINEST_ROUNDING_DIVISOR = 64
"""Positions are rounded to no less than this share of the median scale: finer bits are noise that takes space."""
QUIET_ROUNDING_DIVISOR = 4
"""A share of the median scale by which positions may be rounded without a warning."""
HALF_TURN_SIGNS = [
    (-1) ** ((m < 0) + (degree - abs(m)) % 2) for degree in (1, 2, 3) for m in range(-degree, degree + 1)
]
"""Signs of spherical harmonics after half a turn about x: orders m < 0 are odd in y, odd degree - |m| is odd in z."""
SPZ_ZSTD_LEVEL = 12
"""Of zstd, as in the library of Niantic."""

SPZ_ROUNDING = (LOG_SCALE_STEP / 2 + 1e-4, MIN_LOG_SCALE)
"""Of logarithms of scales, and the smallest of them, for `as_surfels_if_thin`."""

Encode = Callable[[np.ndarray], np.ndarray]
"""Makes the bytes of an attribute from rows of its column."""


@dataclass(frozen=True)
class SPZ(Format):
    """The layout of Niantic, which most viewers open: 8 bits for most values, 24 for each coordinate, compressed."""

    suffix: ClassVar[str] = ".spz"

    version: Literal[2, 3, 4] = 3
    """Version of the layout. 3 is what most viewers open; 4 is smaller and newer, 2 has coarser rotations."""

    fractional_bits: int | None = None
    """Binary digits of positions after the point; None takes what the size of the scene leaves of 24, but no more than
    a 64th of the median scale needs."""

    sh1_bits: int = 5
    """Bits to which spherical harmonics of degree 1 are rounded: fewer make a smaller file."""

    sh_rest_bits: int = 4
    """Bits to which spherical harmonics of degrees 2 and 3 are rounded."""

    axes: Literal["rub", "same"] = "rub"
    """rub follows the specification, right-up-back: half a turn about x from the axes of PLY files. same keeps the axes
    of PLY files, as splat-transform 3 and SuperSplat do; files of version 4 say so. Reading turns back by what the file
    says, or else by this."""

    def __post_init__(self) -> None:
        require_within({"sh1_bits": (1, 8), "sh_rest_bits": (1, 8)}, self)
        if self.fractional_bits is not None:
            require_within({"fractional_bits": (0, 23)}, self)

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`."""
        table.refuse_unsound(path)
        table = replace(table.on_cpu(), means=table.file_means(frame))
        if self.axes == "rub":
            table = half_turn(table)
        bits = self._bits(path, table)
        with replacing(path) as file:
            for part in self._packed(table, bits):
                file.write(part)

    def _packed(self, table: SplatTable, bits: int) -> Iterator[bytes]:
        """A file, part by part."""
        order = torch.from_numpy(morton_order(table.means.double().numpy()))
        record = b""
        if self.version == 4 and self.axes == "same":
            record = struct.pack("<III", AXES_RECORD, 4, AXES_NAMES.index(PLY_AXES) + 1)
        flags = int(table.antialias) | EXTENDED * bool(record)
        head = struct.pack("<4sIIBBB", SPZ_MAGIC, self.version, len(table), table.sh_degree, bits, flags)
        streams = [_parts(column, order, encode) for column, encode in self._attributes(table, bits)]
        if self.version == 4:
            yield _container(head, record, streams, len(table))
            return
        squeeze = zlib.compressobj(6, zlib.DEFLATED, 31)
        yield squeeze.compress(head + b"\0")
        for stream in streams:
            for part in stream:
                yield squeeze.compress(part)
        yield squeeze.flush()

    def _bits(self, path: Path, table: SplatTable) -> int:
        """Digits after the point; BadInput if the positions have no place, a warning if they are rounded much."""
        reach = float(table.means.abs().max()) if len(table) else 1.0
        most = min(23, math.floor(math.log2((2**23 - 1) / max(reach, 2.0**-23))))
        scale = table.median_scale()
        wanted = math.ceil(math.log2(FINEST_ROUNDING_DIVISOR / scale))
        bits = self.fractional_bits if self.fractional_bits is not None else max(0, min(most, wanted))
        if bits > most:
            raise BadInput(
                f"{path}: coordinates up to {reach:.6g} have no place in 24 bits with {bits} after the point; "
                + (f"at most {most} leave room" if most >= 0 else "move the splats towards 0, or take another format")
            )
        if len(table) and 2.0**-bits > scale / QUIET_ROUNDING_DIVISOR:
            rounded = f"{2.0**-bits:.3g} apart, {2.0**-bits / scale:.2g} x the median scale of the splats"
            emit(Warned(f"{path}: positions are {rounded}; --format ply keeps more of such a large scene"))
        return bits

    def _attributes(self, table: SplatTable, bits: int) -> list[tuple[Tensor, Encode]]:
        """The column of each attribute, in the order of the file, and what makes its bytes."""
        rest = [(table.sh_rest, lambda rest: _harmonics(rest, self.sh1_bits, self.sh_rest_bits))]
        return [
            (table.means, lambda means: _positions(means, bits)),
            (table.opacity_logits, lambda logits: to_bytes(255 * sigmoid(logits))),
            (table.sh0, lambda sh0: to_bytes(255 * (COLOR_SCALE * sh0.clip(-9, 9) + 0.5))),
            (table.ellipsoid_log_scales(), lambda scales: to_bytes((scales - MIN_LOG_SCALE) / LOG_SCALE_STEP)),
            (table.quats, _rotations if self.version > 2 else _short_rotations),
            *(rest if table.sh_degree else ()),
        ]

    def read(self, path: Path) -> SplatTable:
        """See `Format.read`."""
        try:
            data = Path(path).read_bytes()
        except OSError as error:
            raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
        table, named = decoded(path, data)
        table.refuse_unsound(path)
        axes = FileAxes(named or ("rub" if self.axes == "rub" else PLY_AXES), named is not None)
        table = half_turn(table) if axes.name == "rub" else turned(table, turn_between(axes.name))
        table = replace(table, axes=axes)
        return table.as_surfels_if_thin(*SPZ_ROUNDING)

    def knows(self, path: Path, head: bytes) -> bool:
        """See `Format.knows`."""
        if head[:2] == b"\x1f\x8b":
            try:
                head = zlib.decompressobj(31).decompress(head, 4)
            except zlib.error:
                return path.suffix.lower() == self.suffix
        return head.startswith(SPZ_MAGIC)

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        scales = table.log_scales[:, :2]
        outside = int(((scales < MIN_LOG_SCALE) | (scales > MAX_LOG_SCALE)).any(1).sum())
        clipped = (
            f"; splats smaller or larger than it has a place for: {outside:,} of {len(table):,}" if outside else ""
        )
        harmonics = f", spherical harmonics to {self.sh1_bits} and {self.sh_rest_bits} bits" if table.sh_degree else ""
        return f"scales are rounded to 6 %, colours and opacities to 8 bits{harmonics}{clipped}"


def spz_bytes(table: SplatTable, version: Literal[2, 3, 4], where: Path) -> bytes:
    """What a file of splats holds, in the axes of the table, for formats that have SPZ data inside.

    Args:
        table: Finite, on the CPU.
        version: Of the layout.
        where: Begins messages.

    Raises:
        BadInput: Its positions have no place in 24 bits.
    """
    spz = SPZ(version=version)
    return b"".join(spz._packed(table, spz._bits(where, table)))


def spz_table(data: bytes, where: Path) -> SplatTable:
    """The ellipsoids of SPZ data, in the axes that they have there; `where` begins messages.

    Raises:
        BadInput: No such data, or damaged.
    """
    return decoded(where, data)[0]


def half_turn(table: SplatTable) -> SplatTable:
    """The same splats after half a turn about x, which is also the way back."""
    axes = torch.tensor([1, -1, -1])
    signs = torch.tensor(HALF_TURN_SIGNS[: table.sh_rest.shape[1]], dtype=table.sh_rest.dtype)
    return replace(
        table,
        means=table.means * axes,
        quats=torch.cat([table.quats[:, :1], table.quats[:, 1:] * axes], 1),  # the axes of the ellipsoids turn too
        sh_rest=table.sh_rest * signs[:, None],
    )


def _parts(column: Tensor, order: Tensor, encode: Encode) -> Iterator[bytes]:
    """The bytes of one attribute, in pieces."""
    for start in range(0, len(order), WRITTEN_ROWS):
        yield encode(column[order[start : start + WRITTEN_ROWS]].numpy()).tobytes()


def _container(head: bytes, record: bytes, streams: list[Iterator[bytes]], count: int) -> bytes:
    """A file of version 4, with a record of an extension or none."""
    packed, sizes = [], []
    for stream in streams if count else ():
        squeeze, size, pieces = zstandard.ZstdCompressor(level=SPZ_ZSTD_LEVEL).compressobj(), 0, []
        for part in stream:
            size += len(part)
            pieces.append(squeeze.compress(part))
        packed.append(b"".join([*pieces, squeeze.flush()]))
        sizes.append(struct.pack("<QQ", len(packed[-1]), size))
    start = head + struct.pack("<BI12x", len(packed), HEADER + len(record)) + record
    return b"".join([start, *sizes, *packed])


def _positions(means: np.ndarray, bits: int) -> np.ndarray:
    """(n, 3, 3) bytes of numbers of 24 bits, the lowest first."""
    fixed = np.rint(means.astype(np.float64) * 2.0**bits).clip(-(2**23), 2**23 - 1).astype("<i4")
    return fixed[..., None].view(np.uint8)[..., :3]


def _rotations(quats: np.ndarray) -> np.ndarray:
    """(n,) words: the largest of x, y, z, w, and a sign and 9 bits of each other one."""
    largest, three = smallest_three(np.roll(unit(quats), -1, 1))
    size = (np.abs(three) * 511 + 0.5).astype(np.uint32)
    word = largest.astype(np.uint32)
    for column in range(3):
        word = word << 10 | (three[:, column] < 0).astype(np.uint32) << 9 | size[:, column]
    return word.astype("<u4")


def _short_rotations(quats: np.ndarray) -> np.ndarray:
    """(n, 3) bytes of x, y and z of the quaternion whose w is not negative."""
    quats = unit(quats)
    return to_bytes(np.where(quats[:, :1] < 0, -1, 1) * quats[:, 1:] * 127.5 + 127.5)


def _harmonics(rest: np.ndarray, first: int, others: int) -> np.ndarray:
    """(n, K - 1, 3) bytes, rounded to the middle of steps that leave some bits."""
    whole = np.rint(rest.clip(-2, 2) * np.float32(128)).astype(np.int16) + np.int16(128)
    step = np.where(np.arange(whole.shape[1]) < 3, 2 ** (8 - first), 2 ** (8 - others)).astype(np.int16)[:, None]
    return ((whole + step // 2) & -step).clip(0, 255).astype(np.uint8)
