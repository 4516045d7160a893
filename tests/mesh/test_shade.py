"""Pictures of meshes show what a ray would meet."""

import numpy as np
import pytest
from needs import needs, needs_native

from surfkit.mesh import shade
from surfkit.mesh.base import Mesh
from surfkit.mesh.shade import draw_faces, draw_in_numpy, from_above, shaded, up_of

from .shapes import around, look_at, seen, sphere

trimesh = needs("trimesh")


def triangles(count=300, seed=0):
    draw = np.random.default_rng(seed)
    middles = draw.uniform([-10, -10, 1], [110, 80, 9], (count, 1, 3))
    corners = middles + draw.normal(size=(count, 3, 3)) * [12, 12, 0.5] * draw.uniform(0, 1, (count, 1, 1))
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


@needs_native
@pytest.mark.parametrize("count", [300, 70_000])  # the second takes more than one piece of work
def test_compiled_and_numpy_agree(count):
    vertices, faces = triangles(count)
    vertices[5, 2] = -1
    vertices[9, 0] = np.nan
    depth, face = draw_faces(vertices, faces, 100, 70)
    plain = np.full((70, 100), np.inf, np.float32), np.full((70, 100), -1, np.int32)
    draw_in_numpy(vertices, faces, *plain)
    assert np.array_equal(depth, plain[0]) and np.array_equal(face, plain[1])
    assert (face >= 0).mean() > 0.5 and not {1, 3} & set(face.ravel().tolist())


@needs_native
@pytest.mark.parametrize("far", [1e4, 3e9, 1e12, 1e30])
def test_a_corner_hardly_in_front_of_the_camera_takes_nothing_away(far):
    """It falls far out of the picture, beyond what an int holds; the triangle still covers what it covers."""
    vertices = np.array([[-1, -1, 2], [far, -1, 1e-3], [-1, far, 1e-3]], np.float32)
    turned = np.array([[101, 71, 2], [-far, 71, 1e-3], [101, -far, 1e-3]], np.float32)
    for corners in (vertices, turned):
        depth, face = draw_faces(corners, np.array([[0, 1, 2]]), 100, 70)
        plain = np.full((70, 100), np.inf, np.float32), np.full((70, 100), -1, np.int32)
        draw_in_numpy(corners, np.array([[0, 1, 2]]), *plain)
        assert (face == 0).all() and np.array_equal(face, plain[1]) and np.array_equal(depth, plain[0])


@needs_native
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_a_corner_that_is_nowhere_draws_nothing(wrong):
    corners = np.array([[-1, -1, 2], [200, -1, 2], [-1, wrong, 2]], np.float32)
    assert (draw_faces(corners, np.array([[0, 1, 2]]), 100, 70)[1] == -1).all()


def test_depth_is_that_of_the_solid():
    camera = look_at((1.2, -1.0, 0.8))
    solid = trimesh.creation.icosphere(5, radius=0.5)
    pose = camera.world_to_camera.numpy()
    local = solid.vertices @ pose[:3, :3].T + pose[:3, 3]
    places = np.stack([local[:, 0] / local[:, 2] * 90 + camera.cx, local[:, 1] / local[:, 2] * 90 + camera.cy], 1)
    depth, face = draw_faces(np.concatenate([places, local[:, 2:]], 1), solid.faces, 96, 72)
    truth, _ = seen(camera, sphere)
    both = (truth > 0) & (face >= 0)
    assert ((truth > 0) != (face >= 0)).mean() < 0.01 and np.abs(depth[both] - truth[both]).max() < 0.02
    assert np.abs(depth[both] - truth[both]).mean() < 0.002


def test_a_ball_is_grey_where_it_is_seen_from_outside_and_blue_from_inside():
    solid = trimesh.creation.icosphere(3, radius=0.5)
    camera = look_at((1.5, 0.3, 0.2))
    for faces, blue in ((solid.faces, False), (solid.faces[:, ::-1], True)):
        mesh = Mesh(solid.vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32))
        for image in (shaded(mesh, camera), from_above(mesh, np.array([0, 0, 1.0]), 60)):
            there = (image < 1).any(0)
            assert 0.1 < there.float().mean() < 0.85
            assert bool((image[2] > image[0] + 0.05)[there].float().mean() > 0.9) == blue
    assert from_above(mesh, np.array([0, 0, 1.0]), 60).shape == (3, 60, 60)


def test_large_meshes_are_judged_by_some_of_their_triangles(monkeypatch):
    """A slope of many triangles: the way it faces, and how far it reaches."""
    rows, columns = (part.ravel() for part in np.mgrid[:40, :60])
    vertices = np.stack([columns, rows, 0.5 * columns], 1).astype(np.float32)
    first = (rows * 60 + columns)[(rows < 39) & (columns < 59)]
    faces = (
        np.stack([first, first + 1, first + 60, first + 1, first + 61, first + 60], 1).reshape(-1, 3).astype(np.int32)
    )
    slope, upright = Mesh(vertices, faces), np.array([-0.5, 0, 1]) / 1.25**0.5
    whole = up_of(slope, ()), from_above(slope, upright, 80)
    monkeypatch.setattr(shade, "SAMPLED_ELEMENTS", 350)
    some = up_of(slope, ()), from_above(slope, upright, 80)
    for up, picture in (whole, some):
        np.testing.assert_allclose(up, upright, atol=1e-6)
        assert abs(picture.shape[1] - whole[1].shape[1]) <= 2 and (picture < 1).float().mean() > 0.9


def test_from_above_is_not_mirrored():
    """A flat letter L: seen from above, its foot points to the same side of its stem as on the ground."""
    quad = np.array([[0, 0], [1, 0], [1, 4], [0, 4], [1, 0], [3, 0], [3, 1], [1, 1]])
    vertices = np.concatenate([quad, np.zeros((8, 1))], 1).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    image = (from_above(Mesh(vertices, faces), np.array([0, 0, 1.0]), 40) < 1).any(0).numpy()
    ground = np.zeros((4, 3), bool)
    ground[:, 0] = ground[3, :] = True  # rows are from the far end of y down
    small = image[5::10, 5::10][:4, :3] if image.shape[0] > image.shape[1] else image[5::10, 5::10][:3, :4]
    turns = [np.rot90(ground, k) for k in range(4)]
    assert any(turn.shape == small.shape and np.array_equal(turn, small) for turn in turns)


def test_up_is_where_the_ground_faces():
    draw = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    rough = np.stack([x, y, draw.normal(size=x.shape)], 2).reshape(-1, 3)
    at = np.arange(400).reshape(20, 20)
    a, b, c, d = (p.ravel() for p in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    tilt = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    tilt *= np.sign(np.linalg.det(tilt))
    ground = Mesh((rough @ tilt.T).astype(np.float32), faces)
    assert up_of(ground, around(3)) @ tilt[:, 2] > 0.98
    solid = trimesh.creation.icosphere(2)
    ball = Mesh(np.asarray(solid.vertices, np.float32), np.asarray(solid.faces, np.int32))
    ring = [look_at((2 * np.cos(t), 2 * np.sin(t), 0.3)) for t in range(6)]
    assert up_of(ball, ring) @ [0, 0, 1] > 0.99
