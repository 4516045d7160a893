"""Arrays of whole numbers as bytes: one plane for each byte of each component, each coded by Zstandard.

A plane holds numbers of one kind, so that the entropy coder sees their distribution; what is all zero takes no room.
docs/surfkit_file.md describes the bytes.

    u8   streams
    then for each stream
        u8   length of its name in bytes, and the name in UTF-8
        u8   bytes of a number: 1, 2, 4 or 8
        u32  components
        u32  rows
        u32  for each plane (component by component, lowest byte first): its bytes below; 0 for all zero; bit 31 is set
             for a plane that is stored as it is
    then the planes, one after the other, as Zstandard frames with their size

All numbers are little endian and unsigned. Planes of more than `MAX_EMPTY_ROWS` rows are never left out, so that nobody
needs more than about 2^17 times the memory of the bytes that are read.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from surfkit.core.check import BadInput

ZSTD_LEVEL = 15
"""Of Zstandard."""
AS_IT_IS = 1 << 31
MAX_COMPONENTS = 4096
MAX_EMPTY_ROWS = 1 << 17
"""Rows of a plane that takes no room."""
MAX_ROWS_PER_BYTE = 1 << 15
"""Of a Zstandard frame: it repeats a byte at most so often for each of its own."""


@dataclass(frozen=True)
class Stored:
    """A stream as it lies in a file: its numbers are decoded when they are asked for, once its shape is known to fit.

    Attributes:
        name: Of the stream.
        dtype: Of its numbers.
        shape: (rows, components).
        planes: Stored bytes of all planes, component by component, lowest byte first.
        lengths: Bytes of each plane, as they stand in the file.
    """

    name: str
    dtype: np.dtype
    shape: tuple[int, int]
    planes: memoryview = field(repr=False)
    lengths: np.ndarray = field(repr=False)

    def numbers(self) -> np.ndarray:
        """(rows, components) numbers, the rows of each component one after the other in memory.

        Raises:
            BadInput: Damaged.
        """
        (rows, components), size = self.shape, self.dtype.itemsize
        found = np.zeros((components, rows), self.dtype)
        split = found.view(np.uint8).reshape(components, rows, size)
        start = 0
        for at, length in enumerate(self.lengths.tolist()):
            stop = start + (length & ~AS_IT_IS)
            if stop > start:
                split[at // size, :, at % size] = self._plane(self.planes[start:stop], length < AS_IT_IS)
            start = stop
        return found.T

    def _plane(self, part: memoryview | bytes, coded: bool) -> np.ndarray:
        import zstandard

        if coded:
            try:
                size = zstandard.frame_content_size(part)
                if size == self.shape[0] <= MAX_EMPTY_ROWS + MAX_ROWS_PER_BYTE * len(part):
                    part = zstandard.ZstdDecompressor().decompress(part, allow_extra_data=False)
                else:
                    part = part[:0]
            except zstandard.ZstdError as error:
                raise BadInput(f"stream {self.name}: {error}") from error
        if len(part) != self.shape[0]:
            raise BadInput(f"stream {self.name} has a plane of another size")
        return np.frombuffer(part, np.uint8)


Streams = Mapping[str, np.ndarray | Stored]
"""Arrays by name, (rows, components) of an unsigned type each; those of a file are not decoded yet."""


def array(stream: np.ndarray | Stored) -> np.ndarray:
    """The (rows, components) numbers of a stream; BadInput if it is damaged."""
    return stream.numbers() if isinstance(stream, Stored) else stream


def packed(streams: Streams) -> bytes:
    """The bytes of arrays, each (rows, components) of an unsigned type."""
    import zstandard

    coder = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
    head, body = [struct.pack("<B", len(streams))], []
    for name, stream in streams.items():
        numbers = array(stream)
        if numbers.dtype.kind != "u" or numbers.ndim != 2 or numbers.shape[1] > MAX_COMPONENTS:
            raise TypeError(
                f"stream {name}: {numbers.dtype} {numbers.shape}; it must be unsigned, with two axes and at most "
                f"{MAX_COMPONENTS} components"
            )
        rows, components = numbers.shape
        size = numbers.dtype.itemsize
        title = name.encode()
        head.append(struct.pack("<B", len(title)) + title + struct.pack("<BII", size, components, rows))
        split = np.ascontiguousarray(numbers.astype(f"<u{size}", copy=False).T).view(np.uint8)
        for plane in split.reshape(components, rows, size).transpose(0, 2, 1).reshape(components * size, rows):
            if rows <= MAX_EMPTY_ROWS and not plane.any():
                head.append(struct.pack("<I", 0))
                continue
            plain = plane.tobytes()
            coded = coder.compress(plain)
            small = len(coded) < len(plain)
            body.append(coded if small else plain)
            head.append(struct.pack("<I", len(coded) if small else len(plain) | AS_IT_IS))
    return b"".join(head + body)


def unpacked(data: bytes | memoryview, most_rows: int) -> dict[str, Stored]:
    """The streams of `packed`, not decoded yet.

    Raises:
        BadInput: Damaged, or an array of more than `most_rows` rows; without the name of the file.
    """
    data, found, at = memoryview(data), {}, 1
    try:
        for _ in range(struct.unpack_from("<B", data)[0]):
            length = struct.unpack_from("<B", data, at)[0]
            name = bytes(data[at + 1 : at + 1 + length]).decode()
            size, components, rows = struct.unpack_from("<BII", data, at + 1 + length)
            at += 1 + length + 9
            if size not in (1, 2, 4, 8) or components > MAX_COMPONENTS or rows > most_rows or name in found:
                raise BadInput(f"stream {name!r} has {rows} x {components} numbers of {size} bytes, or is there twice")
            found[name] = (size, components, rows, np.frombuffer(data, "<u4", components * size, at))
            at += 4 * components * size
    except (struct.error, ValueError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput("the heads of its streams are damaged") from error
    streams = {}
    for name, (size, components, rows, lengths) in found.items():
        start, at = at, at + int((lengths & np.uint32(~AS_IT_IS & 0xFFFFFFFF)).sum(dtype=np.int64))
        if at > len(data):
            raise BadInput(f"stream {name} is cut off")
        if rows > MAX_EMPTY_ROWS and not lengths.all():
            raise BadInput(f"stream {name} of {rows} rows lacks a plane")
        streams[name] = Stored(name, np.dtype(f"<u{size}"), (rows, components), data[start:at], lengths)
    if at != len(data):
        raise BadInput(f"{len(data) - at} bytes after the last stream")
    return streams
