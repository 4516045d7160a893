"""Marching tetrahedra on balls of surfels and ellipsoids, whose surface is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.mesh.delaunay import crossing, split
from surfkit.mesh.field import least_opacity
from surfkit.mesh.tetra import Tetra, triangles, used
from surfkit.raster.rays import ray_opacity_reference
from surfkit.testing.inputs import BALL_RADIUS, mesh_input


def edges_of(faces):
    return np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)


def is_closed(faces) -> bool:
    """Every edge has two faces, which run through it in opposite directions."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    back = {tuple(edge) for edge in directed[:, ::-1]}
    return len({tuple(edge) for edge in directed}) == len(directed) and all(tuple(edge) in back for edge in directed)


def volume(vertices, faces) -> float:
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("kind", ["surfel", "gaussian"])
def test_a_ball_becomes_a_closed_ball(kind):
    mesh = Tetra(longest=0, agree=0).mesh(mesh_input(kind))
    assert is_closed(mesh.faces)
    assert len(mesh.vertices) - len(edges_of(mesh.faces)) // 2 + len(mesh.faces) == 2
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - BALL_RADIUS).max() < 0.02 and np.abs(radius - BALL_RADIUS).mean() < 0.005
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(4 / 3 * np.pi * BALL_RADIUS**3, rel=0.05)
    assert (np.abs(mesh.colors.astype(int) - [255, 0, 0]).max(1) < 70).mean() > 0.9


def test_more_bisections_come_closer():
    given = mesh_input(views=30)
    error = [
        np.abs(np.linalg.norm(Tetra(longest=0, bisections=n).mesh(given).vertices, axis=1) - BALL_RADIUS).mean()
        for n in (0, 8)
    ]
    assert error[1] < 0.3 * error[0]


def test_tiles_give_the_same_surface():
    """With a budget of 2,000 points a tile, against all in one."""
    given = mesh_input(views=8)
    whole, tiled = Tetra().mesh(given), Tetra().mesh(replace(given, generator=torch.Generator(), budget_bytes=1))
    assert len(whole.faces) > 1_000 and len(given.splats) * 9 > 2 * 2_000
    corners = [{tuple(sorted(map(tuple, m.vertices[face]))) for face in m.faces} for m in (whole, tiled)]
    assert corners[0] == corners[1]


def test_every_case_of_a_tetrahedron():
    """Random tetrahedra of either orientation, cut by a plane: the corners lie on it, and the faces look outwards."""
    draws = np.random.default_rng(0)
    for _ in range(200):
        points, normal = draws.normal(size=(4, 3)), draws.normal(size=3)
        inside = points @ normal < 0
        edges, faces = triangles(np.array([[0, 1, 2, 3]]), inside, points)
        if inside.all() or not inside.any():
            assert not len(faces)
            continue
        assert inside[edges[:, 0]].all() and not inside[edges[:, 1]].any()
        assert len(edges) == inside.sum() * (~inside).sum() and len(faces) == len(edges) - 2
        height = points @ normal
        share = (height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]]))[:, None]
        corners = points[edges[:, 0]] * (1 - share) + points[edges[:, 1]] * share
        a, b, c = (corners[faces[:, k]] for k in range(3))
        assert (np.cross(b - a, c - a) @ normal > 0).all()


def test_tiles_hold_every_point_once():
    points = np.random.default_rng(1).normal(size=(5_000, 3)) * [5, 1, 1]
    boxes = split(points, 600)
    owners = sum(((points >= low) & (points < high)).all(1).astype(int) for low, high in boxes)
    assert (owners == 1).all() and len(boxes) >= 9


def test_what_no_view_shows_has_no_surface():
    """One camera: what the ball hides from it is the inside of something, and no triangle reaches into it."""
    given = mesh_input()
    one, direction = given.views[:1], given.views[0].camera.centre.numpy() / 2
    mesh = Tetra(min_views=1).mesh(replace(given, views=one))
    assert len(mesh.faces) > 200
    assert (mesh.vertices @ direction).min() > -0.1 and (Tetra().mesh(given).vertices @ direction).min() < -0.48
    with pytest.raises(BadInput, match="no surface"):
        Tetra(min_views=2).mesh(replace(given, views=one))


def test_masked_pixels_show_nothing():
    given = mesh_input()
    left = torch.zeros(96, 96, dtype=torch.bool)
    with pytest.raises(BadInput, match="no surface"):
        Tetra().mesh(replace(given, keep=lambda at: left))


def test_faint_splats_give_no_points():
    given = mesh_input()
    with pytest.raises(BadInput, match="opacity"):
        Tetra(faint=0.99).mesh(given)


@pytest.mark.parametrize(
    "settings", [{"level": 1.0}, {"reach": 0.0}, {"min_views": 0}, {"agree": 1.0}, {"bisections": -1}]
)
def test_bad_settings(settings):
    with pytest.raises(BadInput, match="tetra"):
        Tetra(**settings)


def test_unused_vertices_go():
    vertices, faces = used(np.arange(15.0).reshape(5, 3), np.array([[4, 0, 2]]))
    assert vertices[:, 0].tolist() == [0, 6, 12] and faces.tolist() == [[2, 0, 1]]


def test_points_in_a_plane_enclose_nothing():
    points = np.random.default_rng(2).normal(size=(50, 3)) * [1, 1, 0]
    tets, doubtful = crossing(points, np.ones(50, bool), np.arange(50) % 2 == 0, 1 << 30)
    assert tets.shape == (0, 4) and doubtful == 0


@pytest.mark.parametrize("enough", [None, 0.5])
def test_the_least_opacity_is_that_of_the_view_that_sees_a_place_best(enough):
    given = mesh_input("gaussian", count=600, views=10)
    points = 1.4 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.7
    masked = torch.ones(given.views[0].camera.height, given.views[0].camera.width, dtype=torch.bool)
    masked[:, : masked.shape[1] // 2] = False
    given = replace(given, keep=lambda at: masked if at == 0 else None)
    exact = given.splats.with_named({name: value.double() for name, value in given.splats.named().items()})
    each = torch.stack([ray_opacity_reference(exact, v.camera, given.near, points).float() for v in given.views])
    places = given.views[0].camera.project(points)
    each[0][places[:, 0] < masked.shape[1] / 2 - 0.5] = torch.nan
    sure = (places[:, 0] - masked.shape[1] / 2).abs() > 0.6  # the mask is looked up between its pixels
    least, views = least_opacity(given, points, "looking", enough)
    truth = each.nan_to_num(nan=1.0).amin(0)
    assert 50 < int((truth < 0.5).sum()) < 450
    if enough is None:
        assert torch.allclose(least[sure], truth[sure], atol=1e-3)
        assert torch.equal(views[sure], (~each.isnan()).sum(0, dtype=torch.int32)[sure])
    else:
        assert torch.equal((least > enough)[sure], (truth > enough)[sure]) and (least >= truth - 1e-3)[sure].all()
        assert int(views.sum()) < 0.8 * int((~each.isnan()).sum()), "most of the work is saved"
