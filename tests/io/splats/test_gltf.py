"""Splats in glTF: byte for byte what the extension says, and back; other readers find the same points."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs
from scipy.spatial.transform import Rotation

from surfkit.core.check import BadInput
from surfkit.io.splats.gltf import GLTF, UPS
from surfkit.io.splats.gltf_reader import read_splats
from surfkit.io.splats.rotate_splats import turned
from surfkit.io.splats.splat_table import SplatTable
from surfkit.io.splats.spz import spz_bytes
from surfkit.scene.scene import Frame
from surfkit.testing.format_checks import splat_table

SPLATS, COMPRESSED = "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"


def parsed(path):
    """The JSON of a GLB file, and its data, by the specification and nothing of ours."""
    data = path.read_bytes()
    magic, version, total, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), b"JSON") and size % 4 == 0
    document, rest = json.loads(data[20 : 20 + size]), data[20 + size :]
    if not rest:
        return document, b""
    length, kind = struct.unpack_from("<I4s", rest)
    assert kind == b"BIN\0" and length == len(rest) - 8 and length % 4 == 0
    assert document["buffers"] == [{"byteLength": length}]
    return document, rest[8:]


def attribute(document, data, name):
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    assert view["byteOffset"] % 4 == 0 and view["target"] == 34962
    dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
    return np.frombuffer(data, dtype, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)


def glb(path, document, data=b""):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(data), b"BIN\0") + data if data else b""
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


def foreign(table, **node):
    """A document of another program: float attributes, and no note of ours."""
    columns = {
        "POSITION": table.means,
        f"{SPLATS}:ROTATION": table.quats.roll(-1, 1),
        f"{SPLATS}:SCALE": table.log_scales.exp(),
        f"{SPLATS}:OPACITY": table.opacity_logits.sigmoid()[:, None],
        f"{SPLATS}:SH_DEGREE_0_COEF_0": table.sh0,
    }
    for at, (band, order) in enumerate([(1, 0), (1, 1), (1, 2)][: table.sh_rest.shape[1]]):
        columns[f"{SPLATS}:SH_DEGREE_{band}_COEF_{order}"] = table.sh_rest[:, at]
    parts = [column.numpy().astype("<f4").tobytes() for column in columns.values()]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [1]}],
        "nodes": [{"mesh": 0, **node}, {"children": [0], "scale": [2, 2, 2]}],
        "meshes": [
            {
                "primitives": [
                    {
                        "mode": 0,
                        "attributes": {name: at for at, name in enumerate(columns)},
                        "extensions": {SPLATS: extension},
                    }
                ]
            }
        ],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part)}
            for start, part in zip(starts[:-1], parts, strict=True)
        ],
        "accessors": [
            {"bufferView": at, "componentType": 5126, "count": len(column), "type": kinds[column.shape[1]]}
            for at, column in enumerate(columns.values())
        ],
    }, b"".join(parts)


def test_one_splat_is_written_as_computed_by_hand(tmp_path):
    table = SplatTable(
        kind="surfel",
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        quats=torch.tensor([[2.0, 0.0, 0.0, 2.0]]),
        log_scales=torch.tensor([[0.0, np.log(0.5)]]),
        opacity_logits=torch.tensor([np.log(3.0)], dtype=torch.float32),
        sh0=torch.tensor([[0.0, 5.0, -5.0]]),
        sh_rest=torch.arange(45.0).reshape(1, 15, 3),
    )
    GLTF().write(tmp_path / "a.glb", table)
    document, data = parsed(tmp_path / "a.glb")
    found = {name: attribute(document, data, name) for name in document["meshes"][0]["primitives"][0]["attributes"]}
    assert found.pop("POSITION").tolist() == [[1, 2, 3]]
    half = np.float32(np.sqrt(0.5))
    np.testing.assert_allclose(found.pop(f"{SPLATS}:ROTATION"), [[0, 0, half, half]], rtol=1e-6)
    np.testing.assert_allclose(found.pop(f"{SPLATS}:SCALE"), [[1, 0.5, 0.0005]], rtol=1e-6)
    np.testing.assert_allclose(found.pop(f"{SPLATS}:OPACITY"), [[0.75]], rtol=1e-6)
    assert found.pop(f"{SPLATS}:SH_DEGREE_0_COEF_0").tolist() == [[0, 5, -5]]
    assert found.pop("COLOR_0").tolist() == [[55, 255, 0, 191]]  # (0.5 to linear = 0.214) x 255, 0.75 x 255
    at = iter(range(0, 45, 3))
    for degree in (1, 2, 3):
        for order in range(2 * degree + 1):
            first = next(at)
            assert found.pop(f"{SPLATS}:SH_DEGREE_{degree}_COEF_{order}").tolist() == [[first, first + 1, first + 2]]
    assert not found
    assert document["nodes"][0]["name"] == document["meshes"][0]["name"] == "splats"
    primitive, position = document["meshes"][0]["primitives"][0], document["accessors"][0]
    assert primitive["mode"] == 0 and position["min"] == position["max"] == [1, 2, 3]
    assert primitive["extensions"] == {
        SPLATS: {
            "kernel": "ellipse",
            "colorSpace": "srgb_rec709_display",
            "sortingMethod": "cameraDistance",
            "projection": "perspective",
        }
    }
    assert document["extensionsUsed"] == [SPLATS] and "extensionsRequired" not in document


def test_up_becomes_y(tmp_path):
    table, mapped = splat_table(count=5), Frame(np.zeros(3), 1.0, crs="EPSG:32632")
    for up, frame, down in (("auto", None, (0, -1, 0)), ("auto", mapped, (0, 0, 1)), ("y", None, (0, 1, 0))):
        GLTF(up=up).write(tmp_path / "a.glb", table, frame)
        node = parsed(tmp_path / "a.glb")[0]["nodes"][0]
        matrix = np.array(node.get("matrix", np.eye(4).ravel())).reshape(4, 4).T
        assert (matrix[:3, :3] @ down).tolist() == [0, 1, 0] and np.linalg.det(matrix) == 1
        assert torch.equal(read_splats(tmp_path / "a.glb").means, table.means)


@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 200])
def test_what_is_written_is_read(tmp_path, kind, degree, count):
    table = replace(splat_table(kind, count, degree), antialias=kind == "gaussian")
    GLTF().write(tmp_path / "a.glb", table)
    back = GLTF().read(tmp_path / "a.glb")
    assert (back.kind, len(back), back.sh_degree, back.antialias) == (kind, count, degree, table.antialias)
    for name in ("means", "sh0", "sh_rest"):
        assert torch.equal(getattr(back, name), getattr(table, name)), name
    for name in ("log_scales", "opacity_logits"):
        torch.testing.assert_close(getattr(back, name), getattr(table, name), rtol=0, atol=1e-5)
    torch.testing.assert_close(back.quats, torch.nn.functional.normalize(table.quats, dim=1))
    first = (tmp_path / "a.glb").read_bytes()
    GLTF().write(tmp_path / "b.glb", back)
    again = GLTF().read(tmp_path / "b.glb")
    assert torch.equal(again.means, back.means) and (count == 0) == (b"BIN\0" not in first)


def test_opacities_of_0_and_1_stay_finite(tmp_path):
    table = splat_table(count=4)
    table = replace(table, opacity_logits=torch.tensor([-200.0, 200, 0, 5]), log_scales=table.log_scales - 300)
    GLTF().write(tmp_path / "a.glb", table)
    back = GLTF().read(tmp_path / "a.glb")
    assert torch.isfinite(back.opacity_logits).all() and torch.isfinite(back.log_scales).all()
    assert back.opacity_logits[0] < -50 and back.opacity_logits[1] > 15


@pytest.mark.parametrize("compress", ["none", "spz"])
def test_coordinates_far_from_0_keep_millimetres(tmp_path, compress):
    shift = torch.tensor([500_123.0, 5_783_283.0, -40.0], dtype=torch.float64)
    table = splat_table(count=50)
    table = replace(table, means=table.means.double() + shift)
    mapped = Frame(shift.numpy(), 1.0, metres=1.0, crs="EPSG:32634", shift=(500_000.0, 5_783_000.0, 0.0))
    for frame in (None, mapped):
        GLTF(compress=compress).write(tmp_path / "a.glb", table, frame)
        means = GLTF().read(tmp_path / "a.glb").means
        assert means.dtype == torch.float64
        away = torch.cdist(table.means - shift, means - shift).min(1).values.max()
        assert away < (1e-5 if compress == "none" else 1e-3)
    notes = parsed(tmp_path / "a.glb")[0]["asset"]["extras"]["surfkit"]
    assert (notes["crs"], notes["offset"], notes["metres_per_unit"]) == ("EPSG:32634", [500_000, 5_783_000, 0], 1)


@pytest.mark.parametrize("degree", [0, 3])
def test_compressed_files_are_what_cesiumjs_expects(tmp_path, degree):
    GLTF(compress="spz").write(tmp_path / "a.glb", splat_table(count=40, degree=degree))
    document, data = parsed(tmp_path / "a.glb")
    assert document["extensionsRequired"] == document["extensionsUsed"] == [SPLATS, COMPRESSED]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["extensions"] == {SPLATS: {"extensions": {COMPRESSED: {"bufferView": 0}}}}
    named = [name for name in primitive["attributes"] if "SH_DEGREE" in name]
    assert len(named) == (15 if degree else 0) and not any("SH_DEGREE_0" in name for name in named)
    assert {"POSITION", "COLOR_0", f"{SPLATS}:SCALE", f"{SPLATS}:ROTATION"} == set(primitive["attributes"]) - set(named)
    assert all("bufferView" not in accessor for accessor in document["accessors"])
    assert len(document["nodes"][0]["matrix"]) == 16
    view = document["bufferViews"][0]
    assert data[view["byteOffset"] :][:2] == b"\x1f\x8b"  # gzip


def test_compressed_rotations_are_near_for_every_splat(tmp_path):
    count = 4_000
    table = replace(splat_table(count=count, degree=0), means=torch.stack([torch.arange(count) / 100.0] * 3, 1))
    GLTF(compress="spz").write(tmp_path / "a.glb", table)
    back = GLTF().read(tmp_path / "a.glb")
    back = back.take(back.means[:, 0].argsort())
    before, after = (Rotation.from_quat(np.roll(found.quats.numpy(), -1, 1)).as_matrix() for found in (table, back))
    cosines = np.abs(np.einsum("nij,nij->nj", before, after)).min(1)  # of the same axes, whichever way they point
    assert np.degrees(np.arccos(cosines.clip(-1, 1))).max() < 1.8
    GLTF(compress="spz").write(tmp_path / "b.glb", GLTF().read(tmp_path / "a.glb"))
    assert (tmp_path / "b.glb").read_bytes() == (tmp_path / "a.glb").read_bytes()


def test_compressed_data_by_the_draft_is_turned_and_by_cesium_is_not(tmp_path):
    table = splat_table(count=30)
    GLTF(compress="spz", up="y").write(tmp_path / "a.glb", table)
    document, data = parsed(tmp_path / "a.glb")
    plain = read_splats(tmp_path / "a.glb")
    about = document["meshes"][0]["primitives"][0]["extensions"][SPLATS]
    about |= {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    strict = read_splats(glb(tmp_path / "b.glb", document, data))
    np.testing.assert_allclose(strict.means, plain.means * torch.tensor([-1, 1, -1]), atol=1e-6)
    torch.testing.assert_close(strict.sh_rest, turned(plain, np.diag([-1.0, 1, -1])).sh_rest)


def test_files_of_other_programs_are_read_with_their_nodes(tmp_path):
    table = splat_table(count=20, degree=1)
    quarter = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # about z: x becomes y
    path = glb(tmp_path / "a.glb", *foreign(table, translation=[1, 2, 3], rotation=quarter))
    found, turn = read_splats(path), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    wanted = turned(table, turn, 2.0, np.array([2.0, 4, 6]))
    for name in ("means", "log_scales", "opacity_logits", "sh0", "sh_rest"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=2e-5, err_msg=name)
    x, y, z = table.sh_rest[:, 2], table.sh_rest[:, 0], table.sh_rest[:, 1]  # m = 1, -1, 0
    np.testing.assert_allclose(found.sh_rest, torch.stack([x, z, -y], 1), atol=1e-6)


def test_splats_of_several_nodes_are_read_with_their_places(tmp_path):
    table = splat_table(count=20, degree=1)
    document, data = foreign(table, translation=[1, 2, 3])
    document["meshes"] *= 2
    document["nodes"].append({"mesh": 1})
    document["scenes"][0]["nodes"].append(2)
    found = read_splats(glb(tmp_path / "a.glb", document, data))
    moved = 2 * table.means.double() + torch.tensor([2, 4, 6])
    torch.testing.assert_close(found.means, torch.cat([moved, table.means]))
    torch.testing.assert_close(found.sh_rest, table.sh_rest.repeat(2, 1, 1))


@pytest.mark.parametrize("third", [0.0, 1e-9, 0.5])
def test_flat_splats_of_other_programs_are_surfels(tmp_path, third):
    table = splat_table(count=20, degree=0)
    table.log_scales[:, 2] = np.log(third) if third else -torch.inf
    found = GLTF().read(glb(tmp_path / "a.glb", *foreign(table)))
    assert found.kind == ("gaussian" if third == 0.5 else "surfel")
    np.testing.assert_allclose(found.log_scales[:, :2], table.log_scales[:, :2] + np.log(2), atol=1e-5)


def test_flat_splats_in_compressed_files_of_other_programs_are_surfels(tmp_path):
    GLTF(compress="spz").write(tmp_path / "a.glb", splat_table("surfel", count=30))
    document, data = parsed(tmp_path / "a.glb")
    del document["asset"]["extras"]
    assert GLTF().read(glb(tmp_path / "b.glb", document, data)).kind == "surfel"


def test_trimesh_finds_the_same_points(tmp_path):
    trimesh = needs("trimesh")
    table = splat_table(count=300, degree=2)
    GLTF().write(tmp_path / "a.glb", replace(table, means=table.means.double() + 1e6))
    scene = trimesh.load(tmp_path / "a.glb")
    (name,) = scene.graph.nodes_geometry
    matrix, geometry = scene.graph[name]
    points = trimesh.transform_points(scene.geometry[geometry].vertices, matrix)
    np.testing.assert_allclose(points, (table.means.double().numpy() + 1e6) @ UPS["-y"].T, rtol=0, atol=1e-6)


def test_nan_is_refused_and_nothing_is_left(tmp_path):
    table = splat_table(count=5)
    table.log_scales[3, 1] = torch.nan
    with pytest.raises(BadInput, match="log_scales of splat 3 of 5 has NaN"):
        GLTF().write(tmp_path / "a.glb", table)
    assert not list(tmp_path.iterdir())


def changed(document, path, value):
    *inner, last = path
    for key in inner:
        document = document[key]
    document[last] = value


PRIMITIVE = ("meshes", 0, "primitives", 0)
FAULTS = [
    (("extensionsRequired",), ["KHR_draco_mesh_compression"], "requires the extension 'KHR_draco_mesh_compression'"),
    (("scenes", 0, "nodes"), [7], r"there is no nodes\[7\]"),
    (("scenes", 0, "nodes"), [-1], r"there is no nodes\[-1\]"),
    (("nodes", 0, "children"), [1], "hangs below itself"),
    (("nodes", 1, "children"), [0, 0], "hangs below itself or below two others"),
    (("nodes", 1, "scale"), [1, 1, -1], "a node mirrors, shears or stretches"),
    (("nodes", 1, "scale"), [1, 1, 1e400], "no list of 3 numbers"),
    ((*PRIMITIVE, "mode"), 4, "is not made of points"),
    ((*PRIMITIVE, "extensions"), {}, "no primitive of its scene has the extension"),
    ((*PRIMITIVE, "extensions", SPLATS, "kernel"), "cube", "only 'ellipse' is read"),
    ((*PRIMITIVE, "extensions", SPLATS, "extensions"), {"X": {}}, "an extension that is not read"),
    ((*PRIMITIVE, "attributes"), {"POSITION": 0}, "the splats lack KHR_gaussian_splatting:"),
    (("accessors", 0, "count"), 10**9, "goes beyond its data"),
    (("accessors", 0, "count"), 3, "has 20 values, not 3"),
    (("accessors", 1, "type"), "VEC3", "VEC4 is needed"),
    (("accessors", 2, "componentType"), 1, "VEC3 is needed, of one of"),
    (("bufferViews", 0, "byteLength"), 10**12, "beyond the end of the data"),
    (("bufferViews", 0, "byteStride"), -4, "no sound offset, length and stride"),
    (("buffers", 0, "uri"), "a.bin", "lies in another file"),
    (("meshes",), "none", r"there is no meshes\[0\]"),
]


@pytest.mark.parametrize(("where", "value", "text"), FAULTS)
def test_a_damaged_document_gives_one_line(tmp_path, where, value, text):
    document, data = foreign(splat_table(count=20, degree=0))
    changed(document, where, value)
    with pytest.raises(BadInput, match=text) as caught:
        read_splats(glb(tmp_path / "a.glb", document, data))
    assert str(caught.value).startswith(str(tmp_path)) and "\n" not in str(caught.value)


def test_more_splats_than_bytes_are_refused(tmp_path):
    document, data = foreign(splat_table(count=20, degree=0))
    document["accessors"] += [{"bufferView": 0, "componentType": 5121, "count": 4000, "type": "VEC3"}]
    document["bufferViews"][0] = {"buffer": 0, "byteLength": len(data)}
    document["accessors"][-1]["count"] = len(data) // 3
    document["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 5
    with pytest.raises(BadInput, match=f"{len(data) // 3} splats in {len(data)} bytes"):
        read_splats(glb(tmp_path / "a.glb", document, data))


@pytest.mark.parametrize("compress", ["none", "spz"])
def test_damaged_files_give_one_line_each(tmp_path, compress):
    path = tmp_path / "a.glb"
    GLTF(compress=compress).write(path, splat_table(count=30))
    whole, draw = path.read_bytes(), np.random.default_rng(0)
    refused = 0
    for turn in range(300):
        data = bytearray(whole[: draw.integers(len(whole))] if turn % 3 == 0 else whole)
        for _ in range(0 if turn % 3 == 0 else draw.integers(1, 4)):
            data[draw.integers(len(data))] = draw.integers(256)
        path.write_bytes(data)
        try:
            GLTF().read(path)
        except BadInput as error:
            refused += 1
            assert "\n" not in str(error) and len(str(error)) < 400
    assert refused > 100


def test_spz_data_of_another_count_is_refused(tmp_path):
    GLTF(compress="spz").write(tmp_path / "a.glb", splat_table(count=30))
    document, _ = parsed(tmp_path / "a.glb")
    data = spz_bytes(splat_table(count=29), 2, tmp_path)
    document["bufferViews"][0]["byteLength"] = len(data)
    with pytest.raises(BadInput, match="29 splats .*SPZ .* 30 by"):
        read_splats(glb(tmp_path / "b.glb", document, data + b"\0" * (-len(data) % 4)))
