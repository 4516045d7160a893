"""The file format `.surfkit`: a compressed model, leaf by leaf; docs/surfkit_file.md describes it byte by byte.

    8 bytes   89 'S' 'R' 'F' 'K' 0D 0A 1A
    u32       version of the format
    u32       CRC-32 of the four numbers that follow
    u64 u64   where the index begins, and its bytes
    u64       bytes of the whole file
    u32 u32   CRC-32 of the index, and 0
    ...       blocks: the streams of a leaf or of a table
    index     JSON in UTF-8, as one Zstandard frame

Numbers are little endian.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.compress.encoding import ColumnType, Encoding
from surfkit.compress.octree import MOST
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, from_json, load
from surfkit.primitives.base import Primitive
from surfkit.scene.scene import Frame

MAGIC = b"\x89SRFK\r\n\x1a"
VERSION = 1
HEAD = struct.Struct("<8sIIQQQII")
MOST_INDEX = 1 << 28
"""Bytes of an index that is read."""
MOST_POINTS_A_BYTE = 1_000
"""A file that claims more is damaged: even points that are all alike take more room."""
TABLE_TYPES = {"float16": "u2", "float32": "u4", "float64": "u8", "uint8": "u1", "uint16": "u2"}


@dataclass(frozen=True)
class Block:
    """A part of the file with a checksum of its own.

    Attributes:
        offset, length: Its bytes.
        crc: CRC-32 of them.
    """

    offset: int
    length: int
    crc: int


@dataclass(frozen=True)
class TableEntry:
    """What the index says of a table; shared parameters are tables too, named "shared.NAME"."""

    dtype: str
    shape: tuple[int, ...]
    block: Block


@dataclass(frozen=True)
class LeafEntry:
    """What the index says of a leaf."""

    points: int
    exponent: int
    corner: tuple[int, int, int]
    finest: int
    block: Block


@dataclass(frozen=True)
class ColumnEntry:
    """What the index says of a column."""

    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class Place:
    """Where the local frame of the model lies: see `scene.Frame`."""

    origin: tuple[float, float, float]
    scale: float
    metres: float | None
    crs: str | None
    shift: tuple[float, float, float]


@dataclass(frozen=True)
class Index:
    """What the file says of itself.

    Attributes:
        writer: The program.
        points: In all leaves.
        primitive, sh_degree, near: See `SplatModel`.
        frame: None where the model lies in no data set's frame.
        compressor: What chose the encodings; reading does not need it.
        columns: Of a point.
        encodings: Together they take every column once.
        tables, leaves: Where they lie.
    """

    writer: str
    points: int
    primitive: Primitive
    sh_degree: int
    near: float
    frame: Place | None
    compressor: dict[str, Any]
    columns: dict[str, ColumnEntry]
    encodings: tuple[Encoding, ...]
    tables: dict[str, TableEntry]
    leaves: tuple[LeafEntry, ...]

    def refuse_unsound(self, size: int) -> None:
        """BadInput if the index does not describe a file of `size` bytes."""
        if self.points != sum(leaf.points for leaf in self.leaves):
            raise BadInput(f"its leaves have {sum(leaf.points for leaf in self.leaves)} points, not {self.points}")
        if self.points > MOST_POINTS_A_BYTE * size:
            raise BadInput(f"{self.points} points cannot be in {size} bytes")
        declared, shared = self.primitive.columns(), self.primitive.shared()
        wanted = {name: column.shape for name, column in declared.items() if name not in shared}
        if wanted != {name: column.shape for name, column in self.columns.items()}:
            raise BadInput(f"columns {', '.join(self.columns)}; the primitive has {', '.join(wanted)}, or other shapes")
        if any(column.dtype not in ("float32", "float64") for column in self.columns.values()):
            raise BadInput("a column of numbers that are neither float32 nor float64")
        refuse_unencoded(self.encodings, self.columns)
        lacking = {f"shared.{name}" for name in shared} - set(self.tables)
        if lacking:
            raise BadInput(f"table {min(lacking)} is missing")
        for name, table in self.tables.items():
            if table.dtype not in TABLE_TYPES or any(axis < 0 for axis in table.shape):
                raise BadInput(f"table {name}: {table.dtype} {table.shape}; types are {', '.join(TABLE_TYPES)}")
        for at, leaf in enumerate(self.leaves):
            fits = 0 < leaf.points <= MOST and abs(leaf.exponent) < 1000 and leaf.finest <= leaf.exponent
            if not fits or any(abs(corner) > 1 << 54 for corner in leaf.corner):
                raise BadInput(f"leaf {at}: {leaf.points} points in a cube of side 2^{leaf.exponent} at {leaf.corner}")
        for block in [*(table.block for table in self.tables.values()), *(leaf.block for leaf in self.leaves)]:
            if block.offset < HEAD.size or block.length < 0 or block.offset + block.length > size:
                raise BadInput("a block lies outside of the file")


def place_of(frame: Frame | None) -> Place | None:
    """A frame as the index has it."""
    if frame is None:
        return None
    origin = tuple(float(value) for value in frame.origin)
    return Place(origin, frame.scale, frame.metres, frame.crs, tuple(float(value) for value in frame.shift))


def refuse_unencoded(encodings: tuple[Encoding, ...], columns: Mapping[str, ColumnType | ColumnEntry]) -> None:
    """BadInput unless every column is taken by one encoding, and no other."""
    taken = [name for encoding in encodings for name in encoding.columns]
    wrong = [name for name in columns if taken.count(name) != 1] + [name for name in taken if name not in columns]
    if wrong:
        raise BadInput(f"column {wrong[0]} must be taken by one encoding; they take {', '.join(taken)}")


def index_bytes(index: Index) -> bytes:
    """As it stands in the file."""
    import zstandard

    text = json.dumps(dump(index), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return zstandard.ZstdCompressor(level=15).compress(text.encode())


def head_bytes(start: int, index: bytes) -> bytes:
    """What a file begins with, whose index begins at `start`."""
    numbers = struct.pack("<QQQI", start, len(index), start + len(index), zlib.crc32(index))
    return HEAD.pack(MAGIC, VERSION, zlib.crc32(numbers), *struct.unpack("<QQQI", numbers), 0)


def read_index(data: memoryview) -> Index:
    """The index of a file.

    Raises:
        BadInput: Not such a file, damaged, or of another version; without its name.
    """
    import zstandard

    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise BadInput("no .surfkit file: it does not begin as one")
    if len(data) < HEAD.size:
        raise BadInput("cut off within its head")
    _, version, head_crc, start, length, size, crc, _ = HEAD.unpack(data[: HEAD.size])
    if version != VERSION:
        raise BadInput(f"version {version} of the format; this surfkit reads version {VERSION}; install a newer one")
    if zlib.crc32(data[16 : HEAD.size - 4]) != head_crc:
        raise BadInput("its head is damaged (checksum)")
    if size != len(data):
        raise BadInput(f"has {len(data)} bytes, not {size}: cut off, or not copied whole")
    if length > MOST_INDEX or start + length > size or zlib.crc32(data[start : start + length]) != crc:
        raise BadInput("its index is damaged (checksum)")
    part = data[start : start + length]
    try:
        if zstandard.frame_content_size(part) > MOST_INDEX:
            raise BadInput("an index of more than 256 MB")
        index = load(Index, from_json(zstandard.ZstdDecompressor().decompress(part).decode()))
        index.refuse_unsound(size)
    except (zstandard.ZstdError, UnicodeDecodeError, BadInput) as error:
        raise BadInput(f"its index cannot be used: {error}") from error
    return index
