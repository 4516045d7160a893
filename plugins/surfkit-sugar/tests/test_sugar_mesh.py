"""Level-set points against closed forms, and the mesh of a ball."""

import math
from dataclasses import replace

import numpy as np
import pytest
import surfkit_sugar
import torch
from surfkit_sugar import LevelSetPoisson
from surfkit_sugar.density import Ellipsoids, density, gathered
from surfkit_sugar.mesh import Search
from torch.nn.functional import normalize

from surfkit.core.registry import plugins
from surfkit.mesh.poisson import require_open3d
from surfkit.plugin import BadInput, Mesher, Splats, components
from surfkit.testing import check
from surfkit.testing.inputs import BALL_RADIUS, mesh_input, splats


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = LevelSetPoisson in components(Mesher).values()
    if not there:
        plugins().register(surfkit_sugar, "sugar of this test")
    yield
    if not there:
        plugins().unregister(surfkit_sugar)


@pytest.fixture
def open3d():
    """Skips where Open3D cannot be loaded."""
    try:
        return require_open3d("this test")
    except BadInput as error:
        pytest.skip(str(error))


def alone(opacity: float, scales: tuple[float, float, float]) -> Splats:
    """One Gaussian in float64, its axes those of the world, and another far away."""
    quats = torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64)
    means = torch.tensor([[0.1, -0.2, 1.0], [50.0, 50.0, 50.0]], dtype=torch.float64)
    sizes = torch.tensor([scales] * 2, dtype=torch.float64)
    return Splats("gaussian", means, quats, sizes, torch.full((2,), opacity).double(), torch.zeros(2, 1, 3).double())


def search(given: Splats, **settings) -> Search:
    return Search(replace(LevelSetPoisson(), **settings), Ellipsoids.of(given))


def test_densities_along_rays_are_those_in_space():
    given = splats("gaussian", 20)
    given = given.with_named({name: value.double() for name, value in given.named().items()})
    draw = torch.Generator().manual_seed(1)
    places = torch.rand(15, 3, generator=draw, dtype=torch.float64)
    rays = normalize(torch.randn(15, 3, generator=draw, dtype=torch.float64), dim=1)
    steps = torch.linspace(-0.2, 0.2, 9, dtype=torch.float64).expand(15, 9)
    field, rows = search(given), torch.arange(20).expand(15, -1)
    near = gathered(field.solid.table(), rows)
    found = field.along(near, places, rays, steps)
    for k in range(9):
        assert torch.allclose(found[:, k], density(near, places + steps[:, k, None] * rays)[0], rtol=1e-10, atol=0)


def test_the_first_crossing_of_one_gaussian_is_where_the_logarithm_says():
    """o exp(-t^2 / 2 s^2) = level at t = -s sqrt(2 ln(o / level)), seen along x, where s = 0.05."""
    given = alone(0.9, (0.05, 0.2, 0.1))
    offsets = torch.tensor([0.0, 0.03, -0.04], dtype=torch.float64)
    places = given.means[:1] + torch.tensor([1.0, 0.0, 0.0]) * offsets[:, None]
    rays = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(3, 3)
    points, normals, met = search(given, samples=2_001).crossings(places, rays)
    assert met.all()
    wanted = 0.1 - 0.05 * math.sqrt(2 * math.log(0.9 / 0.3))
    assert torch.allclose(points[:, 0], torch.full((3,), wanted).double(), atol=1e-7)
    assert torch.allclose(normals, torch.tensor([[-1.0, 0, 0]]).double().expand(3, 3)), "towards the camera"
    coarse = search(given).crossings(places, rays)[0][:, 0]
    assert (coarse - wanted).abs().max() < 0.1 * 0.05, "21 places and a straight line between two are good to a tenth"


def test_normals_are_those_of_the_ellipsoid():
    given = alone(0.9, (0.05, 0.2, 0.1))
    places = given.means[:1] + torch.tensor([[0.02, 0.1, -0.03]]).double()
    ray = normalize(torch.tensor([[1.0, 0.3, 0.2]]).double(), dim=1)
    points, normals, met = search(given, samples=501).crossings(places, ray)
    assert met.all()
    slope = (points - given.means[:1]) / given.scales[:1] ** 2
    assert torch.allclose(normals, normalize(slope, dim=1), atol=1e-9)


@pytest.mark.parametrize("change", [{"opacity": 0.2}, {"behind": 0.4}, {"before": 0.4}])
def test_rays_that_do_not_enter_the_level_give_no_point(change):
    given = alone(change.get("opacity", 0.9), (0.05, 0.2, 0.1))
    places = given.means[:1] + torch.tensor([[change.get("behind", 0.0) - change.get("before", 0.0), 0.0, 0.0]])
    points, normals, met = search(given).crossings(places, torch.tensor([[1.0, 0, 0]]).double())
    assert not met.any() and len(points) == len(normals) == 0


def test_the_second_layer_is_not_found_behind_the_first():
    given = alone(0.9, (0.05, 0.2, 0.1))
    given = replace(given, means=given.means[:1] + torch.tensor([[0.0, 0, 0], [0.4, 0, 0]]))
    places = given.means[:1] + torch.tensor([[0.2, 0.0, 0.0]])
    points, _, met = search(given, reach=6.0, samples=301).crossings(places, torch.tensor([[1.0, 0, 0]]).double())
    assert met.all() and float(points[0, 0]) < 0.1, "before the centre of the first"


@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
def test_a_ball(open3d, kind):
    mesh = LevelSetPoisson(octree=6, points=20_000, thin=0.0).mesh(mesh_input(kind))
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - BALL_RADIUS).mean() < 0.01 and np.abs(radius - BALL_RADIUS).max() < 0.05
    assert mesh.facts["level_set_points"] > 0.5 * mesh.facts["pixels"]
    fewer = LevelSetPoisson(octree=6, points=20_000, thin=0.0, triangles=1_000).mesh(mesh_input(kind))
    assert 500 < len(fewer.faces) <= 1_000 and fewer.facts["triangles_before"] == len(mesh.faces)


def test_the_mesher_keeps_to_the_contract(open3d):
    check(LevelSetPoisson(octree=6, points=8_000))


def test_splats_too_faint_for_the_level_are_refused(open3d):
    with pytest.raises(BadInput, match=r"crosses 0\.999 .*pixels"):
        LevelSetPoisson(level=0.999, points=2_000).mesh(faint())


def faint():
    given = mesh_input("gaussian")
    return replace(given, splats=replace(given.splats, opacities=torch.full((len(given.splats),), 0.3)))


def test_without_open3d_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    with pytest.raises(BadInput, match="mesh:sugar needs .*open3d"):
        LevelSetPoisson().ready()


@pytest.mark.parametrize(
    "setting", [{"octree": 2}, {"level": 1.0}, {"samples": 1}, {"reach": 0.0}, {"neighbours": 0}, {"points": 10},
                {"thin": 1.0}, {"triangles": -1}]
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        LevelSetPoisson(**setting)
