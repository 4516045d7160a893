"""Marching tetrahedra on balls of surfels and ellipsoids, whose surface is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs

from surfkit.core.check import BadInput
from surfkit.core.registry import components
from surfkit.mesh.base import Mesher, MeshInput
from surfkit.mesh.delaunay import crossing, split
from surfkit.mesh.tetra import Tetra, triangles, used
from surfkit.raster.api import Splats
from surfkit.raster.select import select
from surfkit.readers.depth_prior import DepthPrior
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View
from surfkit.testing import check_mesher

RADIUS = 0.5


def spread(count: int) -> torch.Tensor:
    """(count, 3) unit vectors, evenly."""
    at = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * at + 1) / count
    turn = at * np.pi * (3 - 5**0.5)
    side = (1 - z * z).sqrt()
    return torch.stack([side * turn.cos(), side * turn.sin(), z], 1)


def towards(centre: torch.Tensor, size: int = 96) -> Camera:
    """A camera that looks at the origin."""
    z = -centre / centre.norm()
    x = torch.linalg.cross(torch.tensor([0.31, 0.95, 0.05]).double(), z)
    x = x / x.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return Camera(pose, 1.2 * size, 1.2 * size, size / 2, size / 2, size, size)


def facing(normals: torch.Tensor) -> torch.Tensor:
    """(N, 4) quaternions that turn the z axis to unit vectors."""
    w = 1 + normals[:, 2]
    return torch.stack([w, -normals[:, 1], normals[:, 0], torch.zeros_like(w)], 1)


def ball(kind: str = "surfel", count: int = 900, views: int = 14, **changes) -> MeshInput:
    """Splats on a ball, opaque and red, and cameras all around it."""
    normals = spread(count)
    scales = torch.full((count, 2 if kind == "surfel" else 3), 0.03)
    if kind == "gaussian":
        scales[:, 2] = 0.002
    sh = torch.tensor([1.0, -1.0, -1.0]).expand(count, 1, 3).contiguous() / 0.2821 / 2
    splats = Splats(kind, (RADIUS * normals).float(), facing(normals).float(), scales, torch.full((count,), 0.95), sh)
    rasterizer, _ = select("cpu")
    seen = tuple(View(f"{i}", towards(2.0 * at), path=None) for i, at in enumerate(spread(views)))

    def draw(view):
        return rasterizer.render(splats, view.camera, 0.01, True, False).maps

    given = MeshInput(splats, seen, draw, rasterizer, 0.01, Frame(np.zeros(3), 1.0), 1 << 30)
    return replace(given, **changes)


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
    mesh = Tetra(longest=0, agree=0).mesh(ball(kind))
    assert is_closed(mesh.faces)
    assert len(mesh.vertices) - len(edges_of(mesh.faces)) // 2 + len(mesh.faces) == 2
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - RADIUS).max() < 0.02 and np.abs(radius - RADIUS).mean() < 0.005
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.05)
    assert (np.abs(mesh.colors.astype(int) - [255, 0, 0]).max(1) < 70).mean() > 0.9


def test_more_bisections_come_closer():
    given = ball(views=30)
    error = [
        np.abs(np.linalg.norm(Tetra(longest=0, bisections=n).mesh(given).vertices, axis=1) - RADIUS).mean()
        for n in (0, 8)
    ]
    assert error[1] < 0.3 * error[0]


def test_tiles_give_the_same_surface():
    """With a budget of 2,000 points a tile, against all in one."""
    given = ball(views=8)
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
    given = ball()
    one, direction = given.views[:1], given.views[0].camera.centre.numpy() / 2
    mesh = Tetra(min_views=1).mesh(replace(given, views=one))
    assert len(mesh.faces) > 200
    assert (mesh.vertices @ direction).min() > -0.1 and (Tetra().mesh(given).vertices @ direction).min() < -0.48
    with pytest.raises(BadInput, match="no surface"):
        Tetra(min_views=2).mesh(replace(given, views=one))


def test_masked_pixels_show_nothing():
    given = ball()
    left = torch.zeros(96, 96, dtype=torch.bool)
    with pytest.raises(BadInput, match="no surface"):
        Tetra().mesh(replace(given, keep=lambda at: left))


def test_faint_splats_give_no_points():
    given = ball()
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


@pytest.mark.parametrize("name", components(Mesher))
def test_every_mesher_keeps_the_contract(name):
    mesher = components(Mesher)[name]()
    if name == "poisson":
        needs("open3d", "mesh:poisson")
        mesher = replace(mesher, octree=5, points=5_000)
    check_mesher(mesher, with_priors(ball()) if mesher.needs_prior else ball())


def with_priors(given: MeshInput) -> MeshInput:
    """Priors that say what the splats do."""
    maps = [given.draw(view) for view in given.views]
    inverses = [torch.where(m.median > 0, 1 / m.median.clamp_min(1e-9), 0.0) for m in maps]
    priors = [DepthPrior(i, (i > 0).float(), 1.0, m.normal) for i, m in zip(inverses, maps, strict=True)]
    return replace(given, priors=priors)
