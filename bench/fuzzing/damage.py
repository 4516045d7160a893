"""Ways in which the files that surfkit reads can be damaged, drawn by hypothesis."""

from __future__ import annotations

import json
import re
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from . import splats

BYTES = (
    b"\xff" * 8, b"\0" * 8, b"\xff\xff\xff\x7f", struct.pack("<Q", 2**33), struct.pack("<Q", 2**62),
    struct.pack("<d", float("nan")), struct.pack("<d", float("inf")), struct.pack("<d", 1e308), b"\n", b"\0", b" ",
    b"../../../outside/x\0", b"/etc/passwd\0", b"\xff\xfe", b"\x80", b"PK\x03\x04", b"\x93NUMPY", b"ply\n", b"[" * 3000,
)  # fmt: skip
WORDS = (
    "nan", "inf", "-inf", "-1", "0", "1", "2", "3.5", "1e308", "1e-320", "4294967296", "99999999999999999999999", "-0",
    "", "x", "../../../outside/x", "/etc/passwd", ".", "..", "a" * 5000, "\0", "PINHOLE", "OPENCV", "FOV",
    "OPENCV_FISHEYE", "EQUIRECTANGULAR", "THIN_PRISM_FISHEYE", "true", "[", "1_000", "0x10", "\u0663", "\u00b2",
    "9" * 5000, "float", "list", "element", "end_header", "#",
)  # fmt: skip
VALUES = (
    None, True, False, 0, -1, 3, 2**31, 2**63, 10**30, 10**400, 0.5, 1e308, 1e-320, float("nan"), float("inf"), "", "x",
    "nan", "../../../outside/x", "/etc/passwd", ".", "..", "a" * 5000, "\ud800", "\0", "OPENCV", "brown", "fisheye", [],
    {}, [1, 2, 3], [[1.0] * 4] * 4, [[0.0] * 4] * 4, [[1e200] * 4] * 4, ["a"], {"a": None}, {"use": "adc"},
)  # fmt: skip
DEEP = "[" * 100_000 + "]" * 100_000
DIGITS = "9" * 5000
NUMBERS = (
    "0", "-1", "1", "3", "4", "999", "1e-30", "-1e-30", "1e30", "1e300", "nan", "inf", "-inf", "0.5",
    "1000000000000000", "100000000000000000000000000000", "1e-320", "2147483648", "-9223372036854775809",
)  # fmt: skip
"""Values of settings."""
OUTPUTS = ("closed", "broken", "full")
"""What stdout is: closed before the process began, a pipe whose reader has ended, a disk without room."""


@dataclass(frozen=True)
class Damage:
    """One thing done to one file.

    Attributes:
        file: Its path, relative to the folder of the case.
        kind: Chooses among the ways for files of its ending.
        at: Where, as a share.
        what: Chooses among values.
    """

    file: str
    kind: int
    at: float
    what: int


def damages(files: Sequence[str]) -> st.SearchStrategy[list[Damage]]:
    """One to three damages of some files."""
    one = st.builds(Damage, st.sampled_from(files), st.integers(0, 999), st.floats(0, 1), st.integers(0, 9999))
    return st.lists(one, min_size=1, max_size=3)


def apply(damage: Damage, folder: Path) -> None:
    """Do it, as far as the file still is one; what is done to the output or to the words, the command sees to."""
    path = folder / damage.file
    if not path.is_file():
        return
    ways = [*ANY, *BY_ENDING.get(path.suffix, ())]
    ways[damage.kind % len(ways)](path, damage)


def gone(path: Path, damage: Damage) -> None:
    """Nothing is left."""
    path.unlink()


def folder(path: Path, damage: Damage) -> None:
    """A folder has the name."""
    path.unlink()
    path.mkdir()


def swapped(path: Path, damage: Damage) -> None:
    """A copy of another file of the folder."""
    others = sorted(other for other in path.parent.iterdir() if other.is_file())
    if (other := others[damage.what % len(others)]) != path:
        shutil.copyfile(other, path)


def changed(change: Callable[[bytes, int, Damage], bytes]) -> Callable[[Path, Damage], None]:
    """A way that changes bytes at a place, in half of the cases one near the start."""

    def way(path: Path, damage: Damage) -> None:
        content = path.read_bytes()
        at = int(damage.at * (min(len(content), 128) if damage.what % 2 else len(content)))
        path.write_bytes(change(content, at, damage))

    return way


def word(content: bytes, damage: Damage) -> bytes:
    """Bytes to put somewhere."""
    return BYTES[damage.what // 2 % len(BYTES)]


def over(content: bytes, at: int, damage: Damage) -> bytes:
    """Bytes written over others."""
    new = word(content, damage)
    return content[:at] + new + content[at + len(new) :]


def aligned(content: bytes, at: int, damage: Damage) -> bytes:
    """The same, at a multiple of eight."""
    return over(content, at // 8 * 8, damage)


def flipped(content: bytes, at: int, damage: Damage) -> bytes:
    """One bit turned."""
    return content[:at] + bytes(byte ^ 1 << damage.what % 8 for byte in content[at : at + 1]) + content[at + 1 :]


def lines(change: Callable[[list[str], int, Damage], None]) -> Callable[[Path, Damage], None]:
    """A way that changes the lines of a text."""

    def way(path: Path, damage: Damage) -> None:
        text = path.read_bytes().decode("latin-1").split("\n")
        change(text, int(damage.at * (len(text) - 1)), damage)
        path.write_bytes("\n".join(text).encode("latin-1", "replace"))

    return way


def token(text: list[str], at: int, damage: Damage) -> None:
    """Another word in a line."""
    words = text[at].split(" ")
    words[damage.what % len(words)] = WORDS[damage.what // 7 % len(WORDS)]
    text[at] = " ".join(words)


def cell(text: list[str], at: int, damage: Damage) -> None:
    """Another value in a line with commas between, or in an element of XML."""
    words = re.split(r"([,<>\"\t])", text[at])
    words[damage.what % len(words)] = WORDS[damage.what // 7 % len(WORDS)]
    text[at] = "".join(words)


def node(data: Any, damage: Damage) -> Any:
    """The data with one node of the tree replaced, taken out, doubled or called otherwise."""
    places: list[tuple[Any, Any]] = []

    def walk(here: Any) -> None:
        for key in list(here) if isinstance(here, dict) else range(len(here)) if isinstance(here, list) else ():
            places.append((here, key))
            walk(here[key])

    walk(data)
    if not places:
        return VALUES[damage.what % len(VALUES)]
    parent, key = places[int(damage.at * (len(places) - 1))]
    if damage.what % 5 == 0:
        del parent[key]
    elif damage.what % 5 == 1 and isinstance(parent, dict):
        parent[str(VALUES[damage.what // 5 % len(VALUES)])[:200]] = parent.pop(key)
    else:
        parent[key] = VALUES[damage.what // 5 % len(VALUES)]
    return data


def tree(path: Path, damage: Damage) -> None:
    """A node of a JSON file, or its nesting, or the length of a number."""
    try:
        text = json.dumps(node(json.loads(path.read_bytes()), damage))
    except (ValueError, RecursionError):  # it is damaged already
        return
    if damage.what % 50 == 7:
        text = text.replace("]", DEEP + "]", 1)
    if damage.what % 50 == 8:
        text = text.replace(": ", f": {DIGITS}", 1)
    path.write_text(text)


def shape(path: Path, damage: Damage) -> None:
    """JSON of another shape in the place of the whole."""
    path.write_text(DEEP if damage.what % 8 == 7 else json.dumps(VALUES[damage.what // 8 % len(VALUES)]))


def event(path: Path, damage: Damage) -> None:
    """A line of JSON with one of its nodes changed."""
    text = path.read_text(errors="replace").splitlines()
    if not text:
        return
    line = int(damage.at * (len(text) - 1))
    try:
        text[line] = json.dumps(node(json.loads(text[line]), damage))
    except (ValueError, RecursionError):
        return
    path.write_text("\n".join(text) + "\n")


def looped(path: Path, damage: Damage) -> None:
    """A link to itself."""
    path.unlink()
    path.symlink_to(path.name)


def size(path: Path, damage: Damage) -> None:
    """A PNG that claims to be of another size."""
    content = bytearray(path.read_bytes())
    if content[:8] != b"\x89PNG\r\n\x1a\n" or len(content) < 33:
        return
    by = (0, 1, 2, 1000, 2000, 10_000, 10**8)
    width, height = struct.unpack_from(">II", content, 16)
    a, b = by[damage.what % len(by)], by[int(damage.at * 6.99)]
    struct.pack_into(
        ">II", content, 16, min(width * a, 2**31 - 1), min(height * (a if damage.what % 3 else b), 2**31 - 1)
    )
    struct.pack_into(">I", content, 29, zlib.crc32(content[12:29]))
    path.write_bytes(content)


def array_header(path: Path, damage: Damage) -> None:
    """An .npy that claims another shape, type or order."""
    content = path.read_bytes()
    if not content.startswith(b"\x93NUMPY\1\0") or len(content) < 10:
        return
    shapes = (
        "()",
        "(0,)",
        "(3, 0)",
        "(-1, 5)",
        "(10000000000, 2)",
        f"({2**62}, 8)",
        "(18, 24, 1)",
        "(1, 18, 24)",
        "(1,)",
    )
    types = ("<f4", "<f8", "|O", "|S8", "<c8", "<i8", "|b1", "<M8[s]", "<f2", "[('a', '<f4')]", "|V4")
    kind, shape = types[damage.what % len(types)], shapes[int(damage.at * (len(shapes) - 0.01))]
    kind = kind if kind[0] == "[" else repr(kind)
    text = f"{{'descr': {kind}, 'fortran_order': {damage.what % 2 == 0}, 'shape': {shape}, }}\n"
    data = content[10 + struct.unpack_from("<H", content, 8)[0] :]
    path.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text.encode() + data)


def resealed(path: Path, damage: Damage) -> None:
    """A checkpoint of other contents whose digest fits."""
    import torch
    from safetensors import SafetensorError, safe_open
    from safetensors.torch import save_file

    from surfkit.train import checkpoint

    try:
        with safe_open(path, framework="pt") as file:
            metadata, tensors = dict(file.metadata() or {}), {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError):  # it is damaged already
        return
    if "facts" not in metadata or not tensors:
        return
    names = sorted(tensors)
    name = names[int(damage.at * (len(names) - 1))]
    value = torch.atleast_1d(tensors[name])
    spoilt = float("nan") if value.is_floating_point() else 99
    twice = value.repeat(2, *[1] * (value.dim() - 1))
    shapes = (value[:0], value[:1], value.flatten(), value[None].clone(), twice, torch.zeros(()))
    others = (None, *shapes, value.double(), value.to(torch.uint8), value + 1, torch.full_like(value, spoilt))
    if damage.what % 2:
        metadata["facts"] = json.dumps(node(json.loads(metadata["facts"]), damage))
    elif (other := others[damage.what // 2 % len(others)]) is None:
        del tensors[name]
    else:
        tensors[name] = other.contiguous()
    metadata["digest"] = checkpoint._digest(tensors, metadata["facts"])
    save_file(tensors, path, metadata=metadata)


ANY = (
    gone,
    folder,
    looped,
    swapped,
    changed(lambda content, at, damage: content[:at]),
    changed(lambda content, at, damage: b""),
    changed(over),
    changed(over),
    changed(aligned),
    changed(aligned),
    changed(flipped),
    changed(lambda content, at, damage: content[:at] + word(content, damage) + content[at:]),
    changed(lambda content, at, damage: content[:at] + content[at + 1 + damage.what % 50 :]),
    changed(lambda content, at, damage: content[:at] + content[at : at + 200] * (1 + damage.what % 9) + content[at:]),
)
TEXT = (
    *[lines(token)] * 6,
    lines(lambda text, at, damage: text.pop(at)),
    lines(lambda text, at, damage: text.insert(at, text[damage.what % len(text)])),
)


def somewhere(content: bytes, damage: Damage) -> bytes:
    """Bytes written over others at a place, or the content cut off there."""
    at = int(damage.at * (min(len(content), 64) if damage.what % 2 else len(content)))
    return content[:at] if damage.what % 11 == 0 else over(content, at, damage)


BY_ENDING = {
    ".glb": (*[splats.inside_glb(splats.in_json(node))] * 14,),
    ".spz": (*[splats.inside_gzip(somewhere)] * 14,),
    ".sog": (
        *[splats.inside_zip(splats.in_json(node), json_only=True)] * 8,
        *[splats.inside_zip(somewhere)] * 4,
        *[splats.inside_zip(splats.sized)] * 4,
    ),
    ".surfkit": (
        *[splats.inside_surfkit(splats.in_json(node), index_only=True)] * 8,
        *[splats.inside_surfkit(somewhere)] * 12,
    ),
    ".txt": TEXT,
    ".out": TEXT,
    ".xyz": TEXT,
    ".csv": (*TEXT, *[lines(cell)] * 6),
    ".prj": (*TEXT, *[lines(cell)] * 6),
    ".xml": (*TEXT, *[lines(cell)] * 6),
    ".ply": TEXT,
    ".jsonl": (*TEXT, *[event] * 6),
    ".json": (*[tree] * 12, *[shape] * 3, lines(token)),
    ".png": (size, size, size),
    ".npy": (*[array_header] * 6,),
    ".safetensors": (*[resealed] * 12,),
}
"""Further ways, by the ending of the file."""
