"""What is measured of a mesh by itself, against shapes whose figures are known, and against open3d."""

import json
from pathlib import Path

import numpy as np
import pytest
from needs import needs

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface
from surfkit.evaluate.mesh import boxes as cubes
from surfkit.evaluate.mesh import crossing, roughness
from surfkit.evaluate.mesh.boxes import boxes
from surfkit.evaluate.mesh.crossing import crossing_faces, crossings
from surfkit.evaluate.mesh.edges import boundary_edges, connections
from surfkit.evaluate.mesh.measure_mesh import measure_mesh
from surfkit.evaluate.mesh.roughness import radius_for, residuals
from surfkit.evaluate.mesh.whole import whole_mesh
from surfkit.scene.same_places import first_in_place

trimesh = needs("trimesh")
open3d = needs("open3d")


def surface(mesh, offset=(0.0, 0.0, 0.0), kind=np.float64):
    return SurfaceFile(Path("mesh.obj"), np.array(mesh.vertices, kind), np.array(mesh.faces, np.int32), offset)


def whole(mesh):
    return whole_mesh(surface(mesh))


def disc(rim=24):
    """A fan: `rim` triangles around a middle, with as many edges at the rim and as many spokes."""
    angle = np.linspace(0, 2 * np.pi, rim, endpoint=False)
    around = np.arange(rim)
    vertices = np.vstack([[0, 0, 0], np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)])
    return trimesh.Trimesh(vertices, np.stack([0 * around, 1 + around, 1 + (around + 1) % rim], 1), process=False)


def terrain(side=60, step=0.1, noise=0.0, seed=0):
    """A square of triangles, with heights of normal noise."""
    x, y = np.meshgrid(*[np.arange(side + 1)] * 2)
    heights = noise * np.random.default_rng(seed).normal(size=x.size)
    at = (x[:-1, :-1] + (side + 1) * y[:-1, :-1]).ravel()
    a, b, c, d = at, at + 1, at + side + 1, at + side + 2
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return trimesh.Trimesh(np.stack([x.ravel() * step, y.ravel() * step, heights], 1), faces, process=False)


def balls(seed, count=5):
    """Spheres that cross each other and a long box, whose triangles are a hundred times as large."""
    random = np.random.default_rng(seed)
    made = [
        trimesh.creation.icosphere(2, random.uniform(0.2, 2)).apply_translation(random.normal(size=3))
        for _ in range(count)
    ]
    return trimesh.util.concatenate([*made, trimesh.creation.box((90, 0.7, 1.1))])


def as_open3d(mesh):
    return open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices), open3d.utility.Vector3iVector(mesh.faces)
    )


def test_edges_of_a_sphere_and_a_disc():
    sphere, open_disc = trimesh.creation.icosphere(3), disc(24).apply_translation([9, 0, 0])
    found = connections(whole(sphere))
    assert (found.edges, found.boundary_edges, found.non_manifold_edges) == (len(sphere.edges_unique), 0, 0)
    found = connections(whole(open_disc))
    assert (found.edges, found.boundary_edges, found.components) == (48, 24, 1)
    rim, edges = boundary_edges(whole(open_disc))
    assert len(rim) == 24 and (rim > 0).all() and edges == 48  # none is a spoke
    both = connections(whole(trimesh.util.concatenate([sphere, open_disc])))
    assert both.components == 2 and both.boundary_edges == 24


def test_edges_with_three_and_four_triangles():
    """Leaves of a book on one back, each two triangles; and the same leaf twice."""
    leaves = [[0, 1, 2 + n] for n in range(4)]
    corners = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], float)
    for count in (1, 2, 3, 4):
        mesh = trimesh.Trimesh(corners[: 2 + count], leaves[:count], process=False)
        found = connections(whole(mesh))
        assert found.non_manifold_edges == (count > 2) and found.components == 1
        assert found.boundary_edges == (3 if count == 1 else 2 * count)
        assert len(as_open3d(mesh).get_non_manifold_edges(allow_boundary_edges=True)) == found.non_manifold_edges


def test_vertices_in_one_place_are_one(tmp_path):
    """As an STL has them, and OBJ along seams; without that every edge would be a boundary."""
    box = trimesh.creation.box((1, 2, 3))
    loose = trimesh.Trimesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    loose.vertices[loose.vertices == 0] *= -1
    assert connections(whole(loose)) == connections(whole(box)) and connections(whole(box)).edges == 18
    places = np.array([[0.0, 1, 2], [-0.0, 1, 2], [3, 4, 5], [0, 1, 2]])
    for kind in (np.float32, np.float64):
        assert first_in_place(places.astype(kind)).tolist() == [0, 0, 2, 0]
        assert first_in_place(places[1:3].astype(kind)) is None


def test_faces_without_area():
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], [[0, 1, 2], [0, 1, 3]], process=False)
    assert measure_mesh(surface(flat)).figures["degenerate"] == 1
    with pytest.raises(BadInput, match="no area"):
        whole_mesh(SurfaceFile(Path("mesh.obj"), np.zeros((3, 3)), np.array([[0, 1, 2]])))


@pytest.mark.parametrize("seed", range(3))
def test_crossing_triangles_are_those_of_open3d(seed):
    mesh = balls(seed)
    wanted = np.unique(np.asarray(as_open3d(mesh).get_self_intersecting_triangles()))
    found = np.flatnonzero(crossing_faces(whole(mesh), np.arange(len(mesh.faces))))
    assert 100 < len(wanted) < len(mesh.faces) / 2 and np.array_equal(found, wanted)
    assert crossings(whole(mesh)) == crossing.Crossings(len(wanted) / len(mesh.faces), len(wanted), len(mesh.faces))


def test_what_touches_does_not_cross():
    assert crossings(whole(trimesh.creation.box())).crossing == 0
    assert crossings(whole(terrain(noise=0.01))).crossing == 0
    stacked = trimesh.util.concatenate(
        [trimesh.creation.box(), trimesh.creation.box().apply_translation([0.3, 0.2, 1.0])]
    )
    assert crossings(whole(stacked)).crossing == 0  # faces in one plane


def test_cubes_find_the_share_of_the_whole(monkeypatch):
    """Each triangle that lies within a cube is judged as it would be in the whole mesh."""
    mesh = trimesh.util.concatenate([terrain(100), terrain(100).apply_translation([0.03, 0.05, 0])])
    mesh.vertices[:, 2] += 0.05 * np.sin(37 * mesh.vertices[:, 0]) * np.where(mesh.vertices[:, 0] < 5, 1, 0)
    told = whole(mesh)
    every = crossing_faces(told, np.arange(len(told.faces)))
    monkeypatch.setattr(crossing, "MAX_WHOLE_TRIANGLES", 1000)
    monkeypatch.setattr(crossing, "TRIANGLES_PER_CUBE", 200)
    found = crossings(told)
    assert 0.1 < every.mean() < 0.9 and 2000 < found.measured < 20_000 and found.boxes > 10
    assert found.share == pytest.approx(every.mean(), abs=0.05)
    judged = 0
    for box in boxes(told, found.side, cubes.by_number(told, crossing.SAMPLED_CUBES)):
        within = box.has(told.corners(box.faces)).all(1)
        own = crossing_faces(told, box.faces)
        assert np.array_equal(own[within], every[box.faces[within]])
        judged += within.sum()
    assert judged == found.measured


@pytest.mark.parametrize("block", [1 << 20, 50])
def test_cubes_have_all_faces_that_reach_into_them(monkeypatch, block):
    monkeypatch.setattr(cubes, "BLOCK_POINTS", block)
    told = whole(balls(0))
    corners = told.corners(slice(None))
    for margin in (0.0, 0.2):
        found = boxes(told, 0.5, cubes.by_area(told, 20), margin)
        assert 10 < len(found) <= 20
        for box in found:
            touches = ((corners.min(1) <= box.high + margin) & (corners.max(1) >= box.low - margin)).all(1)
            assert np.array_equal(box.faces, np.flatnonzero(touches))


def test_roughness_of_noise_on_a_plane():
    """Between vertices with independent noise the surface is linear, and the mean of the sum of the squares of the
    barycentric coordinates over a triangle is a half: so is the variance of the surface."""
    for noise in (0.0, 0.01, 0.03):
        found = roughness.roughness(whole(terrain(300, 0.1, noise)), 1.0)
        assert found.on_planes == pytest.approx(noise / np.sqrt(2), rel=0.06, abs=1e-9)
        assert found.is_plane.all() and len(found.values) > 1000
    tilted = terrain(300, 0.1, 0.02).apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    assert roughness.roughness(whole(tilted), 1.0).on_planes == pytest.approx(0.02 / np.sqrt(2), rel=0.06)


def test_edges_of_a_house_are_no_planes():
    """A cube of 8 m in balls of 1 m: the planes are what is a metre from the edges, and have no roughness."""
    found = roughness.roughness(whole(trimesh.creation.box((8, 8, 8))), 1.0)
    distance = np.sort(np.abs(np.abs(found.places) - 4), axis=1)[:, 1]  # to the nearest edge
    assert found.values[distance > 1.01].max() < 1e-6 and found.is_plane[distance > 1.01].all()
    assert not found.is_plane[distance < 0.2].any()


def test_residuals_are_those_of_a_fit():
    points = np.random.default_rng(0).normal(size=(400, 3)) * [1, 1, 0.05]
    (found,) = residuals(points, np.zeros((1, 3)), 0.8)
    near = points[np.linalg.norm(points, axis=1) <= 0.8]
    assert found == pytest.approx(np.linalg.svd(near - near.mean(0))[1][2] / np.sqrt(len(near) - 3))
    assert np.isnan(residuals(points, np.full((1, 3), 9.0), 0.8)).all()


def test_radius():
    """A metre where metres are known; else the same for meshes of about the same size."""
    small, large = (whole(terrain(side, 1.0)) for side in (300, 320))
    assert radius_for(small, None) == radius_for(large, None) == 2.0
    assert radius_for(small, 0.3048) == pytest.approx(1 / 0.3048)


def test_figures_in_metres():
    """Of the same mesh in metres and in feet, beside each other: all but the counts have the unit."""
    metres, feet = terrain(120, 0.1, 0.02), terrain(120, 0.1, 0.02)
    feet.vertices /= 0.3048
    one, other = measure_mesh(surface(metres), 1.0), measure_mesh(surface(feet, (5e6, 1.0, 0.0)), 0.3048)
    assert one.figures["unit"] == "m" and one.figures["triangles"] == 2 * 120**2
    assert one.figures["area"] == pytest.approx(metres.area)
    assert one.figures["triangles_per_area"] == pytest.approx(2 * 120**2 / metres.area)
    for name, part in (("area", one.figures), ("on_planes", one.figures["roughness"])):
        twin = other.figures["roughness"] if name == "on_planes" else other.figures
        assert part[name] == pytest.approx(twin[name], rel=1e-3)
    assert other.roughness.places[:, 0].min() > 5e6 - 1
    assert one.figures["boundary_share"] == 4 * 120 / len(metres.edges_unique)
    assert json.loads(json.dumps(one.figures, allow_nan=False)) == one.figures
    assert measure_mesh(surface(metres)).figures["unit"] == "unit"


def test_the_unit_that_a_file_says(tmp_path):
    path = tmp_path / "mesh.ply"
    terrain(20).export(path)
    whole_file = path.read_bytes()
    assert measure_mesh(read_surface(path)).figures["unit"] == "unit"
    path.write_bytes(whole_file.replace(b"element vertex", b"comment metres per unit: 0.5\nelement vertex"))
    found = measure_mesh(read_surface(path)).figures
    assert found["unit"] == "m" and found["area"] == pytest.approx(2.0**2 / 4)
    assert measure_mesh(read_surface(path), 1.0).figures["area"] == pytest.approx(2.0**2), (
        "who knows better is believed"
    )
    path.write_bytes(whole_file.replace(b"element vertex", b"comment metres per unit: x\nelement vertex"))
    with pytest.raises(BadInput, match="metres per unit: x: .*above 0"):
        measure_mesh(read_surface(path))
