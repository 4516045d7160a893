"""Files of splats of every format, and ways to damage what is compressed in them."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

FORMATS = {
    "compressed-ply": {},
    "gltf": {},
    "gltf-spz": {"compress": "spz"},
    "ply": {},
    "sog": {},
    "splat": {},
    "spz": {"version": 3},
    "spz-4": {"version": 4},
    "surfkit": {},
}
"""Names of formats that are damaged, and their settings."""
SIZES = (0, 1, 2, 3, 15, 255, 256, 2**14 - 1)
"""Widths and heights that an image may claim."""


def write_model(folder: Path, name: str) -> Path:
    """A file of 600 splats."""
    from surfkit.core.registry import find
    from surfkit.io.splats.base import Format
    from surfkit.testing.format_checks import splat_table

    form = find(Format, name.removesuffix("-4").removesuffix("-spz"))(**FORMATS[name])
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"model{form.suffix}"
    form.write(path, splat_table("surfel", 600, 1))
    return path


def inside_gzip(change: Callable[[bytes, Any], bytes]) -> Callable[[Path, Any], None]:
    """A way that changes what is compressed in a gzip file."""

    def way(path: Path, damage: Any) -> None:
        try:
            content = gzip.decompress(path.read_bytes())
        except (OSError, EOFError, ValueError, zlib.error):  # it is of version 4, or damaged already
            return
        path.write_bytes(gzip.compress(change(content, damage), 1))

    return way


def inside_zip(change: Callable[[bytes, Any], bytes], json_only: bool = False) -> Callable[[Path, Any], None]:
    """A way that changes one of the files in an archive."""

    def way(path: Path, damage: Any) -> None:
        try:
            with zipfile.ZipFile(path) as archive:
                members = {name: archive.read(name) for name in archive.namelist()}
        except Exception:  # it is damaged already
            return
        names = [name for name in sorted(members) if name.endswith(".json") == json_only]
        if not names:
            return
        name = names[damage.what // 7 % len(names)]
        members[name] = change(members[name], damage)
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED if damage.what % 3 else zipfile.ZIP_STORED) as archive:
            for each, content in members.items():
                archive.writestr(each, content)
        path.write_bytes(file.getvalue())

    return way


SURFKIT_HEAD = struct.Struct("<8sIIQQQII")


def inside_surfkit(change: Callable[[bytes, Any], bytes], index_only: bool = False) -> Callable[[Path, Any], None]:
    """A way that changes the JSON or a block of a .surfkit file, with checksums that fit."""

    def way(path: Path, damage: Any) -> None:
        import zstandard

        content = path.read_bytes()
        try:
            start = SURFKIT_HEAD.unpack(content[: SURFKIT_HEAD.size])[3]
            text = zstandard.ZstdDecompressor().decompress(content[start:])
            index = json.loads(text)
            entries = [entry["block"] for entry in (*index["tables"].values(), *index["leaves"])]
            block = entries[damage.what // 7 % len(entries)]
            begin, end = block["offset"], block["offset"] + block["length"]
        except Exception:  # it is damaged already
            return
        blocks = bytearray(content[SURFKIT_HEAD.size : start])
        if index_only:
            text = change(text, damage)
        else:
            part = change(content[begin:end], damage)[: end - begin].ljust(end - begin, b"\0")
            blocks[begin - SURFKIT_HEAD.size : end - SURFKIT_HEAD.size] = part
            block["crc"] = zlib.crc32(part)
            text = json.dumps(index).encode()
        path.write_bytes(sealed_surfkit(bytes(blocks), zstandard.ZstdCompressor().compress(text)))

    return way


def sealed_surfkit(blocks: bytes, index: bytes) -> bytes:
    """A .surfkit file with checksums that fit."""
    start = SURFKIT_HEAD.size + len(blocks)
    numbers = struct.pack("<QQQI", start, len(index), start + len(index), zlib.crc32(index))
    head = b"\x89SRFK\r\n\x1a" + struct.pack("<II", 1, zlib.crc32(numbers)) + numbers + bytes(4)
    return head + blocks + index


def inside_glb(change: Callable[[bytes, Any], bytes]) -> Callable[[Path, Any], None]:
    """A way that changes the JSON of a GLB file, and keeps the lengths sound."""

    def way(path: Path, damage: Any) -> None:
        content = path.read_bytes()
        if len(content) < 20 or (end := 20 + struct.unpack_from("<I", content, 12)[0]) > len(content):
            return  # it is damaged already
        text = change(content[20:end], damage)
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(content) - end, len(text), b"JSON")
        path.write_bytes(head + text + content[end:])

    return way


def sized(content: bytes, damage: Any) -> bytes:
    """A WebP image that claims another size."""
    if len(content) < 25 or content[12:16] != b"VP8L":
        return content
    width, height = SIZES[damage.what % len(SIZES)], SIZES[int(damage.at * (len(SIZES) - 0.01))]
    bits = struct.unpack_from("<I", content, 21)[0] & ~0xFFFFFFF | width | height << 14
    return content[:21] + struct.pack("<I", bits) + content[25:]


def in_json(change: Callable[[Any, Any], Any]) -> Callable[[bytes, Any], bytes]:
    """A change of a node of JSON, as one of bytes."""

    def way(content: bytes, damage: Any) -> bytes:
        try:
            return json.dumps(change(json.loads(content), damage)).encode("utf-8", "replace")
        except (ValueError, RecursionError):  # it is damaged already
            return content

    return way
