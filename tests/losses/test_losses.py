import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.losses import L1, SSIM, Distortion, NormalConsistency
from surfkit.losses.base import Target
from surfkit.raster import native
from surfkit.raster.api import Maps
from surfkit.raster.normals import disagreement, disagreement_reference, normals_of
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View

CAMERA = Camera(torch.eye(4, dtype=torch.float64), 60.0, 55.0, 17.0, 21.0, 41, 37)


def target(photo=None) -> Target:
    return Target(View("a", CAMERA, None), photo)


def plane_depth(normal, offset: float) -> torch.Tensor:
    """Depth of the plane normal . p = offset at the camera's pixels."""
    rays = CAMERA.rays(torch.float64)
    return offset / (torch.tensor(normal, dtype=torch.float64)[:, None, None] * rays).sum(0)


def test_normals_of_a_plane_are_the_planes_own():
    normal = np.array([0.3, -0.2, -0.9]) / np.linalg.norm([0.3, -0.2, -0.9])
    found, valid = normals_of(plane_depth(normal, -2.0), CAMERA)
    assert valid.all()
    assert (found - torch.tensor(normal)[:, None, None]).abs().max() < 1e-12


def test_normals_of_a_sphere_point_from_its_centre():
    rays, centre, radius = CAMERA.rays(torch.float64), torch.tensor([0.1, -0.2, 4.0], dtype=torch.float64), 1.0
    b, a = (rays * centre[:, None, None]).sum(0), rays.square().sum(0)
    gap = b.square() - a * (centre.square().sum() - radius**2)
    depth = torch.where(gap > 0, (b - gap.clamp_min(0).sqrt()) / a, 0.0)
    found, valid = normals_of(depth, CAMERA)
    exact = ((rays * depth - centre[:, None, None]) / radius)[:, 1:-1, 1:-1]
    frontal = valid & (exact[2] < -0.7)  # differences are coarse where the sphere turns away
    assert frontal.sum() > 50
    assert ((found * exact).sum(0)[frontal] > 0.999).all()


def test_pixels_beside_a_hole_have_no_normal():
    depth = plane_depth((0.0, 0.0, -1.0), -2.0)
    depth[10, 12] = 0
    _, valid = normals_of(depth, CAMERA)
    holes = {(int(y) + 1, int(x) + 1) for y, x in (~valid).nonzero()}
    assert holes == {(9, 12), (11, 12), (10, 11), (10, 13)}


def random_maps(seed: int = 0) -> Maps:
    draw = torch.Generator().manual_seed(seed)
    size = (CAMERA.height, CAMERA.width)
    depth = torch.rand(size, generator=draw) * 0.1 + 1
    depth[torch.rand(size, generator=draw) < 0.03] = 0
    return Maps(
        color=torch.rand(3, *size, generator=draw),
        alpha=torch.rand(size, generator=draw),
        depth=depth,
        median=depth,
        normal=torch.randn(3, *size, generator=draw),
        distortion=torch.rand(size, generator=draw),
    )


@needs_native
@pytest.mark.parametrize("kernels", native.module().kernels() if native.module() else [])
def test_the_native_normals_agree_with_the_reference(kernels):
    maps, before = random_maps(), native.module().kernels_in_use()
    leaves = {name: getattr(maps, name).clone().requires_grad_() for name in ("median", "normal")}
    doubles = {name: value.detach().double().requires_grad_() for name, value in leaves.items()}
    try:
        native.module().use_kernels(kernels)
        value = disagreement(leaves["median"], maps.alpha, leaves["normal"], CAMERA)
        (3 * value).backward()
    finally:
        native.module().use_kernels(before)
    wanted = disagreement_reference(doubles["median"], maps.alpha.double(), doubles["normal"], CAMERA)
    (3 * wanted).backward()
    assert value.item() == pytest.approx(wanted.item(), rel=1e-6)
    for name, leaf in leaves.items():
        error = (leaf.grad - doubles[name].grad).norm() / doubles[name].grad.norm()
        assert error < 1e-5, name


def test_the_reference_disagreement_has_the_right_gradient():
    small = Camera(torch.eye(4, dtype=torch.float64), 9.0, 8.0, 2.0, 3.5, 6, 5)
    draw = torch.Generator().manual_seed(1)
    depth = (torch.rand(5, 6, generator=draw, dtype=torch.float64) + 1).requires_grad_()
    normal = torch.randn(3, 5, 6, generator=draw, dtype=torch.float64).requires_grad_()
    alpha = torch.rand(5, 6, generator=draw, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda d, n: disagreement_reference(d, alpha, n, small), (depth, normal))


def test_normal_consistency_is_zero_where_splats_lie_in_the_surface():
    normal = torch.tensor([0.0, 0.6, -0.8])
    depth = plane_depth(normal.double().numpy(), -3.0).float()
    flat = normal[:, None, None].expand(3, CAMERA.height, CAMERA.width)
    maps = Maps(alpha=torch.ones_like(depth), depth=depth, median=depth, normal=flat.contiguous())
    for which in ("median", "expected"):
        assert NormalConsistency(depth=which)(maps, target()).abs() < 1e-5
    turned = Maps(alpha=maps.alpha, depth=depth, median=depth, normal=-maps.normal)
    assert NormalConsistency(depth="median")(turned, target()).item() == pytest.approx(2.0, abs=1e-5)


def test_normals_count_where_a_prior_knows_nothing():
    """With a prior of the left half, the loss is that of the right one: a normal needs all four depths around it."""
    maps, everywhere, unknown = random_maps(), NormalConsistency(), NormalConsistency(where="unknown")
    assert unknown.needs_prior and not everywhere.needs_prior
    normal = maps.normal.clone().requires_grad_()
    maps = replace(maps, normal=normal)
    known = torch.zeros(CAMERA.height, CAMERA.width)
    known[:, :20] = 0.5

    def loss(confidence):
        return unknown(maps, replace(target(), prior=DepthPrior(known, confidence, 1.0)))

    assert unknown(maps, target()).item() == loss(0 * known).item() == loss(0.1 * known).item()
    assert loss(0 * known).item() == pytest.approx(everywhere(maps, target()).item(), rel=1e-6)
    assert loss(0 * known + 1).item() == 0
    surface, valid = normals_of(maps.median, CAMERA)
    error = (1 - (normal[:, 1:-1, 1:-1] * surface).sum(0) * maps.alpha[1:-1, 1:-1]) * valid
    assert loss(known).item() == pytest.approx((error[:, 20:].sum() / error.numel()).item(), rel=1e-5)
    (pull,) = torch.autograd.grad(loss(known), normal)
    assert (pull[:, :, :21] == 0).all() and (pull[:, 1:-1, 21:-1] != 0).any(0).float().mean() > 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])  # the native pass, and plain torch
def test_normal_consistency_does_not_pull_alpha(dtype):
    maps = random_maps()
    alpha, normal = (t.to(dtype, copy=True).requires_grad_() for t in (maps.alpha, maps.normal))
    loss = NormalConsistency(depth="median")(Maps(alpha=alpha, median=maps.median.to(dtype), normal=normal), target())
    by_alpha, by_normal = torch.autograd.grad(loss, (alpha, normal), allow_unused=True)
    assert by_alpha is None and by_normal.abs().sum() > 0


def test_photometric_losses():
    maps, draw = random_maps(), torch.Generator().manual_seed(2)
    photo = torch.rand(3, CAMERA.height, CAMERA.width, generator=draw)
    expected = np.abs(maps.color.numpy() - photo.numpy()).mean()
    assert L1()(maps, target(photo)).item() == pytest.approx(expected, rel=1e-6)
    assert SSIM()(maps, target(maps.color)).item() == pytest.approx(0.0, abs=1e-6)
    assert 0 < SSIM()(maps, target(photo)).item() < 2


def test_distortion_is_in_units_of_the_extent():
    maps = random_maps()
    assert Distortion(unit=0.5)(maps, target()).item() == pytest.approx(0.25 * maps.distortion.mean().item(), rel=1e-6)


def test_normalised_distortion_is_the_variance_of_the_depths_of_a_ray():
    """Weights w: sum over pairs of w w (m - m)^2, over (sum w)^2, is their variance; also where little is drawn."""
    draw = torch.Generator().manual_seed(0)
    weights, inverse = (
        0.1 * torch.rand(5, 8, 9, generator=draw, dtype=torch.float64),
        torch.rand(5, 8, 9, generator=draw),
    )
    weights[:, :4] *= 0.2
    spread = sum(weights[i] * weights[j] * (inverse[i] - inverse[j]) ** 2 for i in range(5) for j in range(i))
    maps = Maps(alpha=weights.sum(0), distortion=spread)
    mean = (weights * inverse).sum(0) / weights.sum(0)
    variance = (weights * (inverse - mean) ** 2).sum(0) / weights.sum(0)
    found = Distortion(unit=0.5, normalise=True)(maps, target()).item()
    assert found == pytest.approx(0.25 * variance.mean().item(), rel=1e-4)


def test_weights_begin_after_their_start():
    loss = NormalConsistency(weight=0.05, start=70)
    assert [loss.weight_at(index, 300) for index in (1, 70, 71, 300)] == [0, 0, 0.05, 0.05]
    assert L1().weight_at(1, 300) == 0.8 and math.isclose(SSIM().weight_at(300, 300), 0.2)


def test_the_weight_of_normals_starts_late_and_may_fall():
    constant, falling = NormalConsistency(weight=0.05, start=100), NormalConsistency(weight=0.05, end=0.005, start=100)
    assert [constant.weight_at(i, 300) for i in (1, 100, 101, 300)] == [0, 0, 0.05, 0.05]
    assert falling.weight_at(100, 300) == 0 and falling.weight_at(200, 300) == pytest.approx(0.05 * 0.1**0.5)
    assert falling.weight_at(300, 300) == pytest.approx(0.005)
    with pytest.raises(BadInput, match="normal loss goes from 0.0 to 0.1"):
        NormalConsistency(weight=0.0, end=0.1)
