"""Meshes and clouds from files of every kind, and what is wrong with bad ones."""

import struct

import numpy as np
import pytest
from needs import needs

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry import surface
from surfkit.evaluate.geometry.surface import read_surface
from surfkit.export.ply import write_points

trimesh = needs("trimesh")
BOX = trimesh.creation.box((1, 2, 3))


def binary_ply(path, vertices, faces, kind="<f4", corners=3):
    """A mesh as the project writes it: uchar-counted int lists, colours between."""
    word = {"<f4": "float", "<f8": "double"}[kind]
    rows = np.zeros(len(vertices), [(axis, kind) for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
    for i, axis in enumerate("xyz"):
        rows[axis] = np.asarray(vertices)[:, i]
    lists = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", (corners,))])
    lists["n"], lists["v"] = corners, np.asarray(faces).reshape(-1, corners)
    properties = [f"property {word} {axis}" for axis in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties]
    head += [f"element face {len(lists)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(head).encode() + rows.tobytes() + lists.tobytes())
    return path


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_a_binary_mesh_is_mapped_as_trimesh_reads_it(tmp_path, kind):
    path = binary_ply(tmp_path / "mesh.ply", BOX.vertices + 1e6 * (kind == "<f8"), BOX.faces, kind)
    found, other = read_surface(path), trimesh.load(path, process=False)
    assert np.array_equal(found.vertices(), other.vertices) and np.array_equal(found.faces, other.faces)
    assert isinstance(found.rows, np.memmap)


@pytest.mark.parametrize("suffix", ["obj", "stl", "off", "glb"])
def test_other_meshes(tmp_path, suffix):
    path = tmp_path / f"mesh.{suffix}"
    BOX.export(path)
    found = read_surface(path)
    corners = found.vertices()[found.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(22, rel=1e-5)


def test_text_files(tmp_path):
    (tmp_path / "mesh.ply").write_bytes(trimesh.exchange.ply.export_ply(BOX, encoding="ascii"))
    assert np.allclose(read_surface(tmp_path / "mesh.ply").vertices(), BOX.vertices)
    (tmp_path / "cloud.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "1 2 3\n4 5 6\n"
    )
    cloud = read_surface(tmp_path / "cloud.ply")
    assert cloud.faces is None and cloud.vertices().tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_cloud_comes_in_blocks(tmp_path, monkeypatch, told):
    xyz = np.random.default_rng(0).normal(size=(1000, 3))
    xyz[[3, 700]] = np.nan
    write_points(tmp_path / "cloud.ply", xyz, np.zeros((1000, 3), np.uint8))
    monkeypatch.setattr(surface, "BLOCK", 300)
    blocks = list(read_surface(tmp_path / "cloud.ply").blocks())
    assert [len(block) for block in blocks] == [299, 300, 299, 100]
    assert np.array_equal(np.concatenate(blocks), xyz[np.isfinite(xyz).all(1)])
    assert told == [f"{tmp_path / 'cloud.ply'}: 2 of 1000 points are not finite and are left out"]


def test_faces_at_vertices_that_are_not_finite_go(tmp_path, told):
    vertices = BOX.vertices.copy()
    vertices[0] = np.inf
    found = read_surface(binary_ply(tmp_path / "mesh.ply", vertices, BOX.faces))
    assert len(found.faces) == (BOX.faces != 0).all(1).sum() and len(told) == 1


def cloud_with_lists(path, xyz, counted="uchar", first=(), cut=None):
    """A cloud whose points are in i % 4 views each, with a weight for each view, as OpenMVS writes them."""
    lists = [f"property list {counted} uint views", "property float error", "property list uchar double weights"]
    axes = [f"property float {axis}" for axis in "xyz"]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}", *first, *axes, *lists, "end_header"]
    wide = {"uchar": "B", "int": "i", "float": "f"}[counted]
    rows = [
        struct.pack(f"<3f{wide}{i % 4}IfB{i % 4}d", *point, i % 4, *range(i % 4), 0.5, i % 4, *[1.0] * (i % 4))
        for i, point in enumerate(xyz)
    ]
    path.write_bytes(("\n".join(head) + "\n").encode() + b"".join(rows)[:cut])
    return path


@pytest.mark.parametrize("counted", ["uchar", "int"])
def test_points_with_lists(tmp_path, counted):
    xyz = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    found = read_surface(cloud_with_lists(tmp_path / "cloud.ply", xyz, counted))
    assert found.faces is None and np.array_equal(found.vertices(), xyz)


def test_bad_points_with_lists(tmp_path):
    xyz = np.ones((6, 3), np.float32)
    for cut in (-1, -9, -10):  # within the last list, before its count, within the number before that
        with pytest.raises(BadInput, match="cut off after 5 of 6 vertices"):
            read_surface(cloud_with_lists(tmp_path / "cloud.ply", xyz, cut=cut))
    with pytest.raises(BadInput, match="counts its numbers with float"):
        read_surface(cloud_with_lists(tmp_path / "cloud.ply", xyz, "float"))
    for line, message in {
        "property list uchar int a": "do not come before 'property list uchar int a'",
        "property half a": "cannot read 'property half a' of a vertex",
        "property float x": "or one twice: x, x",
    }.items():
        with pytest.raises(BadInput, match=message):
            read_surface(cloud_with_lists(tmp_path / "cloud.ply", xyz, first=[line]))
    path = cloud_with_lists(tmp_path / "cloud.ply", xyz)
    whole = path.read_bytes()
    for line in (b"property list uchar double", b"property list half double weights", b"property list"):
        path.write_bytes(whole.replace(b"property list uchar double weights", line))
        with pytest.raises(BadInput, match="cannot read 'property list.* of a vertex"):
            read_surface(path)
    path.write_bytes(whole.replace(b"end_header", b"comment"))
    with pytest.raises(BadInput, match="the PLY header does not end"):
        read_surface(path)
    path.write_bytes(whole.replace(b"element vertex 6", b"element camera 6"))
    with pytest.raises(BadInput, match="the first element must be 'element vertex N'"):
        read_surface(path)


@pytest.mark.parametrize(
    ("name", "vertices", "faces", "corners", "message"),
    [
        ("without", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [], 3, "a mesh without faces"),
        ("empty", np.empty((0, 3)), [], 3, "no points in it"),
        ("nan", np.full((3, 3), np.nan), [[0, 1, 2]], 3, "none of its 3 points is finite"),
        ("far", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 3]], 3, "names vertex 3 of 3"),
        ("quads", [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2, 3]] * 8, 4, "triangulate it"),
    ],
)
def test_bad_meshes(tmp_path, name, vertices, faces, corners, message):
    with pytest.raises(BadInput, match=message):
        read_surface(binary_ply(tmp_path / f"{name}.ply", np.reshape(vertices, (-1, 3)), faces, corners=corners))


def test_bad_files(tmp_path):
    path = binary_ply(tmp_path / "mesh.ply", BOX.vertices, BOX.faces)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(BadInput, match="cut off"):
        read_surface(path)
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(BadInput, match="does not begin with 'ply'"):
        read_surface(tmp_path / "text.ply")
    with pytest.raises(BadInput, match="no such file"):
        read_surface(tmp_path / "missing.ply")
    (tmp_path / "mesh.xyzzy").write_text("hello")
    with pytest.raises(BadInput, match="cannot be read as a mesh"):
        read_surface(tmp_path / "mesh.xyzzy")
