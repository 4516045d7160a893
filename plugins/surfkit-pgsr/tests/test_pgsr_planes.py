"""The depth of planes against rays and planes, and its gradients against finite differences in float64."""

from dataclasses import replace

import pytest
import surfkit_pgsr
import torch
from surfkit_pgsr.mesh import MaxAngleTSDF, within
from surfkit_pgsr.planes import PlanarGaussian, PlaneRender, plane_depth, plane_distances

from surfkit.core.registry import plugins
from surfkit.plugin import Camera, Maps, Mesher, Primitive, Splats, components
from surfkit.primitives.init import facing
from surfkit.raster.reference import Reference
from surfkit.raster.select import select
from surfkit.testing import check

NORMAL = torch.tensor([0.3, -0.2, -1.0]).double() / 1.13**0.5
OFFSET = -1.2
"""The plane NORMAL . point = OFFSET, seen from about the origin along z."""
NEAR = 0.01


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = PlanarGaussian in components(Primitive).values()
    if not there:
        plugins().register(surfkit_pgsr, "pgsr of this test")
    yield
    if not there:
        plugins().unregister(surfkit_pgsr)


def camera(width=48, height=36, focal=50.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = 0.995
    pose[0, 2], pose[2, 0] = (1 - 0.995**2) ** 0.5, -((1 - 0.995**2) ** 0.5)
    pose[:3, 3] = torch.tensor([0.03, -0.02, 0.05])
    return Camera(pose, focal, 1.1 * focal, width / 2 + 1.5, height / 2 - 1, width, height)


def exact(eye: Camera) -> torch.Tensor:
    """(H, W) float64 depth of the plane."""
    ways = torch.einsum("dc,dhw->chw", eye.world_to_camera[:3, :3], eye.rays(torch.float64))
    return (OFFSET - NORMAL @ eye.centre) / torch.einsum("c,chw->hw", NORMAL, ways)


def on_plane(count=500, scale=0.05) -> Splats:
    """Thin, opaque discs that lie in the plane, large enough to cover it."""
    draw = torch.Generator().manual_seed(1)
    x, y = (torch.rand(count, generator=draw).double() * 2.4 - 1.2 for _ in range(2))
    z = (OFFSET - NORMAL[0] * x - NORMAL[1] * y) / NORMAL[2]
    scales = torch.tensor([3 * scale, 2 * scale, 1e-4]).repeat(count, 1)
    quats = facing(NORMAL.expand(count, 3).float())
    sh = torch.rand(count, 1, 3, generator=draw) - 0.5
    return Splats("gaussian", torch.stack([x, y, z], 1).float(), quats, scales, torch.full((count,), 0.8), sh)


def anyhow(count=6, dtype=torch.float64) -> Splats:
    """A few flat ellipsoids, turned any way, one behind the other."""
    draw = torch.Generator().manual_seed(3)
    means = torch.rand(count, 3, generator=draw) * 0.5 - 0.25
    means[:, 2] += torch.linspace(1.0, 1.6, count)
    scales = torch.tensor([0.15, 0.02, 0.1]) * (0.8 + 0.4 * torch.rand(count, 3, generator=draw))
    quats = torch.randn(count, 4, generator=draw)
    opacities = 0.3 + 0.5 * torch.rand(count, generator=draw)
    sh = torch.rand(count, 4, 3, generator=draw) * 0.4
    return Splats("gaussian", *(t.to(dtype) for t in (means, quats, scales, opacities, sh[:, :1], sh[:, 1:])))


def drawn(splats: Splats, eye: Camera, rasterizer=None) -> PlaneRender:
    return PlanarGaussian().render(splats, eye, rasterizer or select("cpu")[0], NEAR, True, False)


def test_the_depth_of_discs_in_a_plane_is_that_of_the_plane():
    eye = camera()
    maps, truth = drawn(on_plane(), eye).maps, exact(eye)
    seen = maps.alpha > 0.5
    assert seen.double().mean() > 0.95
    for depth in (maps.median, maps.expected_depth()):
        assert ((depth / truth - 1).abs()[seen] < 1e-4).all()
    assert not maps.median[~seen].any()


def test_a_single_disc_has_the_depth_of_its_plane_wherever_it_is_seen():
    eye, one = camera(), on_plane().take(torch.tensor([7]))
    one = replace(
        one, scales=torch.tensor([[0.3, 0.2, 1e-4]]), means=torch.tensor([[0.0, 0.0, float(OFFSET / NORMAL[2])]])
    )
    maps = drawn(one, eye).maps
    seen = maps.alpha > 0.01
    assert seen.sum() > 200 and ((maps.expected_depth() / exact(eye) - 1).abs()[seen] < 1e-3).all()


def test_distances_are_those_of_points_from_planes():
    splats, eye = anyhow(), camera()
    thin = splats.scales.argmin(1)
    w, x, y, z = (splats.quats / splats.quats.norm(dim=1, keepdim=True)).unbind(1)
    columns = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    normal = torch.stack(columns, 1)[torch.arange(6), thin]
    wanted = ((splats.means - eye.centre) * normal).sum(1).abs()
    assert torch.allclose(plane_distances(splats, eye), wanted, atol=1e-12)


def test_the_depth_is_that_of_the_blended_normals_and_distances():
    splats, eye = anyhow(), camera(24, 18, 25.0)
    reference = Reference()
    black = torch.full((6, 1, 3), -0.5 / 0.28209479177387814, dtype=torch.float64)
    weights = []
    for at in range(6):
        sh = black.clone()
        sh[at] *= -1
        weights.append(reference.render(splats.with_colors(sh), eye, NEAR, False).maps.color[0])
    weights = torch.stack(weights)
    render = drawn(splats, eye, reference)
    rays = eye.rays(torch.float64)
    turn = torch.stack([_rotation(q) for q in splats.quats])
    normals = (eye.world_to_camera[:3, :3] @ turn[torch.arange(6), :, splats.scales.argmin(1)].T).T
    centres = splats.means @ eye.world_to_camera[:3, :3].T + eye.world_to_camera[:3, 3]
    normals = torch.where((normals * centres).sum(1, keepdim=True) > 0, -normals, normals)
    blended = torch.einsum("nhw,nc->chw", weights, normals)
    distance = torch.einsum("nhw,n->hw", weights, -(normals * centres).sum(1))
    wanted = distance / -(blended * rays).sum(0)
    seen = render.maps.alpha > 0.05
    cosine = -(blended * rays).sum(0) / (blended.norm(dim=0) * rays.norm(dim=0))
    seen &= cosine > 0.02
    assert seen.sum() > 80 and torch.allclose(render.maps.expected_depth()[seen], wanted[seen], rtol=1e-9)


def _rotation(quat: torch.Tensor) -> torch.Tensor:
    w, x, y, z = (quat / quat.norm()).tolist()
    return torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )


def test_gradients_are_those_of_finite_differences():
    splats, eye, reference = anyhow(), camera(16, 12, 17.0), Reference()
    draw = torch.Generator().manual_seed(0)
    first = drawn(splats, eye, reference)
    steady = (first.maps.alpha > 0.1).double()  # away from rims, where splats are cut off
    names = ("color", "alpha", "depth", "median", "normal")
    cotangents = {
        name: torch.randn(getattr(first.maps, name).shape, generator=draw).double() * steady for name in names
    }

    def loss(given: Splats) -> float:
        found = drawn(given, eye, reference).maps
        return float(sum((cotangents[name] * getattr(found, name)).sum() for name in names))

    gradients = first.backward(Maps(**cotangents)).tensors()
    for name, value in splats.tensors().items():
        for _ in range(2):  # along random directions
            way = torch.randn(value.shape, generator=draw).double()
            up, down = (loss(replace(splats, **{name: value + step * way})) for step in (1e-6, -1e-6))
            slope = (up - down) / 2e-6
            assert abs(slope) > 0.1 and float((gradients[name] * way).sum()) == pytest.approx(slope, rel=2e-3), name


def test_the_native_rasterizer_gives_the_same():
    splats, eye = anyhow(dtype=torch.float32), camera(24, 18, 25.0)
    native, plain = drawn(splats, eye), drawn(anyhow(), eye, Reference())
    seen = plain.maps.alpha > 0.05
    assert torch.allclose(native.maps.median, plain.maps.median.float(), rtol=1e-3, atol=1e-3)
    draw = torch.Generator().manual_seed(0)
    cotangent = Maps(color=torch.zeros(3, 18, 24), median=torch.randn(18, 24, generator=draw) * seen)
    one, two = native.backward(cotangent, cotangent), plain.backward(cotangent, cotangent)
    for name in ("means", "quats", "opacities"):
        assert torch.allclose(one.tensors()[name], two.tensors()[name].float(), rtol=2e-2, atol=2e-2), name
    assert torch.allclose(one.signal, two.signal.float(), rtol=2e-2, atol=2e-2) and one.signal.any()
    assert torch.allclose(one.signal, one.chosen, rtol=1e-5)


def test_absolute_gradients_are_no_smaller_than_the_signed_ones():
    render = drawn(anyhow(dtype=torch.float32), camera())
    draw = torch.Generator().manual_seed(0)
    cotangent = Maps(color=torch.randn(3, 36, 48, generator=draw), median=torch.randn(36, 48, generator=draw))
    found = render.backward(cotangent, cotangent, absolute=True)
    assert (found.chosen >= found.signal.abs() - 1e-4).all() and (found.chosen > found.signal.abs()).any()
    colors = render.backward(Maps(color=cotangent.color), Maps(color=cotangent.color), absolute=True)
    assert (found.chosen > colors.chosen).any(), "the depth counts too"
    first = render.backward(cotangent, cotangent, absolute=True, rows=2)
    assert torch.allclose(first.means, found.means[:2]) and torch.allclose(first.chosen, found.chosen[:2])


def test_without_geometry_nothing_is_drawn_twice():
    splats, eye, calls = anyhow(dtype=torch.float32), camera(), []

    class Counting(type(select("cpu")[0])):
        def render(self, *given, **more):
            calls.append(given)
            return super().render(*given, **more)

    for geometry, renders in ((False, 1), (True, 2)):
        calls.clear()
        maps = PlanarGaussian().render(splats, eye, Counting(), NEAR, geometry, False).maps
        assert len(calls) == renders and (maps.median is None) == (not geometry)


def test_it_keeps_to_the_contract_of_primitives():
    check(PlanarGaussian())
    check(PlanarGaussian(sh_degree=1, antialias=True))


def test_planes_that_are_seen_edge_on_or_hardly_have_no_depth():
    eye = camera(4, 3, 10.0)
    rays = eye.rays(torch.float64)
    normal = -rays / rays.norm(dim=0)
    normal[:, 0, 0] = torch.linalg.cross(rays[:, 0, 0], torch.tensor([0.0, 1, 0]).double())
    normal[:, 0, 1] = 0
    normal[:, 0, 2] *= -1
    alpha, distance = torch.ones(3, 4).double(), torch.full((3, 4), 2.0).double()
    alpha[1, 0], distance[1, 1] = 0, 0
    depth = plane_depth(alpha, normal, distance, eye)
    none = torch.zeros(3, 4, dtype=torch.bool)
    none[0, :3] = none[1, :2] = True
    assert torch.equal(depth == 0, none)
    assert torch.allclose(depth[~none], (2 / rays.norm(dim=0))[~none])


@pytest.mark.parametrize("angle", [30.0, 60.0, 80.0])
def test_grazing_pixels_are_not_fused(angle):
    eye = camera(96, 72, 40.0)
    slanted = torch.tensor([0.9, 0.0, -0.44]).double()
    slanted /= slanted.norm()
    rays = eye.rays(torch.float64)
    cosine = -torch.einsum("c,chw->hw", slanted, rays) / rays.norm(dim=0)
    draw = torch.Generator().manual_seed(0)
    alpha = 0.2 + 0.8 * torch.rand(72, 96, generator=draw).double()
    depth = torch.ones(72, 96).double()
    given = Maps(None, alpha, alpha * depth, depth, alpha * slanted[:, None, None].expand(3, 72, 96))
    found = within(given, eye, angle)
    wanted = torch.rad2deg(cosine.clamp(-1, 1).acos()) <= angle
    assert torch.equal(found.median > 0, wanted) and torch.equal(found.depth > 0, wanted) and wanted.any()
    assert torch.equal(found.alpha, alpha) and not wanted.all()


def test_the_mesher_keeps_to_the_contract():
    assert components(Mesher)["max-angle-tsdf"] is MaxAngleTSDF
    check(MaxAngleTSDF(angle=75))
