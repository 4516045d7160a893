"""Splat files: every byte where other programs expect it, against trimesh and a parser of our own."""

import math
import struct

import numpy as np
import pytest
import torch
from models import with_column
from needs import needs

from surfkit.core.check import BadInput
from surfkit.io.splats import ply
from surfkit.io.splats.ply import read_splats, read_vertices, write_points, write_splats
from surfkit.io.splats.splat_table import SplatTable
from surfkit.scene.scene import Frame


def table(kind="gaussian", count=7, degree=3, **changes):
    draw = torch.Generator().manual_seed(count)
    values = {
        "means": torch.randn(count, 3, generator=draw),
        "quats": torch.randn(count, 4, generator=draw),
        "log_scales": torch.randn(count, 3 if kind == "gaussian" else 2, generator=draw),
        "opacity_logits": torch.randn(count, generator=draw),
        "sh0": torch.randn(count, 3, generator=draw),
        "sh_rest": torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=draw),
    }
    return SplatTable(kind, **(values | changes))


def parsed(path):
    """Header lines, and rows as float tuples: a parser that shares nothing with the package."""
    raw = path.read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    lines = raw[:end].decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    assert len(names) == sum(line.startswith("property") for line in lines)
    body = raw[end:]
    assert len(body) % (4 * len(names)) == 0
    return lines, names, [struct.unpack_from(f"<{len(names)}f", body, i) for i in range(0, len(body), 4 * len(names))]


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
def test_there_and_back(tmp_path, kind, degree):
    before = table(kind, degree=degree)
    write_splats(tmp_path / "a.ply", before)
    after = read_splats(tmp_path / "a.ply")
    assert after.kind == kind and after.sh_degree == before.sh_degree == degree and len(after) == 7
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest"):
        assert torch.equal(getattr(after, name), getattr(before, name)), name


@pytest.mark.parametrize("deviations", [np.linspace(0.01, 3, 50), np.full(50, 1e3), np.zeros(50)])
def test_the_filter_of_mip_splatting_is_applied(tmp_path, deviations):
    """The covariance grows by deviation^2 times the identity, the opacity falls by the root of the determinants."""
    splats = table(count=50)
    write_splats(tmp_path / "a.ply", splats)
    with_column(tmp_path / "a.ply", "filter_3D", deviations)
    found = read_splats(tmp_path / "a.ply")
    assert not found.is_filtered, "surfkit wrote how it is drawn"
    head = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(head.replace(b"comment SplatRenderMode: default\n", b""))
    assert read_splats(tmp_path / "a.ply").is_filtered
    variances = np.exp(2 * splats.log_scales.double().numpy())
    wider = variances + np.float32(deviations)[:, None].astype(float) ** 2
    np.testing.assert_allclose(np.exp(found.log_scales.double().numpy()), np.sqrt(wider), rtol=1e-6)
    kept = np.sqrt(variances.prod(1) / wider.prod(1))
    opacities = kept / (1 + np.exp(-splats.opacity_logits.double().numpy()))
    np.testing.assert_allclose(found.opacity_logits.double().sigmoid(), opacities, rtol=1e-5)
    assert torch.equal(found.means, splats.means) and torch.equal(found.sh_rest, splats.sh_rest)


def test_discs_with_a_filter_are_drawn_as_discs(tmp_path):
    write_splats(tmp_path / "a.ply", table("surfel"), strict_2dgs=True)
    with_column(tmp_path / "a.ply", "filter_3D", np.ones(7))
    body = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(body.replace(b"comment SplatRenderMode: 2dgs\n", b""))
    found = read_splats(tmp_path / "a.ply")
    assert found.kind == "surfel" and not found.is_filtered


def test_columns_are_those_of_3dgs(tmp_path):
    splats = table(degree=2)
    write_splats(tmp_path / "a.ply", splats, comments=["steps 1000"])
    lines, names, rows = parsed(tmp_path / "a.ply")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and "element vertex 7" in lines
    assert {"comment SplatRenderMode: default", "comment SH degree: 2", "comment steps 1000"} <= set(lines)
    rest = [f"f_rest_{i}" for i in range(24)]
    assert names == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"),
        *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    for i, row in enumerate(rows):
        assert row[:3] == tuple(splats.means[i].tolist()) and row[3:6] == (0, 0, 0)
        for channel in range(3):  # all of red, then green, then blue
            for k in range(8):
                assert row[9 + 8 * channel + k] == splats.sh_rest[i, k, channel].item()
        assert row[33] == splats.opacity_logits[i].item()
        assert row[34:37] == tuple(splats.log_scales[i].tolist()) and row[37:] == tuple(splats.quats[i].tolist())


def test_surfels_are_thin_ellipsoids_for_programs_that_know_no_surfels(tmp_path):
    splats = table("surfel", degree=0)
    write_splats(tmp_path / "a.ply", splats)
    lines, names, rows = parsed(tmp_path / "a.ply")
    assert "comment SplatRenderMode: 2dgs" in lines
    for row, scales in zip(rows, splats.log_scales.tolist(), strict=True):
        assert row[names.index("scale_2")] == pytest.approx(min(scales) + math.log(1e-3), abs=1e-5)


def test_strict_2dgs_has_two_scales(tmp_path):
    splats = table("surfel")
    write_splats(tmp_path / "a.ply", splats, strict_2dgs=True)
    assert "scale_2" not in parsed(tmp_path / "a.ply")[1]
    again = read_splats(tmp_path / "a.ply")
    assert again.kind == "surfel" and torch.equal(again.log_scales, splats.log_scales)


def test_antialiasing_is_told(tmp_path):
    write_splats(tmp_path / "a.ply", table(antialias=True))
    assert "comment SplatRenderMode: mip" in parsed(tmp_path / "a.ply")[0] and read_splats(tmp_path / "a.ply").antialias


def test_trimesh_reads_the_same(tmp_path):
    trimesh = needs("trimesh")
    splats = table("surfel", count=20)
    write_splats(tmp_path / "a.ply", splats)
    data = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(data["f_rest_15"].ravel(), splats.sh_rest[:, 0, 1])
    np.testing.assert_array_equal(data["rot_3"].ravel(), splats.quats[:, 3])

    xyz, rgb = np.random.default_rng(0).normal(size=(9, 3)), np.arange(27, dtype=np.uint8).reshape(9, 3)
    write_points(tmp_path / "points.ply", xyz, rgb)
    cloud = trimesh.load(tmp_path / "points.ply")
    np.testing.assert_array_equal(cloud.vertices, xyz)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], rgb)


def test_more_rows_than_a_chunk(tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "WRITTEN_ROWS", 3)
    splats = table(count=10)
    write_splats(tmp_path / "a.ply", splats)
    assert torch.equal(read_splats(tmp_path / "a.ply").sh_rest, splats.sh_rest)


def test_no_splats(tmp_path):
    write_splats(tmp_path / "a.ply", table(count=0))
    assert len(read_splats(tmp_path / "a.ply")) == 0


def test_into_the_frame_of_the_input():
    """A splat keeps its place and its size relative to the scene, also where float32 would lose half a metre."""
    frame = Frame(np.array([340_622.25, 5_548_143.5, 71.0]), 1 / 250)
    splats = table()
    moved = splats.in_input_frame(frame)
    assert moved.means.dtype == torch.float64
    expected = splats.means.double() * 250 + torch.from_numpy(frame.origin)
    torch.testing.assert_close(moved.means, expected, rtol=0, atol=1e-7)
    torch.testing.assert_close(moved.log_scales.exp(), splats.log_scales.exp() * 250)
    assert moved.sh_rest is splats.sh_rest and moved.quats is splats.quats


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    write_splats(path, table())
    before = path.read_bytes()
    monkeypatch.setattr(ply, "WRITTEN_ROWS", 3)
    rows = ply._rows

    def breaks(splats, part, axes):
        if part.start:
            raise OSError("disk full")
        return rows(splats, part, axes)

    monkeypatch.setattr(ply, "_rows", breaks)
    with pytest.raises(OSError, match="disk full"):
        write_splats(path, table(count=9))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_files_of_other_programs(tmp_path):
    """No normals, another order, doubles, unknown properties, and a second element."""
    names = [
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
        "scale_0",
        "scale_1",
        "scale_2",
        "opacity",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
    ]
    dtype = np.dtype([("id", "<i4"), *((axis, "<f8") for axis in "xyz"), *((name, "<f4") for name in names)])
    rows = np.zeros(2, dtype)
    rows["x"], rows["rot_0"], rows["f_dc_1"] = [5_548_143.25, 2], 1, [0.5, 0.25]
    kinds = {"<i4": "int", "<f8": "double", "<f4": "float"}
    properties = "".join(f"property {kinds[dtype[name].str]} {name}\n" for name in dtype.names)
    header = f"ply\nformat binary_little_endian 1.0\ncomment other\nelement vertex 2\n{properties}"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + rows.tobytes() + b"\3" + bytes(12))
    splats = read_splats(tmp_path / "a.ply")
    assert splats.kind == "gaussian" and splats.sh_degree == 0
    assert splats.means[0, 0].item() == 5_548_143.25 and splats.sh0[:, 1].tolist() == [0.5, 0.25]


def spoil(path, how):
    raw = path.read_bytes()
    path.write_bytes(how(raw))


@pytest.mark.parametrize(
    ("how", "text"),
    [
        (lambda raw: b"", "no PLY file"),
        (lambda raw: bytes(range(256)) * 40, "no PLY file"),
        (lambda raw: raw[:60], "the PLY header does not end"),
        (lambda raw: raw[:-5], "cut off after 6 of 7 vertices"),
        (lambda raw: raw.replace(b"binary_little_endian", b"ascii"), "has 'format ascii 1.0'; only"),
        (lambda raw: raw.replace(b"element vertex 7", b"element chunk 7"), "the header has 'element chunk 7'"),
        (lambda raw: raw.replace(b"element vertex 7", b"element vertex -7"), "the header has 'element vertex -7'"),
        (lambda raw: raw.replace(b"property float x", b"property half x"), "cannot read 'property half x'"),
        (lambda raw: raw.replace(b"property float f_dc_0", b"property float red"), "it lacks f_dc_0"),
        (lambda raw: raw.replace(b"float f_rest_44", b"float g_rest_44"), "44 properties f_rest"),
        (lambda raw: raw.replace(b"float f_rest_44", b"float f_rest_45"), "counted from f_rest_0"),
        (lambda raw: raw.replace(b"property float y\n", b"property float x\n"), "or one twice"),
    ],
)
def test_damaged_files(tmp_path, how, text):
    path = tmp_path / "a.ply"
    write_splats(path, table())
    spoil(path, how)
    with pytest.raises(BadInput) as error:
        read_splats(path)
    assert text in str(error.value) and "a.ply" in str(error.value) and "\n" not in str(error.value)


def test_no_file(tmp_path):
    with pytest.raises(BadInput, match="cannot be read: No such file"):
        read_splats(tmp_path / "none.ply")


def test_shapes_are_checked():
    with pytest.raises(BadInput, match="log_scales: expected shape"):
        table("gaussian", log_scales=torch.zeros(7, 2))
    with pytest.raises(BadInput, match="sh_rest: 4 coefficients"):
        table(sh_rest=torch.zeros(7, 4, 3))


def test_points_keep_their_precision(tmp_path):
    rgb = np.full((2, 3), 9, np.uint8)
    for dtype in (np.float32, np.float64):
        xyz = np.array([[5_548_143.2, 0, 1], [2, 3, 4]], dtype)
        write_points(tmp_path / "a.ply", xyz, rgb)
        rows, comments = read_vertices(tmp_path / "a.ply")
        assert rows["x"].dtype == dtype and (rows["x"] == xyz[:, 0]).all() and comments[0].startswith("Generated by")
