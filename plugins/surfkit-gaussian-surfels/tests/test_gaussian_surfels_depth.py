"""Depth, normals and the zero thickness against the formulas of the paper, in float64, and against exact planes."""

import math

import pytest
import torch
from surfkit_gaussian_surfels import GAUSSIAN_SURFELS

from surfkit.plugin import Camera, Maps, SparsePoints, Splats, rotated
from surfkit.primitives.flat3d import NO_THICKNESS
from surfkit.raster.api import CUTOFF
from surfkit.raster.reference import draw
from surfkit.raster.select import select
from surfkit.testing import check

CAMERA = Camera(torch.eye(4, dtype=torch.float64), 60.0, 55.0, 20.5, 14.0, 40, 30)


def disc(tilt: float, thickness: float, size: float = 0.02, centre=(0.15, -0.08, 1.1), opacity: float = 0.9) -> Splats:
    """One disc, turned about an axis in the image plane by radians, with a given third scale, in float64."""
    axis = torch.tensor([0.6, 0.8, 0.0]).double()
    quat = torch.cat([torch.tensor([math.cos(tilt / 2)]).double(), math.sin(tilt / 2) * axis])
    scales = torch.tensor([[size, 0.7 * size, thickness]]).double()
    return Splats("gaussian", torch.tensor([centre]).double(), quat[None], scales, torch.tensor([opacity]).double(),
                  torch.zeros(1, 1, 3).double())  # fmt: skip


def normal_of(splats: Splats) -> torch.Tensor:
    """(3,) the third axis of the rotation, towards a camera at the origin."""
    normal = rotated(torch.tensor([[0.0, 0.0, 1.0]]).double(), splats.quats.double())[0]
    return normal if normal @ splats.means[0].double() < 0 else -normal


def paper_depth(splats: Splats, camera: Camera) -> torch.Tensor:
    """(H, W) d(u) = d(u_c) + (W R)_3 J^-1 (u - u_c): J is the Jacobian of the projection by the disc's coordinates.

    Where the blur of the footprint reaches beyond the disc, the depth is held within the reach of the disc.
    """
    centre = splats.means[0]
    axes = torch.stack([rotated(torch.eye(3)[k : k + 1].double(), splats.quats)[0] for k in range(2)], 1)

    def image(uv: torch.Tensor) -> torch.Tensor:
        place = centre + axes @ uv
        return torch.stack([camera.fx * place[0] / place[2] + camera.cx, camera.fy * place[1] / place[2] + camera.cy])

    origin = torch.zeros(2, dtype=torch.float64)
    inverse = torch.linalg.inv(torch.autograd.functional.jacobian(image, origin))
    slope, middle = axes[2] @ inverse, image(origin)
    y, x = torch.meshgrid(torch.arange(camera.height).double(), torch.arange(camera.width).double(), indexing="ij")
    depth = centre[2] + slope[0] * (x + 0.5 - middle[0]) + slope[1] * (y + 0.5 - middle[1])
    reach = CUTOFF * splats.scales.max()
    return depth.clamp(centre[2] - reach, centre[2] + reach)


def plane_depth(splats: Splats, camera: Camera) -> torch.Tensor:
    """(H, W) depth of the plane of the disc along each ray."""
    normal = normal_of(splats)
    return (normal @ splats.means[0].double()) / torch.einsum("i,ihw->hw", normal, camera.rays(torch.float64))


def rendered(splats: Splats) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W) depth D / (1 - T) of the reference, and where there is any."""
    maps = draw(splats, CAMERA, 0.01).maps
    return maps.expected_depth(), maps.need("alpha") > 0


@pytest.mark.parametrize("tilt", [0.0, 0.4, -0.9, 1.3])
def test_the_depth_of_a_disc_without_thickness_is_that_of_the_paper(tilt):
    splats = disc(tilt, NO_THICKNESS)
    depth, there = rendered(splats)
    assert there.sum() > 4 and (depth.std() > 0 or tilt == 0)
    assert torch.allclose(depth[there], paper_depth(splats, CAMERA)[there], rtol=1e-12, atol=0)
    native = select("cpu")[0].render(in_float(splats), CAMERA, 0.01).maps
    shared = there & (native.need("alpha") > 0)
    assert shared.sum() > 4 and torch.allclose(native.expected_depth()[shared].double(), depth[shared], rtol=1e-5)


def test_a_thin_ellipsoid_differs_by_the_square_of_its_thickness():
    off = []
    for thickness in (2e-3, 1e-3):
        splats = disc(1.2, thickness * 0.02)
        depth, there = rendered(splats)
        off.append((depth - paper_depth(splats, CAMERA))[there].abs().max())
    assert 0 < off[1] < 1e-6 and off[0] / off[1] == pytest.approx(4, rel=0.01)


@pytest.mark.parametrize("tilt", [0.0, 0.4, -0.9])
def test_the_depth_is_that_of_the_plane_to_first_order(tilt):
    """A plane's inverse depth is linear in the pixel: 1 / z = (1 - t) / z_c where the first order is z_c (1 + t)."""
    splats = disc(tilt, NO_THICKNESS, size=0.05)
    depth, there = rendered(splats)
    plane, centre = plane_depth(splats, CAMERA), splats.means[0, 2]
    assert torch.allclose((centre**2 / (2 * centre - depth))[there], plane[there], rtol=1e-12, atol=0)
    if tilt == 0:
        assert (depth - plane)[there].abs().max() < 1e-12
    else:
        assert 0 < (depth - plane)[there].abs().max() < 0.15 * (plane - centre)[there].abs().max()


def in_float(splats: Splats) -> Splats:
    return splats.with_named({name: value.float() for name, value in splats.named().items()})


def test_the_normal_is_the_third_axis_towards_the_camera():
    for tilt in (0.5, 0.5 + math.pi):  # from the front, and from behind
        splats = disc(tilt, NO_THICKNESS)
        maps = draw(splats, CAMERA, 0.01).maps
        alpha = maps.need("alpha")
        normal = (maps.need("normal") / alpha.clamp_min(1e-9))[:, alpha > 0]
        assert torch.allclose(normal, normal_of(splats)[:, None].expand_as(normal), atol=1e-12)


def test_the_third_scale_is_pinned_and_no_gradient_moves_it():
    primitive, generator = GAUSSIAN_SURFELS.primitive, torch.Generator().manual_seed(1)
    cloud = SparsePoints(torch.rand(40, 3, generator=generator) + torch.tensor([-0.5, -0.5, 1.0]),
                         torch.full((40, 3), 127, dtype=torch.uint8))  # fmt: skip
    params = primitive.init(cloud, generator)
    assert params["scales"].shape == (40, 2), "only two scales are trained"
    leaves = {name: value.clone().requires_grad_() for name, value in params.items()}
    splats = primitive.activate(leaves, 0)
    view = select("cpu")[0].render(splats.detached(), CAMERA, 0.01)
    total = Maps(**{name: torch.randn(value.shape, generator=generator) for name, value in view.maps.present().items()})
    made, given = splats.tensors(), view.backward(total).tensors()
    assert view.seen.any() and torch.isfinite(given["scales"][:, :2]).all()
    names = [name for name, value in made.items() if value.requires_grad]
    grads = torch.autograd.grad([made[n] for n in names], list(leaves.values()), [given[n] for n in names],
                                allow_unused=True)  # fmt: skip
    stepped = {
        name: value - 0.1 * (0 if grad is None else grad)
        for (name, value), grad in zip(params.items(), grads, strict=True)
    }
    assert not torch.equal(stepped["scales"], params["scales"])
    for each in (params, stepped, primitive.split(stepped, generator)):
        scales = primitive.activate(each, 0).scales
        assert (scales[:, 2] == torch.tensor(NO_THICKNESS)).all() and (scales[:, :2] > 1e-6).all()
        assert (scales[:, 2] ** 2 + scales[:, 0] ** 2 == scales[:, 0] ** 2).all(), "as good as zero"


def test_the_primitive_keeps_its_contract():
    check(GAUSSIAN_SURFELS.primitive)
