"""Files that are damaged, cut off or made to mislead end in one line that names the part, and take no memory."""

import json
import os
import struct
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard

from surfkit.compress.container import ModelFile, write_model
from surfkit.compress.lossless import Lossless
from surfkit.compress.packed import Packed
from surfkit.compress.streams import MAX_COMPONENTS, packed, unpacked
from surfkit.core.check import BadInput
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.testing.compressor_checks import splat_model

HEAD = struct.Struct("<8sIIQQQII")
CASES = int(os.environ.get("SURFKIT_DAMAGED_FILES", 200))
"""Of random mutations; a few hundred do for the suite."""
ALLOWED = 24 << 20
"""Bytes that Python and numpy may hold at most while a small file is read."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    path, model = tmp_path_factory.mktemp("whole") / "m.surfkit", splat_model(Surfel2D(sh_degree=1), 90)
    write_model(path, model, Packed().plan(model, None, 0), Packed(), most=40)
    return path.read_bytes()


def index_of(data: bytes) -> dict:
    _, _, _, start, length, _, _, _ = HEAD.unpack(data[: HEAD.size])
    return json.loads(zstandard.ZstdDecompressor().decompress(data[start : start + length]))


def sealed(blocks: bytes, index: bytes) -> bytes:
    """A file of these blocks and this index, with checksums that fit."""
    start = HEAD.size + len(blocks)
    numbers = struct.pack("<QQQI", start, len(index), start + len(index), zlib.crc32(index))
    head = HEAD.pack(b"\x89SRFK\r\n\x1a", 1, zlib.crc32(numbers), *struct.unpack("<QQQI", numbers), 0)
    return head + blocks + index


def resealed(data: bytes, change) -> bytes:
    """The file with its index changed, and checksums that fit."""
    start = HEAD.unpack(data[: HEAD.size])[3]
    index = index_of(data)
    changed = change(index)
    text = json.dumps(index if changed is None else changed)
    return sealed(data[HEAD.size : start], zstandard.ZstdCompressor().compress(text.encode()))


def complaint(tmp_path: Path, data: bytes, is_measured: bool = True) -> str:
    """What is said of a file; "" where it is read."""
    path = tmp_path / "d.surfkit"
    path.write_bytes(data)
    if is_measured:
        tracemalloc.start()
    try:
        file = ModelFile(path)
        model, _ = file.read()
        assert all(value.isfinite().all() for value in model.params.values())
        said = ""
    except BadInput as error:
        said = str(error)
        assert said.startswith(f"{path}: ") and "\n" not in said
    finally:
        peak = tracemalloc.get_traced_memory()[1] if is_measured else 0
        tracemalloc.stop()
    assert peak < ALLOWED, f"{peak >> 20} MiB for {len(data)} bytes: {said}"
    return said


def test_cut_off_anywhere(tmp_path, whole):
    start = HEAD.unpack(whole[: HEAD.size])[3]
    ends = [*range(HEAD.size + 1), *range(HEAD.size, start, 97), *range(start, len(whole))]
    for end in ends:
        said = complaint(tmp_path, whole[:end], is_measured=False)
        assert any(words in said for words in ("empty", "does not begin", "within its head", "cut off, or not copied"))
    assert "cut off, or not copied whole" in complaint(tmp_path, whole + b"\0")
    assert complaint(tmp_path, whole) == ""


def test_every_byte_is_guarded(tmp_path, whole):
    start = HEAD.unpack(whole[: HEAD.size])[3]
    places = {*range(HEAD.size), *range(HEAD.size, start, 101), *range(start, len(whole), 7)}
    for at in sorted(places):
        said = complaint(tmp_path, whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :], is_measured=at % 10 == 0)
        if HEAD.size - 4 <= at < HEAD.size:
            continue  # four bytes that mean nothing
        assert said, f"byte {at} of {len(whole)} can be anything"
        known = ("leaf", "table", "its index", "its head", "version", "no .surfkit file")
        assert any(words in said for words in known), said


def test_random_mutations(tmp_path, whole):
    """With checksums that fit, so that what reads the numbers is reached."""
    start, draw, read = HEAD.unpack(whole[: HEAD.size])[3], np.random.default_rng(0), 0
    entries = index_of(whole)
    blocks = [e["block"] for e in (*entries["tables"].values(), *entries["leaves"])]
    for case in range(CASES):
        data = bytearray(whole[:start])
        for _ in range(draw.integers(1, 4)):
            block = blocks[draw.integers(len(blocks))]
            share = draw.integers(block["length"]) if draw.random() < 0.5 else draw.integers(min(90, block["length"]))
            at, kind = block["offset"] + int(share), draw.integers(3)
            new = [draw.bytes(1), b"\xff\xff\xff\xff", struct.pack("<I", 1 << int(draw.integers(32)))][kind]
            data[at : at + len(new)] = new
        data = bytes(data[:start])

        def change(index, data=data):
            for entry in (*index["tables"].values(), *index["leaves"]):
                block = entry["block"]
                block["crc"] = zlib.crc32(data[block["offset"] : block["offset"] + block["length"]])

        said = complaint(tmp_path, resealed(data + whole[start:], change), is_measured=case % 10 == 0)
        read += said == ""
    assert 0 < read < 0.9 * CASES, "some are read, and most are not"


def every(index, name):
    return [*index["leaves"]] if name == "leaves" else [*index["tables"].values()]


CRAFTED = {
    "leaf points": (lambda i: i["leaves"][0].update(points=131_072), "its leaves have"),
    "all points": (lambda i: i.update(points=10**12), "its leaves have"),
    "points that fit": (
        lambda i: (i.update(points=i["points"] - i["leaves"][0]["points"] + 131_072),
                   i["leaves"][0].update(points=131_072)), "leaf 0 of"),
    "negative points": (lambda i: i["leaves"][0].update(points=-5), "its leaves have"),
    "more points than bytes": (
        lambda i: (i["leaves"][0].update(points=10**15), i.update(points=sum(x["points"] for x in i["leaves"]))),
        "leaf 0: 1000000000000000 points"),
    "exponent": (lambda i: i["leaves"][0].update(exponent=10**9), "leaf 0: "),
    "small exponent": (lambda i: i["leaves"][0].update(exponent=-999, finest=-999), "leads out of its leaf"),
    "large exponent": (lambda i: i["leaves"][0].update(exponent=999), "NaN or Inf"),
    "corner": (lambda i: i["leaves"][0].update(corner=[2**62, 0, 0]), "leaf 0: "),
    "corner of another place": (lambda i: i["leaves"][0].update(corner=[77, 0, 0]), ""),
    "finest": (lambda i: i["leaves"][0].update(finest=50), "leaf 0: "),
    "offset": (lambda i: i["leaves"][0]["block"].update(offset=0), "begins at 0"),
    "overlap": (lambda i: i["leaves"][1].update(block=i["leaves"][0]["block"]), "a block of"),
    "length": (lambda i: i["leaves"][-1]["block"].update(length=2**40), "its blocks end at"),
    "negative length": (lambda i: i["leaves"][-1]["block"].update(length=-3), "points in a cube"),
    "no leaves": (lambda i: i.update(points=0, leaves=[]), "its blocks end at"),
    "table shape": (lambda i: i["tables"]["sh.basis"].update(shape=[2**40, 2]), "table sh.basis: a shape of"),
    "table of other shape": (lambda i: i["tables"]["sh.basis"].update(shape=[9, 16]), "table sh.basis"),
    "table of many axes": (lambda i: i["tables"]["sh.basis"].update(shape=[1] * 60), "table sh.basis: a shape"),
    "negative table": (lambda i: i["tables"]["sh.basis"].update(shape=[-12, -12]), "table sh.basis: a shape of"),
    "type": (lambda i: i["tables"]["sh.basis"].update(dtype="object"), "table sh.basis: numbers of object"),
    "another type": (lambda i: i["tables"]["sh.basis"].update(dtype="float64"), "numbers of another type"),
    "table gone": (lambda i: i["tables"].__setitem__("x", i["tables"].pop("sh.basis")), "a block of"),
    "column shape": (lambda i: i["columns"]["means"].update(shape=[3_000_000]), "or other shapes"),
    "column type": (lambda i: i["columns"]["means"].update(dtype="int8"), "neither float32 nor float64"),
    "column name": (lambda i: i["columns"].update({"a\nb": {"shape": [], "dtype": "float32"}}), "a b"),
    "encoding": (lambda i: i["encodings"][0].update(use="pickle"), "no Encoding named 'pickle'"),
    "encoding of no column": (lambda i: i["encodings"].pop(), "must be taken by one encoding"),
    "setting": (lambda i: i["encodings"][0].update(exponent="x"), "expected"),
    "large cells": (lambda i: i["encodings"][0].update(exponent=2**62), "leads out of its leaf"),
    "large step": (lambda i: i["encodings"][1].update(step=1e308), "NaN or Inf"),
    "no step": (lambda i: i["encodings"][1].update(step=float("nan")), "its index cannot be used"),
    "levels": (lambda i: i["encodings"][3].update(levels=2**40), "levels is 1099511627776"),
    "primitive": (lambda i: i["primitive"].update(use="teapot"), "no Primitive named 'teapot'"),
    "another primitive": (lambda i: i["primitive"].update(use="gaussian3d"), "or other shapes"),
    "degree": (lambda i: i["primitive"].update(sh_degree=10**9), "sh_degree"),
    "used degree": (lambda i: i.update(sh_degree=3), "sh_degree 3"),
    "near": (lambda i: i.update(near="inf"), "near inf"),
    "frame": (lambda i: i.update(frame={"origin": [0, 0, 0], "scale": 0, "metres": None, "crs": None,
                                        "shift": [0, 0, 0]}), "a frame whose numbers"),
    "unknown key": (lambda i: i.update(more=1), "more: unknown setting"),
    "missing key": (lambda i: i.pop("leaves") and None, "leaves missing"),
    "a list": (lambda i: [i], "expected an object"),
    "nested": (lambda i: i.update(compressor=json.loads("[" * 200 + "]" * 200)), "nested too deeply"),
}  # fmt: skip


@pytest.mark.parametrize("name", CRAFTED)
def test_crafted_indices(tmp_path, whole, name):
    change, words = CRAFTED[name]

    def changed(index):
        result = change(index)
        return result if isinstance(result, list) else None

    said = complaint(tmp_path, resealed(whole, changed))
    assert words in said and bool(words) == bool(said), said


def test_indices_that_are_no_json(tmp_path, whole):
    blocks = whole[HEAD.size : HEAD.unpack(whole[: HEAD.size])[3]]
    coder = zstandard.ZstdCompressor()
    for index in (b"", b"{}", b"\xff" * 99, whole[-99:]):
        assert "its index cannot be used" in complaint(tmp_path, sealed(blocks, index))
        assert "its index cannot be used" in complaint(tmp_path, sealed(blocks, coder.compress(index)))
    assert "bytes of JSON in" in complaint(tmp_path, sealed(blocks, coder.compress(b" " * (200 << 20))))
    huge = zstandard.ZstdCompressor(write_content_size=True).compress(b"{}")
    claimed = huge[:4] + bytes([huge[4] | 0xC0]) + struct.pack("<Q", 1 << 60) + huge[6:]
    assert "bytes of JSON in" in complaint(tmp_path, sealed(blocks, claimed))


def leaf_of(whole: bytes, block: bytes, points: int = 40) -> bytes:
    """The file with other streams in its first leaf, and a claim of its points."""
    index = index_of(whole)
    first = index["leaves"][0]["block"]
    start = HEAD.unpack(whole[: HEAD.size])[3]
    before, after = whole[HEAD.size : first["offset"]], whole[first["offset"] + first["length"] : start]
    shift = len(block) - first["length"]
    index["points"] += points - index["leaves"][0]["points"]
    index["leaves"][0]["points"] = points
    first.update(length=len(block), crc=zlib.crc32(block))
    for leaf in index["leaves"][1:]:
        leaf["block"]["offset"] += shift
    return sealed(before + block + after, zstandard.ZstdCompressor().compress(json.dumps(index).encode()))


def stream_head(name: bytes, size: int, components: int, rows: int, lengths: list[int]) -> bytes:
    head = struct.pack("<B", len(name)) + name + struct.pack("<BII", size, components, rows)
    return head + struct.pack(f"<{len(lengths)}I", *lengths)


def test_streams_that_claim_much(tmp_path, whole):
    """Nothing is decoded before its shape is known to fit."""
    zeros = stream_head(b"means", 8, MAX_COMPONENTS, 131_072, [0] * 8 * MAX_COMPONENTS)
    assert "leaf 0 of" in complaint(tmp_path, leaf_of(whole, b"\1" + zeros))
    many = b"".join(stream_head(b"%d" % i, 8, 500, 40, [0] * 4_000) for i in range(254))
    many = stream_head(b"means", 8, 1, 40, [0] * 8) + many
    assert "stream scales.middle is missing" in complaint(tmp_path, leaf_of(whole, b"\xff" + many))
    assert "leaf 0: 131072 points" in complaint(tmp_path, leaf_of(whole, b"\0", points=131_072))
    bomb = zstandard.ZstdCompressor().compress(b"\0" * (100 << 20))
    part = b"\1" + stream_head(b"means", 8, 1, 40, [len(bomb)] + [0] * 7) + bomb
    assert "stream means has a plane of another size" in complaint(tmp_path, leaf_of(whole, part))
    claim = bomb[:4] + bytes([0xE0]) + struct.pack("<Q", 40) + bomb[9:]
    part = b"\1" + stream_head(b"means", 8, 1, 40, [len(claim)] + [0] * 7) + claim
    assert "stream means" in complaint(tmp_path, leaf_of(whole, part))
    for lengths in ([1 << 30] + [0] * 7, [(1 << 31) + 41] + [0] * 7, [(1 << 31) - 1] * 8):
        part = b"\1" + stream_head(b"means", 8, 1, 40, lengths) + b"\0" * 41
        assert "stream means" in complaint(tmp_path, leaf_of(whole, part))
    for part in (b"\0", b"\1", b"\7\3abc", b"\1" + stream_head(b"m\xff", 8, 1, 40, [0] * 8), b"\0more"):
        assert "leaf 0 of" in complaint(tmp_path, leaf_of(whole, part))
    twice = stream_head(b"means", 8, 1, 40, [0] * 8)
    assert "is there twice" in complaint(tmp_path, leaf_of(whole, b"\2" + twice + twice))
    for size in (0, 3, 16):  # of a number
        part = b"\1" + stream_head(b"m", size, 1, 40, [0] * 9)
        assert f"of {size} bytes" in complaint(tmp_path, leaf_of(whole, part))


def test_swapped_blocks(tmp_path, whole):
    """The blocks of two leaves, and their checksums, in each other's place: other points, but never a crash."""
    index = index_of(whole)
    a, b = (leaf["block"] for leaf in index["leaves"][:2])
    part = [whole[block["offset"] : block["offset"] + block["length"]] for block in (a, b)]
    data = whole[: a["offset"]] + part[1] + part[0] + whole[b["offset"] + b["length"] :]
    assert "damaged (checksum)" in complaint(tmp_path, data)


def test_other_files(tmp_path):
    assert "no .surfkit file" in complaint(tmp_path, b"ply\nformat ascii 1.0\n")
    assert "the file is empty" in complaint(tmp_path, b"")
    with pytest.raises(BadInput, match="cannot be read: No such file"):
        ModelFile(tmp_path / "none.surfkit")
    with pytest.raises(BadInput, match="cannot be read: Is a directory"):
        ModelFile(tmp_path)


def test_newer_versions(tmp_path, whole):
    newer = whole[:8] + struct.pack("<I", 2) + whole[12:]
    assert "version 2 of the format; this surfkit reads version 1" in complaint(tmp_path, newer)


READ = """
import resource, sys
from surfkit.compress.container import ModelFile
from surfkit.core.check import BadInput
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (300 << 20),) * 2)
for path in sys.argv[1:]:
    try:
        ModelFile(path).read()
        print("read")
    except BadInput as error:
        print(error)
"""


def test_with_little_memory(tmp_path, whole):
    """Crafted files in a process that may add 300 MB: what torch and zstandard take is counted too."""
    zeros = stream_head(b"means", 8, MAX_COMPONENTS, 131_072, [0] * 8 * MAX_COMPONENTS)
    coder = zstandard.ZstdCompressor()
    blocks = whole[HEAD.size : HEAD.unpack(whole[: HEAD.size])[3]]
    files = [
        leaf_of(whole, b"\1" + zeros),
        leaf_of(whole, b"\1" + zeros, points=131_072),
        sealed(blocks, coder.compress(b" " * (250 << 20))),
        resealed(whole, CRAFTED["more points than bytes"][0]),
    ]
    for at, data in enumerate(files):
        (tmp_path / f"{at}.surfkit").write_bytes(data)
    words = [sys.executable, "-c", READ, *(str(tmp_path / f"{at}.surfkit") for at in range(len(files)))]
    run = subprocess.run(words, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert run.returncode == 0, run.stderr[-900:]
    lines = run.stdout.splitlines()
    assert len(lines) == len(files) and "read" not in lines


def test_streams_come_back():
    draw = np.random.default_rng(0)
    streams = {
        "one": draw.integers(0, 255, (500, 3)).astype(np.uint8),
        "wide": draw.integers(0, 2**60, (500, 2)).astype(np.uint64),
        "high byte alone": (draw.integers(0, 2, (500, 1)) << 8).astype(np.uint16),
        "zeros": np.zeros((500, 7), np.uint32),
        "long zeros": np.zeros((200_000, 1), np.uint8),
        "no rows": np.zeros((0, 3), np.uint16),
        "no components": np.zeros((500, 0), np.uint8),
        "länge": np.ones((1, 1), np.uint8),
    }
    found = unpacked(packed(streams), 200_000)
    assert packed(found) == packed(streams)  # what is not decoded yet is packed as what is
    assert list(found) == list(streams)
    for name, numbers in streams.items():
        assert np.array_equal(found[name].numbers(), numbers) and found[name].dtype == numbers.dtype
    with pytest.raises(BadInput, match="'long zeros' has 200000 x 1"):
        unpacked(packed(streams), 199_999)
    with pytest.raises(TypeError, match="must be unsigned"):
        packed({"x": np.zeros((2, 2), np.int32)})


def test_a_model_of_a_million_equal_points_is_read(tmp_path):
    """The bounds on what a file may claim allow the smallest that is written."""
    model = splat_model(Surfel2D(sh_degree=0), 1)
    model = type(model)(model.primitive, {k: v.expand(200_000, *v.shape[1:]) for k, v in model.params.items()})
    for compressor in (Lossless(), Packed()):
        write_model(tmp_path / "m.surfkit", model, compressor.plan(model, None, 0), compressor)
        assert len(ModelFile(tmp_path / "m.surfkit").read()[0]) == 200_000
