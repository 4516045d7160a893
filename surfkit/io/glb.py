"""GLB containers: the JSON of a glTF document, and one block of bytes.

Source: glTF 2.0 specification, chapter 4, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import from_json
from surfkit.core.files import replacing
from surfkit.scene.srgb import linear

GLB_MAGIC = b"glTF"
MAX_GLB_BYTES = (1 << 32) - 1
"""A GLB file says its length in 32 bits."""
MAX_JSON_BYTES = 1 << 26
"""Bytes of JSON that are read: a file of splats has some thousands."""
MAX_JSON_NUMBER = 1e30
"""Larger numbers in the JSON are damage."""
ACCESSOR_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Scalars of accessors, as numpy calls them."""
ACCESSOR_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
UNSIGNED_BYTE, UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5121, 5123, 5125, 5126
"""Types of components, without a sign but FLOAT."""
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views."""
UNLIT = "KHR_materials_unlit"
"""The extension for what is to be shown as it is: photographs have the light of the day in them."""


@dataclass
class GlbWriter:
    """The bytes of a file to be written, one accessor or buffer view after the other; made only while it is written.

    Attributes:
        views: `bufferViews` of the document.
        accessors: `accessors` of the document.
    """

    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    makers: list[Callable[[], bytes]] = field(default_factory=list)

    def add(self, length: int, make: Callable[[], bytes], **more: Any) -> int:
        """Take `length` bytes, which `make` makes later, and return the index of their buffer view."""
        start = self.length
        self.views.append({"buffer": 0, "byteOffset": start, "byteLength": length, **more})
        self.makers.append(make)
        return len(self.views) - 1

    def accessor(self, view: int | None, **about: Any) -> int:
        """Index of a new accessor, `about` in its JSON, of a buffer view; None where an extension has the values."""
        self.accessors.append(about if view is None else {"bufferView": view, **about})
        return len(self.accessors) - 1

    @property
    def length(self) -> int:
        """Bytes so far; each view begins at a multiple of 4."""
        if not self.views:
            return 0
        end = self.views[-1]["byteOffset"] + self.views[-1]["byteLength"]
        return end + -end % 4


def linear_colors(srgb: np.ndarray) -> np.ndarray:
    """(N, 3) float32 for COLOR_0, of (N, 3) uint8 as they are on a screen.

    glTF has linear colours there: 8 bits would be too few for dark ones, and MeshLab reads 16 bits as noise.
    """
    return linear(np.arange(256) / 255).astype("<f4")[srgb]


def glb(where: str | Path, document: dict[str, Any], blocks: GlbWriter, remedy: str) -> Iterator[bytes]:
    """A document with its bytes, as a GLB file has them, part after part.

    Args:
        where: What it is, for the message.
        document: Without buffers, bufferViews and accessors, which are added.
        blocks: Of these.
        remedy: What to do where it is too large, for the message.

    Raises:
        BadInput: More than 4 GiB; before anything else.
        ValueError: A number that is written is NaN or Inf, which glTF forbids: what calls this is wrong.
    """
    if blocks.views:
        buffers = {"buffers": [{"byteLength": blocks.length}], "bufferViews": blocks.views}
        document = {**document, **buffers, "accessors": blocks.accessors}
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + (8 + blocks.length if blocks.views else 0)
    if total > MAX_GLB_BYTES:
        raise BadInput(f"{where}: {total} bytes; a GLB file has at most {MAX_GLB_BYTES}: {remedy}")
    yield struct.pack("<4sII", GLB_MAGIC, 2, total) + struct.pack("<I4s", len(text), b"JSON") + text
    if blocks.views:
        yield struct.pack("<I4s", blocks.length, b"BIN\0")
    floats = {
        about["bufferView"] for about in blocks.accessors if about["componentType"] == FLOAT and "bufferView" in about
    }
    for at, (view, make) in enumerate(zip(blocks.views, blocks.makers, strict=True)):
        data = make()
        assert len(data) == view["byteLength"]
        if at in floats and not np.isfinite(np.frombuffer(data, "<f4")).all():
            raise ValueError(f"{where}: bufferViews[{at}] would have NaN or Inf, which glTF forbids")
        yield data + b"\0" * (-len(data) % 4)


def write_glb(path: Path, document: dict[str, Any], blocks: GlbWriter, remedy: str) -> None:
    """Save what `glb` gives as a file, which appears only when it is complete."""
    with replacing(path) as file:
        file.writelines(glb(path, document, blocks, remedy))


def read_glb(path: Path) -> GltfDocument:
    """The document of a GLB file.

    Raises:
        BadInput: Not such a file, or damaged.
    """
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    raw = data.data
    if bytes(raw[:4]) != GLB_MAGIC:
        raise BadInput(f"{path}: no GLB file: it does not begin with 'glTF'; a .gltf must be made a .glb first")
    if len(raw) < 20:
        raise BadInput(f"{path}: cut off after {len(raw)} bytes; write or copy it again")
    version, total, size, kind = struct.unpack_from("<III4s", raw, 4)
    if version != 2:
        raise BadInput(f"{path}: version {version} of glTF; only 2 is read")
    if len(raw) < total:
        raise BadInput(f"{path}: cut off after {len(raw)} of {total} bytes; write or copy it again")
    if kind != b"JSON" or not 20 + size <= total or size > MAX_JSON_BYTES:
        raise BadInput(f"{path}: damaged: it does not begin with JSON of a plausible length; write or copy it again")
    try:
        found = from_json(bytes(raw[20 : 20 + size]).decode("utf-8"))
    except ValueError as error:  # BadInput, bytes that are no UTF-8
        raise BadInput(f"{path}: damaged: {error}; write or copy it again") from error
    if not isinstance(found, dict):
        raise BadInput(f"{path}: damaged: its JSON is no object; write or copy it again")
    block, at = memoryview(b""), 20 + size
    if at + 8 <= total:
        length, kind = struct.unpack_from("<I4s", raw, at)
        if kind == b"BIN\0":
            if at + 8 + length > total:
                raise BadInput(f"{path}: damaged: {length} bytes of data do not fit; write or copy it again")
            block = raw[at + 8 : at + 8 + length]
    return GltfDocument(Path(path), found, block)


@dataclass(frozen=True)
class GltfDocument:
    """A glTF document that was read, with what every access to it has to check.

    Attributes:
        path: For messages.
        root: The JSON.
        block: The bytes that its buffer has.
    """

    path: Path
    root: dict[str, Any]
    block: memoryview

    def fault(self, what: str) -> BadInput:
        """An error that names the file."""
        return BadInput(f"{self.path}: {what}")

    def entry(self, *keys: str) -> Any:
        """The value at a path of keys from the root; None where there is none."""
        found: Any = self.root
        for key in keys:
            found = found.get(key) if isinstance(found, dict) else None
        return found

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """An element of one of the top-level lists, such as ("nodes", 0)."""
        found = self.root.get(kind)
        if not isinstance(found, list) or type(index) is not int or not 0 <= index < len(found):
            raise self.fault(f"damaged: there is no {kind}[{index!r}]"[:200])
        if not isinstance(found[index], dict):
            raise self.fault(f"damaged: {kind}[{index}] is no object")
        return found[index]

    def view(self, index: Any) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride; 0 for none."""
        view = self.item("bufferViews", index)
        start, length, stride = (view.get(key, 0) for key in ("byteOffset", "byteLength", "byteStride"))
        if any(type(value) is not int or value < 0 for value in (start, length, stride)):
            raise self.fault(f"damaged: bufferViews[{index}] has no sound offset, length and stride")
        if view.get("buffer") != 0 or "uri" in self.item("buffers", 0):
            raise self.fault(f"bufferViews[{index}] lies in another file; only data within the file are read")
        if start + length > len(self.block):
            raise self.fault(f"damaged: bufferViews[{index}] lies beyond the end of the data; write or copy it again")
        return self.block[start : start + length], stride

    def values(self, index: Any, kind: str, count: int | None = None) -> np.ndarray:
        """(count, width) float32 values of an accessor.

        Args:
            index: Of the accessor.
            kind: Such as "VEC3".
            count: How many there must be; None for any.
        """
        accessor = self.item("accessors", index)
        scalar, number, start = accessor.get("componentType"), accessor.get("count"), accessor.get("byteOffset", 0)
        dtype = np.dtype(ACCESSOR_TYPES[scalar]) if type(scalar) is int and scalar in ACCESSOR_TYPES else None
        if accessor.get("type") != kind or dtype is None:
            shown = f"{accessor.get('type')!r} of {scalar!r}"[:80]
            raise self.fault(f"accessors[{index}] is {shown}; {kind} is needed, of one of {sorted(ACCESSOR_TYPES)}")
        if type(number) is not int or number < 1 or (count is not None and number != count):
            wanted = f", not {count}" if count else ""
            raise self.fault(f"damaged: accessors[{index}] has {number!r} values{wanted}"[:200])
        if "sparse" in accessor or type(start) is not int or start < 0:
            raise self.fault(f"accessors[{index}] is sparse or damaged; only plain values are read")
        data, stride = self.view(accessor.get("bufferView"))
        row = dtype.itemsize * ACCESSOR_WIDTHS[kind]
        stride = stride or row
        if stride < row or start + (number - 1) * stride + row > len(data):
            raise self.fault(f"damaged: accessors[{index}] goes beyond its data; write or copy it again")
        shape, steps = (number, ACCESSOR_WIDTHS[kind]), (stride, dtype.itemsize)
        values = np.ndarray(shape, dtype, data, start, steps)
        if not np.isfinite(values).all():
            raise self.fault(f"damaged: accessors[{index}] has NaN or Inf; write or copy it again")
        values = values.astype(np.float32)
        if accessor.get("normalized") is True and dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(dtype).max, -1 if dtype.kind == "i" else 0)
        return values

    def numbers(self, values: Any, count: int, what: str) -> np.ndarray:
        """(count,) float64 of a list in the JSON."""
        if not isinstance(values, Sequence) or len(values) != count:
            raise self.fault(f"damaged: {what} is no list of {count} numbers")
        if any(type(value) not in (int, float) or not abs(value) < MAX_JSON_NUMBER for value in values):
            raise self.fault(f"damaged: {what} is no list of {count} numbers")
        return np.array(values, np.float64)
