"""Fewer triangles: the surface stays where it is and what it is, by trimesh and by analytic shapes."""

import numpy as np
import pytest
from needs import needs

from surfkit.core.check import BadInput
from surfkit.mesh.base import Mesh
from surfkit.mesh.simplify import simplified, simplify_to

trimesh = needs("trimesh")


def as_mesh(found, **more):
    return Mesh(np.asarray(found.vertices, np.float32), np.asarray(found.faces, np.int32), **more)


def crowded(mesh):
    """How many edges have more than two triangles."""
    sides = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    return int((np.unique(sides, axis=0, return_counts=True)[1] > 2).sum())


def relief(side=60, noise=0.0, seed=0):
    """Ground of height sin x sin y over a square of `side` steps of 0.1, with a rim that is straight."""
    x, y = np.meshgrid(*2 * [np.arange(side + 1) * 0.1], indexing="ij")
    z = 0.5 * np.sin(x) * np.sin(y) + noise * np.random.default_rng(seed).normal(size=x.shape)
    at = np.arange((side + 1) ** 2).reshape(side + 1, -1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Mesh(np.stack([x, y, z], 2).reshape(-1, 3).astype(np.float32), faces.astype(np.int32))


@pytest.mark.parametrize("error", [0.003, 0.01, 0.03])
def test_a_sphere_stays_within_the_error_that_is_allowed(error):
    ball = as_mesh(trimesh.creation.icosphere(5))
    small = simplified(ball, error=error)
    solid = trimesh.Trimesh(small.vertices, small.faces, process=False)
    off = np.abs(np.linalg.norm(solid.sample(20_000, seed=0), axis=1) - 1)
    assert np.quantile(off, 0.99) < error and off.max() < 3 * error
    assert off.max() > error / 10, "fewer triangles would do"
    assert len(small.faces) < len(ball.faces) / 4 and solid.is_watertight and solid.is_winding_consistent


def test_what_is_flat_becomes_few_triangles_and_edges_stay_sharp():
    box = as_mesh(trimesh.creation.box().subdivide_loop(0).subdivide().subdivide().subdivide().subdivide())
    small = simplified(box, error=1e-4)
    solid = trimesh.Trimesh(small.vertices, small.faces, process=False)
    assert len(box.faces) == 3072 and len(small.faces) < 200
    assert solid.is_watertight and (solid.volume, solid.area) == pytest.approx((1, 6), abs=1e-3)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_open_ground_keeps_its_rim(noise):
    """Its outline from above is a square of 6 by 6, however few triangles there are."""
    ground = relief(noise=noise)
    small = simplified(ground, most=len(ground.faces) // 20)
    assert len(small.faces) <= len(ground.faces) // 20 and not crowded(small)
    solid = trimesh.Trimesh(small.vertices, small.faces, process=False)
    assert np.allclose(solid.bounds[:, :2], [[0, 0], [6, 6]], atol=0.02)
    below = solid.area_faces * np.abs(solid.face_normals[:, 2])
    assert below.sum() == pytest.approx(36, rel=2e-3 + 0.3 * noise)
    assert (solid.face_normals[:, 2] > 0).all(), "none is turned over"
    height = 0.5 * np.sin(small.vertices[:, 0]) * np.sin(small.vertices[:, 1])
    assert np.abs(small.vertices[:, 2] - height).max() < 0.03 + 4 * noise


def test_the_surface_stays_what_it_is():
    """A ring with a hole through it, and two parts that touch at a vertex; to the fewest triangles there are."""
    ring = as_mesh(trimesh.creation.torus(1.0, 0.3))
    small = simplified(ring, most=1)
    solid = trimesh.Trimesh(small.vertices, small.faces, process=False)
    assert solid.is_watertight and solid.euler_number == 0 and 14 <= len(small.faces) < 100
    ball = as_mesh(trimesh.creation.icosphere(3))
    small = simplified(ball, most=1)
    assert len(small.faces) == 4 and trimesh.Trimesh(small.vertices, small.faces, process=False).is_watertight
    other = ball.faces + len(ball.vertices)
    top, low = int(ball.vertices[:, 2].argmax()), int(ball.vertices[:, 2].argmin())
    other[other == len(ball.vertices) + low] = top
    places = np.concatenate([ball.vertices, ball.vertices + np.float32([0, 0, 2])])
    both = Mesh(places, np.concatenate([ball.faces, other]))
    small = simplified(both, most=60)
    assert len(small.faces) == 60 and not crowded(small)
    assert trimesh.Trimesh(small.vertices, small.faces, process=False).volume > 4


def test_no_edge_gets_a_third_triangle_in_random_soup():
    rng = np.random.default_rng(3)
    for _ in range(20):
        faces = rng.permuted(np.tile(np.arange(40, dtype=np.int32), (60, 1)), axis=1)[:, :3]
        soup = Mesh(rng.normal(size=(40, 3)).astype(np.float32), np.ascontiguousarray(faces))
        assert crowded(simplified(soup, most=1)) <= crowded(soup)


def test_colours_and_values_are_means_of_what_a_vertex_stands_for():
    """Linear along x they stay so nearly, and their sums over all vertices show that each counts once."""
    ground = relief()
    x = ground.vertices[:, 0]
    colors = np.stack([40 * x, 0 * x, 255 + 0 * x], 1).astype(np.uint8)
    error = x.copy()
    error[::3] = np.nan  # not known
    ground = Mesh(ground.vertices, ground.faces, colors, {"a": 1}, {"views": x.copy(), "error": error})
    small = simplified(ground, error=0.005)
    assert small.facts == {"a": 1} and len(small.faces) < len(ground.faces) / 2
    assert np.abs(small.values["views"] - small.vertices[:, 0]).max() < 0.6
    assert np.abs(small.colors[:, 0] - 40.0 * small.vertices[:, 0]).max() < 25 and (small.colors[:, 2] == 255).all()
    assert small.values["views"].dtype == np.float32 and small.values["error"].shape == (len(small.vertices),)
    assert np.isfinite(small.values["error"]).sum() > 0.9 * len(small.vertices)
    again = simplified(ground, error=0.005)
    assert again.vertices.tobytes() == small.vertices.tobytes() and np.array_equal(again.faces, small.faces)


def test_where_there_is_nothing_to_do():
    ball = as_mesh(trimesh.creation.icosphere(1))
    assert simplified(ball) is ball and simplified(ball, most=80) is ball
    alone = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    assert np.array_equal(simplified(alone, most=1, error=9.0).vertices, alone.vertices)


def test_without_kernels_it_is_refused(monkeypatch):
    monkeypatch.setattr("surfkit.mesh.simplify.module", lambda: None)
    with pytest.raises(BadInput, match="needs the compiled kernels"):
        simplified(relief(), most=10)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e6])
def test_the_unit_of_lengths_does_not_matter(unit):
    """It does to fast-simplification, whose limits are lengths: see findings/fast_simplification_units.sh."""
    needs("fast_simplification")
    ball = as_mesh(trimesh.creation.icosphere(4))
    large = Mesh(ball.vertices * np.float32(unit), ball.faces)
    for less in (simplify_to(large, 500), simplified(large, 500)):
        assert 480 <= len(less.faces) <= 500
        assert np.abs(np.linalg.norm(less.vertices / unit, axis=1) - 1).max() < 0.03
