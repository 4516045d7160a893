"""Arrays of whole numbers as bytes: one plane for each byte of each component, each coded by Zstandard.

A plane holds numbers of one kind, so that the entropy coder sees their distribution; what is all zero takes no room.

    u8   streams
    then for each stream
        u8   length of its name, and the name in ASCII
        u8   bytes of a number: 1, 2, 4 or 8
        u32  components
        u32  rows
        u32  for each plane (component by component, lowest byte first): its bytes below; 0 for all zero; bit 31 is set
             for a plane that is stored as it is
    then the planes, one after the other, as Zstandard frames with their size

All numbers are little endian and unsigned.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np

from surfkit.core.check import BadInput

LEVEL = 15
"""Of Zstandard."""
AS_IT_IS = 1 << 31
MOST_COMPONENTS = 4096
Streams = dict[str, np.ndarray]


def packed(streams: Mapping[str, np.ndarray]) -> bytes:
    """The bytes of arrays, each (rows, components) of an unsigned type."""
    import zstandard

    coder = zstandard.ZstdCompressor(level=LEVEL)
    head, body = [struct.pack("<B", len(streams))], []
    for name, numbers in streams.items():
        if numbers.dtype.kind != "u" or numbers.ndim != 2:
            raise TypeError(f"stream {name}: {numbers.dtype} {numbers.shape}; it must be unsigned with two axes")
        rows, components = numbers.shape
        size = numbers.dtype.itemsize
        head.append(struct.pack("<B", len(name)) + name.encode("ascii") + struct.pack("<BII", size, components, rows))
        split = np.ascontiguousarray(numbers.astype(f"<u{size}", copy=False).T).view(np.uint8)
        for plane in split.reshape(components, rows, size).transpose(0, 2, 1).reshape(components * size, rows):
            if not plane.any():
                head.append(struct.pack("<I", 0))
                continue
            plain = plane.tobytes()
            coded = coder.compress(plain)
            small = len(coded) < len(plain)
            body.append(coded if small else plain)
            head.append(struct.pack("<I", len(coded) if small else len(plain) | AS_IT_IS))
    return b"".join(head + body)


def unpacked(data: bytes | memoryview, most_rows: int) -> Streams:
    """The arrays of `packed`.

    Raises:
        BadInput: Damaged, or an array of more than `most_rows` rows; without the name of the file.
    """
    import zstandard

    coder = zstandard.ZstdDecompressor()
    try:
        shapes, at = _heads(data, most_rows)
        streams = {}
        for name, size, components, rows, lengths in shapes:
            planes = np.zeros((components * size, rows), np.uint8)
            for plane, length in zip(planes, lengths, strict=True):
                stored = length & ~AS_IT_IS
                part = data[at : at + stored]
                at += stored
                if len(part) < stored:
                    raise BadInput(f"stream {name} is cut off")
                if length & AS_IT_IS:
                    plane[:] = np.frombuffer(part, np.uint8)
                elif length:
                    if zstandard.frame_content_size(part) != rows:
                        raise BadInput(f"stream {name} has a plane of another size")
                    plane[:] = np.frombuffer(coder.decompress(part), np.uint8)
            split = planes.reshape(components, size, rows).transpose(2, 0, 1).tobytes()
            streams[name] = np.frombuffer(split, f"<u{size}").reshape(rows, components)
    except (struct.error, ValueError, UnicodeDecodeError, zstandard.ZstdError) as error:
        raise BadInput(str(error) or "damaged streams") from error
    if at != len(data):
        raise BadInput(f"{len(data) - at} bytes after the last stream")
    return streams


def _heads(data: bytes | memoryview, most_rows: int) -> tuple[list[tuple[str, int, int, int, tuple[int, ...]]], int]:
    """Name, bytes of a number, components, rows and lengths of planes of each stream, and where the planes begin."""
    found, at = [], 1
    for _ in range(data[0] if len(data) else 0):
        length = struct.unpack_from("<B", data, at)[0]
        name = bytes(data[at + 1 : at + 1 + length]).decode("ascii")
        size, components, rows = struct.unpack_from("<BII", data, at + 1 + length)
        at += 1 + length + 9
        if size not in (1, 2, 4, 8) or components > MOST_COMPONENTS or rows > most_rows:
            raise BadInput(f"stream {name!r} has {rows} x {components} numbers of {size} bytes")
        found.append((name, size, components, rows, struct.unpack_from(f"<{components * size}I", data, at)))
        at += 4 * components * size
    return found, at
