"""Compressed bytes of files that may be damaged or made to harm: nothing is allocated that they do not hold."""

from __future__ import annotations

import zlib
from pathlib import Path

import zstandard

from surfkit.core.check import BadInput

MAX_EXPANSION = 1024
"""Times that compressed bytes may grow: about what gzip can do, far more than splats do."""
MAX_TRAILING_BYTES = 1 << 16
"""Bytes of extensions that may follow the splats in a gzip stream."""
ALWAYS_ALLOWED_BYTES = 1 << 22
"""Bytes that may be allocated whatever the size of the file."""


def refuse_implausible(path: Path, packed: int, size: int, most: int = MAX_EXPANSION) -> None:
    """BadInput if a file says that some of its bytes become more than `most` times as many."""
    if size > most * packed + ALWAYS_ALLOWED_BYTES:
        raise BadInput(f"{path}: damaged: {packed:,} bytes cannot hold {size:,}; write or copy it again")


def inflated(path: Path, data: bytes, size: int, part: bool = False) -> bytes:
    """The `size` bytes of a gzip stream, with up to BEHIND that follow them; with `part` the first ones alone, whatever
    comes then."""
    refuse_implausible(path, len(data), size)
    stream = zlib.decompressobj(31)
    try:
        found = stream.decompress(data, size)
        if not part and not stream.eof:
            found += stream.decompress(stream.unconsumed_tail, MAX_TRAILING_BYTES)
    except zlib.error as error:
        raise BadInput(f"{path}: damaged: {error}; write or copy it again") from error
    if len(found) < size or not (part or stream.eof):
        raise BadInput(f"{path}: cut off or damaged: not the {size:,} bytes that its header asks for; copy it again")
    return found


def unpacked_zstd(path: Path, data: bytes, size: int) -> bytes:
    """The `size` bytes of a zstd frame."""
    refuse_implausible(path, len(data), size)
    try:
        known = zstandard.frame_content_size(data)
        if known not in (-1, size):
            raise BadInput(f"{path}: damaged: {known:,} bytes in place of {size:,}; write or copy it again")
        found = zstandard.ZstdDecompressor().decompress(data, max_output_size=size) if size else b""
    except zstandard.ZstdError as error:
        raise BadInput(f"{path}: damaged: {error}; write or copy it again") from error
    if len(found) != size:
        raise BadInput(f"{path}: cut off: {len(found):,} of {size:,} bytes; write or copy it again")
    return found
