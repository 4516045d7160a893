"""The file format `.surfkit`: a compressed model, leaf by leaf; docs/surfkit_file.md describes it byte by byte.

    8 bytes   89 'S' 'R' 'F' 'K' 0D 0A 1A
    u32       version of the format
    u32       CRC-32 of the four numbers that follow
    u64 u64   where the index begins, and its bytes
    u64       bytes of the whole file
    u32 u32   CRC-32 of the index, and 0
    ...       blocks, one after the other without gaps: the streams of a table or of a leaf
    index     JSON in UTF-8, as one Zstandard frame

Numbers are little endian.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.compress.encoding import ColumnType, Encoding
from surfkit.compress.octree import MAX_LEAF_POINTS
from surfkit.compress.streams import MAX_COMPONENTS
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, from_json, load
from surfkit.primitives.base import Primitive
from surfkit.scene.scene import Frame

CONTAINER_MAGIC = b"\x89SRFK\r\n\x1a"
CONTAINER_VERSION = 1
HEADER_STRUCT = struct.Struct("<8sIIQQQII")
MAX_INDEX_BYTES = 1 << 28
"""Bytes of an index that is read."""
MAX_INDEX_EXPANSION, MIN_INDEX_BYTES = 64, 1 << 16
"""Bytes of JSON for each stored byte of an index, and what is allowed in any case: real ones have 10 or fewer."""
MAX_POINTS_PER_BYTE = 1 << 12
"""Of a leaf: one that claims more is damaged, as even points that are all alike take more room."""
MAX_NUMBERS_PER_BYTE = 1 << 17
"""Of a table, likewise."""
MAX_TABLE_AXES = 8
"""Of a table."""
TABLE_TYPES = {"float16": "u2", "float32": "u4", "float64": "u8", "uint8": "u1", "uint16": "u2"}


@dataclass(frozen=True)
class ChecksummedBlock:
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
    block: ChecksummedBlock


@dataclass(frozen=True)
class LeafEntry:
    """What the index says of a leaf."""

    points: int
    exponent: int
    corner: tuple[int, int, int]
    finest: int
    block: ChecksummedBlock


@dataclass(frozen=True)
class ColumnEntry:
    """What the index says of a column."""

    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class FrameEntry:
    """Where the local frame of the model lies: see `scene.Frame`."""

    origin: tuple[float, float, float]
    scale: float
    metres: float | None
    crs: str | None
    shift: tuple[float, float, float]

    def refuse_unsound(self) -> None:
        """BadInput for a frame that nothing can lie in."""
        lengths = [self.scale] if self.metres is None else [self.scale, self.metres]
        if not all(map(math.isfinite, (*self.origin, *self.shift))) or not all(0 < each < math.inf for each in lengths):
            raise BadInput("a frame whose numbers are NaN, Inf, or lengths of 0 or less")


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
    frame: FrameEntry | None
    compressor: dict[str, Any]
    columns: dict[str, ColumnEntry]
    encodings: tuple[Encoding, ...]
    tables: dict[str, TableEntry]
    leaves: tuple[LeafEntry, ...]

    def refuse_unsound(self, start: int) -> None:
        """BadInput if the index does not describe a file in which it begins at byte `start`."""
        if self.points != sum(leaf.points for leaf in self.leaves):
            raise BadInput(f"its leaves have {sum(leaf.points for leaf in self.leaves)} points, not {self.points}")
        if self.sh_degree not in range(self.primitive.sh_degree + 1) or not 0 <= self.near < math.inf:
            raise BadInput(f"sh_degree {self.sh_degree} or near {self.near:g} that no model has")
        if self.frame is not None:
            self.frame.refuse_unsound()
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
            fits = all(axis >= 0 for axis in table.shape) and len(table.shape) <= MAX_TABLE_AXES
            if not fits or math.prod(table.shape) > MAX_NUMBERS_PER_BYTE * table.block.length:
                raise BadInput(f"table {name}: a shape of {table.shape} in {table.block.length} bytes")
            if table.dtype not in TABLE_TYPES:
                raise BadInput(f"table {name}: numbers of {table.dtype}; types are {', '.join(TABLE_TYPES)}")
        for at, leaf in enumerate(self.leaves):
            fits = 0 < leaf.points <= min(MAX_LEAF_POINTS, MAX_POINTS_PER_BYTE * leaf.block.length)
            fits &= abs(leaf.exponent) < 1000 and leaf.finest <= leaf.exponent
            if not fits or any(abs(corner) > 1 << 54 for corner in leaf.corner):
                raise BadInput(f"leaf {at}: {leaf.points} points in a cube of side 2^{leaf.exponent} at {leaf.corner}")
        end = HEADER_STRUCT.size
        for block in [*(table.block for table in self.tables.values()), *(leaf.block for leaf in self.leaves)]:
            if block.offset != end or block.length < 0:
                raise BadInput(f"a block of {block.length} bytes begins at {block.offset}, not at {end}")
            end += block.length
        if end != start:
            raise BadInput(f"its blocks end at {end}, not at {start} where the index begins")


def place_of(frame: Frame | None) -> FrameEntry | None:
    """A frame as the index has it."""
    if frame is None:
        return None

    def three(place: Iterable[float]) -> tuple[float, float, float]:
        x, y, z = place
        return float(x), float(y), float(z)

    return FrameEntry(three(frame.origin), frame.scale, frame.metres, frame.crs, three(frame.shift))


def refuse_unencoded(encodings: tuple[Encoding, ...], columns: Mapping[str, ColumnType | ColumnEntry]) -> None:
    """BadInput unless every column is taken by one encoding, and no other."""
    taken = [name for encoding in encodings for name in encoding.columns]
    wrong = [name for name in columns if taken.count(name) != 1] + [name for name in taken if name not in columns]
    if wrong:
        raise BadInput(f"column {wrong[0]} must be taken by one encoding; they take {', '.join(taken)}")


def table_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and components of the stream of a table: its last axis gives the components, if it has 4096 or fewer."""
    components = shape[-1] if shape and 0 < shape[-1] <= MAX_COMPONENTS else 1
    return math.prod(shape) // components, components


def index_bytes(index: Index) -> bytes:
    """As it stands in the file."""
    import zstandard

    text = json.dumps(dump(index), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return zstandard.ZstdCompressor(level=15).compress(text.encode())


def head_bytes(start: int, index: bytes) -> bytes:
    """What a file begins with, whose index begins at `start`."""
    numbers = struct.pack("<QQQI", start, len(index), start + len(index), zlib.crc32(index))
    return HEADER_STRUCT.pack(
        CONTAINER_MAGIC, CONTAINER_VERSION, zlib.crc32(numbers), *struct.unpack("<QQQI", numbers), 0
    )


def read_index(data: memoryview) -> Index:
    """The index of a file.

    Raises:
        BadInput: Not such a file, damaged, or of another version; without its name.
    """
    import zstandard

    if bytes(data[: len(CONTAINER_MAGIC)]) != CONTAINER_MAGIC:
        raise BadInput("no .surfkit file: it does not begin as one")
    if len(data) < HEADER_STRUCT.size:
        raise BadInput("cut off within its head")
    _, version, head_crc, start, length, size, crc, _ = HEADER_STRUCT.unpack(data[: HEADER_STRUCT.size])
    if version != CONTAINER_VERSION:
        raise BadInput(
            f"version {version} of the format; this surfkit reads version {CONTAINER_VERSION}; install a newer one"
        )
    if zlib.crc32(data[16 : HEADER_STRUCT.size - 4]) != head_crc:
        raise BadInput("its head is damaged (checksum)")
    if size != len(data):
        raise BadInput(f"has {len(data)} bytes, not {size}: cut off, or not copied whole")
    if start < HEADER_STRUCT.size or start + length != size or zlib.crc32(data[start : start + length]) != crc:
        raise BadInput("its index is damaged (checksum)")
    part = data[start : start + length]
    try:
        unpacked = zstandard.frame_content_size(part)
        if unpacked > min(MAX_INDEX_BYTES, MIN_INDEX_BYTES + MAX_INDEX_EXPANSION * length):
            raise BadInput(f"{unpacked} bytes of JSON in {length} bytes")
        text = zstandard.ZstdDecompressor().decompress(part, allow_extra_data=False)
        index = load(Index, from_json(text.decode()))
        index.refuse_unsound(start)
    except (zstandard.ZstdError, UnicodeDecodeError, BadInput) as error:
        raise BadInput(f"its index cannot be used: {error}") from error
    return index
