"""Bytes of small files, each computed here by hand from what is published of the format, not by the package."""

import gzip
import io
import json
import math
import struct
import zipfile

import numpy as np
import pytest
import torch
import zstandard
from PIL import Image

from surfkit.io.splats.compressed_ply import CompressedPLY
from surfkit.io.splats.sog import SOG
from surfkit.io.splats.splat import Splat
from surfkit.io.splats.splat_table import SplatTable
from surfkit.io.splats.spz import SPZ
from surfkit.scene.scene import Frame

C0 = 0.28209479177387814
HALF = math.sqrt(0.5)


def two(kind="gaussian", degree=1):
    """A splat at (1, 2, 3) with half a turn about y, and a smaller one at (-1, 0, 0.5), turned about x."""
    rest = torch.zeros(2, (degree + 1) ** 2 - 1, 3)
    if degree:
        rest[0] = torch.arange(rest[0].numel()).reshape(rest[0].shape) / 64
    scales = torch.tensor([[math.log(0.5), math.log(0.25), math.log(0.125)], [math.log(0.1)] * 3])
    return SplatTable(
        kind=kind,
        means=torch.tensor([[1.0, 2.0, 3.0], [-1.0, 0.0, 0.5]]),
        quats=torch.tensor([[0.0, 0.0, -2.0, 0.0], [HALF, HALF * 0.98, 0.0, 0.0]]),
        log_scales=scales[:, : 2 if kind == "surfel" else 3],
        opacity_logits=torch.tensor([0.0, math.log(3.0)]),  # opacities 1/2 and 3/4
        sh0=torch.tensor([[0.0, 1.0, -1.0], [0.5, 0.5, 0.5]]),
        sh_rest=rest,
    )


def test_splat(tmp_path):
    Splat().write(tmp_path / "a.splat", two())
    first, second = struct.iter_unpack("<6f8B", (tmp_path / "a.splat").read_bytes())
    assert first[:3] == (1, 2, 3) and first[3:6] == pytest.approx((0.5, 0.25, 0.125))
    assert first[6:10] == (128, round(255 * (0.5 + C0)), round(255 * (0.5 - C0)), 128)
    assert first[10:] == (128, 128, 0, 128)  # -1 is 0; q and -q turn alike
    assert second[:3] == (-1, 0, 0.5) and second[9] == round(255 * 0.75)
    length = math.hypot(HALF, HALF * 0.98)
    assert second[10:] == (128 + round(128 * HALF / length), 128 + round(128 * HALF * 0.98 / length), 128, 128)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_spz(tmp_path, version):
    SPZ(version=version, fractional_bits=12, axes="same", sh1_bits=8).write(tmp_path / "a.spz", two())
    raw = (tmp_path / "a.spz").read_bytes()
    if version < 4:
        raw = gzip.decompress(raw)
        assert raw[:16] == b"NGSP" + struct.pack("<IIBBBB", version, 2, 1, 12, 0, 0)
        body = raw[16:]
    else:
        assert raw[:32] == b"NGSP" + struct.pack("<IIBBBBI", 4, 2, 1, 12, 2, 6, 44) + bytes(12)
        assert raw[32:44] == struct.pack("<III", 0xADBE0003, 4, 6), "right-down-forward"
        at, body = 44 + 6 * 16, b""
        for i in range(6):
            packed, size = struct.unpack_from("<QQ", raw, 44 + 16 * i)
            part = zstandard.ZstdDecompressor().decompress(raw[at : at + packed], max_output_size=size)
            assert len(part) == size
            at, body = at + packed, body + part
        assert at == len(raw), "nothing follows"
    positions = [(-4096, 0, 2048), (4096, 8192, 12288)]  # along the Z-order curve the second splat comes first
    expected = b"".join(struct.pack("<i", v)[:3] for xyz in positions for v in xyz)
    expected += bytes([191, 128])
    expected += bytes(round(255 * (0.15 * v + 0.5)) for v in (0.5, 0.5, 0.5))
    expected += bytes([128, round(255 * 0.65), round(255 * 0.35)])
    expected += bytes(round(16 * (math.log(s) + 10)) for s in (0.1, 0.1, 0.1, 0.5, 0.25, 0.125))
    length = math.hypot(HALF, HALF * 0.98)
    x = HALF * 0.98 / length
    if version == 2:
        expected += bytes([round(127.5 * x + 127.5), 128, 128, 128, 0, 128])
    else:  # w is the largest of the second: x, y, z follow; y of the first, which is negative, so that all others are 0
        magnitude = math.floor(511 * x / HALF + 0.5)
        expected += struct.pack("<I", 3 << 30 | magnitude << 20) + struct.pack("<I", 1 << 30)
    expected += bytes([128] * 9) + bytes(128 + 2 * k for k in range(9))
    assert body == expected


def test_spz_rounds_harmonics_to_the_middle_of_steps(tmp_path):
    """5 bits leave steps of 8, 4 bits steps of 16, and 0 stays 0."""
    table = two(degree=2)
    table.sh_rest[:] = 0
    table.sh_rest[0, 0] = torch.tensor([0.02, 0.04, -1.5])
    table.sh_rest[0, 5] = torch.tensor([0.05, 0.07, 1.5])
    SPZ(axes="same").write(tmp_path / "a.spz", table)
    rest = np.frombuffer(gzip.decompress((tmp_path / "a.spz").read_bytes())[-48:], np.uint8).reshape(2, 8, 3)
    assert (rest[0] == 128).all()
    assert rest[1, 0].tolist() == [128, 136, 0] and rest[1, 5].tolist() == [128, 144, 255]


def packed(values, bits):
    """A word of numbers in [0, 1]."""
    word = 0
    for value, count in zip(values, bits, strict=True):
        word = word << count | math.floor(value * (2**count - 1) + 0.5)
    return word


def test_compressed_ply(tmp_path):
    CompressedPLY().write(tmp_path / "a.compressed.ply", two())
    head, body = (tmp_path / "a.compressed.ply").read_bytes().split(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and "comment SplatRenderMode: default" in lines
    elements = [line for line in lines if line.startswith("element")]
    assert elements == ["element chunk 1", "element vertex 2", "element sh 2"]
    names = [line.split() for line in lines if line.startswith("property")]
    ends = [f"{e}_{group}{axis}" for group in ("", "scale_") for e in ("min", "max") for axis in "xyz"]
    ends += [f"{e}_{c}" for e in ("min", "max") for c in "rgb"]
    assert names[:18] == [["property", "float", name] for name in ends]
    words = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    assert names[18:22] == [["property", "uint", name] for name in words]
    assert names[22:] == [["property", "uchar", f"f_rest_{i}"] for i in range(9)]
    bounds = struct.unpack_from("<18f", body)
    small, big = (0.5 - C0, 0.5 + 0.5 * C0), 0.5 + C0
    assert bounds[:6] == (-1, 0, 0.5, 1, 2, 3)
    assert bounds[6:12] == pytest.approx([math.log(0.1)] * 3 + [math.log(v) for v in (0.5, 0.25, 0.125)])
    assert bounds[12:] == pytest.approx([0.5, small[1], small[0], small[1], big, small[1]])
    first, second = struct.unpack_from("<4I", body, 72), struct.unpack_from("<4I", body, 88)
    length = math.hypot(HALF, HALF * 0.98)
    assert first[0] == 0 and second[0] == 2**32 - 1
    three = (HALF * 0.98 / length * HALF + 0.5, 0.5, 0.5)
    assert first[1] == packed(three, (10, 10, 10)) and second[1] == 2 << 30 | packed((0.5, 0.5, 0.5), (10, 10, 10))
    assert first[2] == 0 and second[2] == 2**32 - 1
    assert first[3] == packed((1, 0, 1, 0.75), (8, 8, 8, 8)) and second[3] == packed((0, 1, 0, 0.5), (8, 8, 8, 8))
    rest = np.frombuffer(body[104:], np.uint8).reshape(2, 3, 3)  # channel, then coefficient
    assert (rest[0] == 128).all()
    for coefficient in range(3):
        for channel in range(3):
            value = (3 * coefficient + channel) / 64
            assert rest[1, channel, coefficient] == math.floor(256 * (value / 8 + 0.5))


def test_compressed_ply_says_what_the_splats_are(tmp_path):
    CompressedPLY().write(tmp_path / "a.ply", two("surfel"), Frame(np.zeros(3), 1.0, crs="EPSG:32632"))
    head = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode()
    assert "comment SplatRenderMode: 2dgs\n" in head and "comment crs: EPSG:32632\n" in head


def test_sog(tmp_path):
    SOG().write(tmp_path / "a.sog", two("surfel"), Frame(np.zeros(3), 1.0, metres=0.5, shift=(1.0, 0.0, 0.0)))
    archive = zipfile.ZipFile(tmp_path / "a.sog")
    assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
    meta = json.loads(archive.read("meta.json"))
    assert (meta["version"], meta["count"], meta["model"]) == (2, 2, "2dgs")
    assert meta["surfkit"] == {"offset": [1.0, 0.0, 0.0], "metres_per_unit": 0.5}

    def pixels(group, at=0):
        image = Image.open(io.BytesIO(archive.read(meta[group]["files"][at])))
        assert image.format == "WEBP" and image.mode in ("RGB", "RGBA")
        return np.asarray(image.convert("RGBA"))

    means = [(0.0, 2.0, 3.0), (-2.0, 0.0, 0.5)]  # without the shift
    bent = np.array([[math.copysign(math.log(abs(v) + 1), v) for v in xyz] for xyz in means])
    np.testing.assert_allclose(meta["means"]["mins"], bent.min(0))
    np.testing.assert_allclose(meta["means"]["maxs"], bent.max(0))
    words = pixels("means", 0).astype(int) + 256 * pixels("means", 1).astype(int)
    assert words.shape == (4, 4, 4) and words.reshape(-1, 4)[:2, :3].tolist() == [[0] * 3, [65_535] * 3]
    turns = pixels("quats").reshape(-1, 4)
    length = math.hypot(HALF, HALF * 0.98)
    assert turns[0].tolist() == [round(255 * (HALF * 0.98 / length * HALF + 0.5)), 128, 128, 252]
    assert turns[1].tolist() == [128, 128, 128, 254]
    codes = np.array(meta["scales"]["codebook"])
    assert len(codes) == 256 and (np.diff(codes) >= 0).all()
    expected = [math.log(0.1), math.log(0.1), math.log(0.1) + math.log(1e-3)]
    np.testing.assert_allclose(codes[pixels("scales").reshape(-1, 4)[0, :3]], expected, rtol=1e-6)
    colors = pixels("sh0").reshape(-1, 4)
    np.testing.assert_allclose(np.array(meta["sh0"]["codebook"])[colors[:2, :3]], [[0.5] * 3, [0, 1, -1]])
    assert colors[:2, 3].tolist() == [191, 128]
    rows = pixels("shN")
    assert rows.shape == (1, 192, 4) and meta["shN"]["bands"] == 1 and meta["shN"]["count"] == 2
    label = pixels("shN", 1).reshape(-1, 4)[:2].astype(int)
    found = np.array(meta["shN"]["codebook"])[rows[0, :, :3]].reshape(64, 3, 3)[label[:, 0] + 256 * label[:, 1]]
    np.testing.assert_allclose(found, [np.zeros((3, 3)), np.arange(9).reshape(3, 3) / 64], atol=1e-7)
