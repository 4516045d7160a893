"""A closed mesh is one by trimesh, which reads it as a file: it makes vertices in one place one."""

import numpy as np
import pytest
from needs import needs

from surfkit.core.check import BadInput
from surfkit.mesh.base import Mesh
from surfkit.mesh.closed import closed, open_or_crowded
from surfkit.mesh.holes import edges
from surfkit.mesh.manifold import apart, separated
from surfkit.mesh.mesh_export import write_mesh
from surfkit.scene.scene import Frame

trimesh = needs("trimesh")
UP = np.array([0.0, 0.0, 1.0])


def as_mesh(found, **more):
    return Mesh(np.asarray(found.vertices, np.float32), np.asarray(found.faces, np.int32), **more)


def joined(*meshes):
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces).astype(np.int32))


def read(mesh, folder, kind="ply"):
    path = folder / f"mesh.{kind}"
    write_mesh(path, mesh, Frame(np.array([4e5, 5e6, 100.0]), 0.01, shift=(4e5, 5e6, 0.0)))
    return trimesh.load(path, force="mesh")


def is_solid(found):
    return found.is_watertight and found.is_winding_consistent and found.volume > 0


def ground(side=20, gone=()):
    """A bumpy square of 2 by 2, without some of its cells."""
    x, y = np.meshgrid(*2 * [np.linspace(0, 2, side + 1)], indexing="ij")
    at = np.arange((side + 1) ** 2).reshape(side + 1, -1)
    cells = [(i, j) for i in range(side) for j in range(side) if (i, j) not in gone]
    faces = [f for i, j in cells for f in ([at[i, j], at[i + 1, j], at[i + 1, j + 1]], [at[i, j], at[i + 1, j + 1], at[i, j + 1]])]  # fmt: skip  # noqa: E501
    z = 0.1 * np.sin(3 * x) * np.sin(3 * y)
    return Mesh(np.stack([x, y, z], 2).reshape(-1, 3).astype(np.float32), np.array(faces, np.int32))


@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_open_ground_gets_walls_and_a_base(tmp_path, kind):
    """With a large hole, and two small ones that touch, so are one; against the volume down to the base."""
    gone = {(3, 3), (4, 4), *((i, j) for i in range(8, 18) for j in range(8, 18))}
    mesh, done = closed(ground(gone=gone), UP)
    found = read(mesh, tmp_path, kind)
    assert is_solid(found) and done.skirts == 1 and done.holes == 2 and done.largest_hole == 40 and done.dropped == 0
    assert done.cut == 1 and done.base == pytest.approx(-0.1 - 0.02 * 2, abs=1e-3)
    bottom = found.face_normals[:, 2] < -0.999
    assert found.area_faces[bottom].sum() == pytest.approx(2e4**2 / 1e4, rel=1e-3), "the base is flat and whole"
    assert done.volume * 1e6 == pytest.approx(found.volume, rel=1e-3)
    assert done.volume == pytest.approx(4 * 0.14, rel=0.08)
    assert bottom.sum() < 200, "and has few triangles"


def test_bodies_are_filled_where_they_are_open():
    ball = as_mesh(trimesh.creation.icosphere(3))
    holed = Mesh(ball.vertices, ball.faces[~np.isin(ball.faces, [100, 300, 500]).any(1)])
    mesh, done = closed(holed, UP)
    found = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert is_solid(found) and (done.holes, done.skirts, done.base) == (3, 0, None)
    assert found.volume == pytest.approx(4.19, rel=0.03)


def test_parts_that_touch_are_cut_apart(tmp_path):
    """Cubes that share an edge, and balls that share a vertex: trimesh finds neither closed before."""
    cube = as_mesh(trimesh.creation.box())
    both = joined(cube, Mesh(cube.vertices + np.float32([1, 1, 0]), cube.faces))
    _, first, at = np.unique(both.vertices, axis=0, return_index=True, return_inverse=True)
    crowded = Mesh(both.vertices[first], at[both.faces].astype(np.int32))
    assert not trimesh.Trimesh(crowded.vertices, crowded.faces).is_watertight and open_or_crowded(crowded) == 1
    mesh, done = closed(crowded, UP)
    assert done.cut == 2 and is_solid(read(mesh, tmp_path)) and done.volume == pytest.approx(2, rel=0.02)
    inner, outer = separated(crowded), closed(crowded, UP)[0]
    assert len(inner.vertices) == 16 and open_or_crowded(outer) == 0
    assert len(np.unique(apart(inner).vertices, axis=0)) == 16


def test_tiny_parts_in_one_place_come_apart():
    """So small that a hundredth of their size is lost in 32 bits."""
    solid = as_mesh(trimesh.creation.icosphere(0))
    tiny = Mesh(np.float32(1) + np.float32(2e-7) * solid.vertices, solid.faces)
    mesh = joined(Mesh(solid.vertices, solid.faces), *[tiny] * 5)
    assert open_or_crowded(mesh) >= 30 and open_or_crowded(apart(mesh)) == 0


@pytest.mark.parametrize("quarters", range(4))
def test_triangles_at_a_crowded_edge_stay_with_those_beside_them(quarters):
    """Two tetrahedra with an edge in common, one within the wedge of the other: both stay closed."""
    corners = [[0, 0, 0], [0, 0, 1], [2, 0, 0.5], [0, 2, 0.5], [1, 0.5, 0.4], [0.5, 1, 0.4]]
    faces = [f for a, b, c, d in ((0, 1, 2, 3), (0, 1, 4, 5)) for f in ((b, a, c), (a, b, d), (c, d, b), (d, c, a))]
    turned = np.array(faces, np.int32)[:, ::-1]
    places = np.array(corners, np.float32) @ np.linalg.matrix_power([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], quarters)
    found = separated(Mesh(places.astype(np.float32), np.ascontiguousarray(turned)))
    assert len(found.vertices) == 8 and len(edges(found)[1]) == 0
    assert trimesh.Trimesh(found.vertices, found.faces, process=False).is_watertight


def test_what_encloses_nothing_goes():
    ball = as_mesh(trimesh.creation.icosphere(3))
    inside_out = Mesh(0.3 * ball.vertices + np.float32([3, 0, 0]), ball.faces[:, ::-1])
    scrap = Mesh(0.01 * ground(2).vertices + np.float32([0, 3, 0]), ground(2).faces)
    mesh, done = closed(joined(ball, inside_out, scrap), UP)
    assert (done.dropped, done.dropped_triangles) == (2, len(ball.faces) + 8)
    assert len(mesh.faces) == len(ball.faces)
    with pytest.raises(BadInput, match="none .*encloses"):
        closed(inside_out, UP)


def test_small_bodies_go_and_the_largest_stay():
    """By triangles as in cleaning, but that which encloses most stays, were it a box."""
    box = as_mesh(trimesh.creation.box((3, 3, 3)))
    balls = [as_mesh(trimesh.creation.icosphere(divisions)) for divisions in (3, 3, 2, 1, 1)]
    apart_by = [Mesh(0.3 * each.vertices + np.float32([4 * at + 4, 0, 0]), each.faces) for at, each in enumerate(balls)]
    whole = joined(box, *apart_by)
    cases = {(None, 1): 6, (None, 81): 4, (None, 321): 3, (2, 1): 3, (1, 1): 3, (50, 10_000): 3, (3, 1): 4}
    for (most, least), bodies in cases.items():
        mesh, done = closed(whole, UP, most, least)
        found = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert (done.bodies, done.dropped, done.dropped_triangles) == (
            bodies,
            6 - bodies,
            len(whole.faces) - len(mesh.faces),
        )
        assert done.bodies == found.body_count and done.volume == pytest.approx(found.volume, rel=1e-4)
        assert found.volume > 27


def test_triangles_that_are_turned_are_closed_too(tmp_path, rng=np.random.default_rng(1)):
    """Where neighbours pass an edge the same way, there is an open edge for each; and what is random may be crowded."""
    ball = as_mesh(trimesh.creation.icosphere(2))
    faces = ball.faces.copy()
    faces[40:44] = faces[40:44, ::-1]
    mesh, _ = closed(Mesh(ball.vertices, faces), UP)
    assert is_solid(read(mesh, tmp_path))
    soup = rng.permuted(np.tile(np.arange(30, dtype=np.int32), (80, 1)), axis=1)[:, :3]
    crowded = Mesh(rng.normal(size=(30, 3)).astype(np.float32), np.ascontiguousarray(soup))
    one_way = separated(crowded).faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(one_way, axis=0)) == len(one_way), "no edge is passed twice the same way"
    assert is_solid(read(closed(crowded, UP)[0], tmp_path))


def test_a_large_hole_is_spanned_from_its_rim():
    """124 edges in a plane that is not level: what spans them lies in it, and reaches over all of it, once."""
    gone = {(i, j) for i in range(4, 36) for j in range(4, 34)}
    bare = ground(40, gone)
    bare.vertices[:, 2] = 0.3 * bare.vertices[:, 0]
    mesh, done = closed(bare, UP)
    found = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert is_solid(found) and (done.holes, done.largest_hole) == (1, 124)
    top = found.face_normals[:, 2] > 0.5
    assert found.area_faces[top].sum() == pytest.approx(4 * np.hypot(1, 0.3), rel=1e-4)
    middle = found.triangles_center[top]
    assert np.abs(middle[:, 2] - 0.3 * middle[:, 0]).max() < 1e-5


def test_what_is_added_was_seen_by_no_view():
    bare = ground(gone={(5, 5)})
    count = len(bare.vertices)
    values = {"views": np.full(count, 7, np.float32), "error": np.full(count, 0.1, np.float32)}
    mesh, _ = closed(Mesh(bare.vertices, bare.faces, np.full((count, 3), 90, np.uint8), {}, values), UP)
    low = mesh.vertices[:, 2] < -0.11
    assert low.any() and (mesh.values["views"][low] == 0).all() and np.isnan(mesh.values["error"][low]).all()
    assert (mesh.values["views"][~low] == 7).all() and (mesh.colors == 90).all()


def test_closed_meshes_are_told_from_others():
    ball = as_mesh(trimesh.creation.icosphere(1))
    assert open_or_crowded(ball) == 0
    assert open_or_crowded(Mesh(ball.vertices, ball.faces[1:])) == 3
    turned = ball.faces.copy()
    turned[0] = turned[0, ::-1]
    assert open_or_crowded(Mesh(ball.vertices, turned)) == 3
    assert open_or_crowded(joined(ball, ball)) == 120, "one in the other's place"
