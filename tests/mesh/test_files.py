"""Files of meshes, read back by another library."""

import json

import numpy as np
import pytest
from needs import needs

from surfkit.mesh.base import Mesh
from surfkit.mesh.files import write_mesh
from surfkit.mesh.simplify import simplify_to
from surfkit.scene.scene import Frame

trimesh = needs("trimesh")
UTM = Frame(np.array([412_345.678, 5_712_345.678, 99.5]), 0.01, 1.0, "EPSG:32632")


def ball(divisions=3):
    found = trimesh.creation.icosphere(divisions)
    vertices = np.asarray(found.vertices, np.float32)
    colors = ((vertices + 1) * 127).astype(np.uint8)
    return Mesh(vertices, np.asarray(found.faces, np.int32), colors)


def colors_of(read):
    return np.asarray(read.visual.vertex_colors)[:, :3]


@pytest.mark.parametrize("kind", ["ply", "obj"])
def test_coordinates_are_those_of_the_input_to_a_tenth_of_a_millimetre(tmp_path, kind):
    mesh, path = ball(), tmp_path / f"mesh.{kind}"
    assert write_mesh(path, mesh, UTM) == [path]
    read = trimesh.load(path, process=False, maintain_order=True)
    assert np.abs(read.vertices - UTM.to_input(mesh.vertices)).max() < 1e-4
    assert np.array_equal(read.faces, mesh.faces)
    assert np.abs(colors_of(read).astype(int) - mesh.colors).max() <= (1 if kind == "obj" else 0)
    assert b"EPSG:32632" in path.read_bytes()[:300]


def test_glb_has_an_offset_beside_it(tmp_path):
    mesh, path = ball(), tmp_path / "mesh.glb"
    written = write_mesh(path, mesh, UTM)
    assert [file.name for file in written] == ["mesh.glb", "mesh.glb.json"]
    beside = json.loads(written[1].read_text())
    assert beside["crs"] == "EPSG:32632" and beside["metres_per_unit"] == 1.0
    scene = trimesh.load(path, process=False)
    read = next(iter(scene.geometry.values()))
    assert np.abs(read.vertices + beside["offset"] - UTM.to_input(mesh.vertices)).max() < 1e-3
    assert np.array_equal(read.faces, mesh.faces)
    turn = scene.graph.get(scene.graph.nodes_geometry[0])[0]
    assert np.allclose(turn[:3, :3] @ [0, 0, 1], [0, 1, 0]), "up is y in glTF"
    write_mesh(path, mesh, Frame(UTM.origin, UTM.scale))
    scene = trimesh.load(path, process=False)
    assert np.allclose(scene.graph.get(scene.graph.nodes_geometry[0])[0], np.eye(4)), "nobody knows what is up"


def test_colours_of_glb_are_linear(tmp_path):
    """By trimesh, and all 256 of them stay apart: 16 bits are enough for the darkest."""
    mesh, path = ball(), tmp_path / "mesh.glb"
    mesh.colors[:256] = np.arange(256)[:, None]
    write_mesh(path, mesh, UTM)
    (read,) = trimesh.load(path, process=False).geometry.values()
    colors = np.asarray(read.visual.vertex_attributes["color"])
    assert colors.dtype == np.uint16 and (colors[:, 3] == 65535).all()
    shown = colors[:, :3] / 65535
    assert shown[128] == pytest.approx(0.21586, abs=1e-5) and shown[10] == pytest.approx(0.00304, abs=1e-5)
    back = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    assert np.array_equal(np.round(255 * back), mesh.colors)


def test_open3d_reads_linear_colours(tmp_path):
    open3d = needs("open3d")
    mesh = ball()
    mesh.colors[:] = 128
    write_mesh(tmp_path / "mesh.glb", mesh, UTM)
    read = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.glb"))
    assert np.asarray(read.vertex_colors) == pytest.approx(0.21586, abs=1e-4)


@pytest.mark.parametrize("kind", ["ply", "obj", "glb"])
def test_meshes_without_colour_and_large_ones(tmp_path, kind, monkeypatch):
    monkeypatch.setattr("surfkit.mesh.files.CHUNK", 100)
    mesh = ball()
    path = tmp_path / f"mesh.{kind}"
    write_mesh(path, Mesh(mesh.vertices, mesh.faces), Frame(np.zeros(3), 0.5))
    read = trimesh.load(path, process=False, force="mesh", maintain_order=True)
    assert np.abs(read.vertices - 2 * mesh.vertices).max() < 1e-5 and np.array_equal(read.faces, mesh.faces)


def test_fewer_triangles_of_the_same_surface():
    needs("fast_simplification", "simplification")
    mesh = ball(4)
    small = simplify_to(mesh, len(mesh.faces) // 10)
    assert 0.08 * len(mesh.faces) < len(small.faces) < 0.12 * len(mesh.faces)
    assert np.abs(np.linalg.norm(small.vertices, axis=1) - 1).max() < 0.03
    assert np.abs(small.colors.astype(int) - (small.vertices + 1) * 127).max() < 25
    assert small.vertices.dtype == np.float32 and small.faces.dtype == np.int32
