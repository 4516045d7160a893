"""What ellipsoids hide of points: compiled against the formula in float64, and the formula against densities that are
sampled along each ray."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.core.check import BadInput
from surfkit.raster import native
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.rays import ray_opacity, ray_opacity_reference
from surfkit.raster.reference import Reference

from .scenes import NEAR, SCENES, Draw, double, make


def points_about(splats, seed: int = 3):
    """On the splats, before and behind them, outside and behind the camera."""
    draw = Draw(seed)
    near_by = splats.means.double().repeat(3, 1) + 0.1 * draw.normal(3 * len(splats), 3)
    return torch.cat([near_by, 3 * draw.normal(200, 3)])


def sampled(splats, view, points):
    """(P,) opacities from densities at many places of each ray, by the inverse of the covariance; numpy."""
    pose = view.world_to_camera.numpy()
    found = []
    centre = -pose[:3, :3].T @ pose[:3, 3]
    for point in points.numpy():
        x, y, z = pose[:3, :3] @ point + pose[:3, 3]
        u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        if not (z > NEAR and 0 <= u < view.width and 0 <= v < view.height):
            found.append(np.nan)
            continue
        along = np.linspace(NEAR / z, 1, 6_001)[:, None]
        places = centre + along * (point - centre)
        left = 1.0
        for i in range(len(splats)):
            w, a, b, c = splats.quats[i].numpy() / splats.quats[i].norm().item()
            cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
            turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
            precision = turn @ np.diag(splats.scales[i].numpy() ** -2.0) @ turn.T
            mean = splats.means[i].numpy()
            depth = (pose[:3, :3] @ mean + pose[:3, 3])[2]
            deep = pose[2, :3] @ turn @ np.diag(splats.scales[i].numpy() ** 2) @ turn.T @ pose[2, :3]
            if depth <= NEAR or 2 * np.log(255) * deep >= depth**2:
                continue
            apart = places - mean
            power = np.einsum("pi,ij,pj->p", apart, precision, apart).min() / 2
            alpha = splats.opacities[i].item() * np.exp(-power)
            left *= 1 - min(alpha, 0.99) if alpha >= 1 / 255 else 1.0
        found.append(1 - left)
    return torch.tensor(found)


def test_the_formula_is_the_largest_density_before_the_point():
    splats, view = make("plain", "gaussian")
    splats = double(splats).first(25)
    points = points_about(splats)[:100]
    exact, found = ray_opacity_reference(splats, view, NEAR, points), sampled(splats, view, points)
    assert torch.equal(exact.isnan(), found.isnan()) and 20 < int((~exact.isnan()).sum()) < 100
    error = (exact - found).abs().nan_to_num()
    assert (error > 1e-4).sum() <= 2, "but for a splat at the least alpha"
    assert exact.nan_to_num().max() > 0.5


@needs_native
@pytest.mark.parametrize("name", SCENES)
def test_compiled_equals_the_formula(name):
    splats, view = make(name, "gaussian")
    points = points_about(splats)
    found = ray_opacity(splats, view, NEAR, points)
    exact = ray_opacity_reference(double(splats), view, NEAR, points)
    assert torch.equal(found.isnan(), exact.isnan()) and int((~exact.isnan()).sum()) > 20
    error = (found.double() - exact).abs()[~exact.isnan()]
    assert (error > 2e-4).double().mean() < 0.01 and error.median() < 2e-6
    assert error.max() < 0.01, "what a splat at the least alpha may come to"


@needs_native
@pytest.mark.parametrize("name", SCENES)
def test_behind_everything_it_is_what_is_drawn(name):
    splats, view = make(name, "gaussian")
    splats = replace(splats, geometry="ray", antialias=False)
    rays = view.rays(torch.float64).flatten(1).T * 50
    points = (rays - view.world_to_camera[:3, 3]) @ view.world_to_camera[:3, :3]
    drawn = NativeRasterizer().render(splats, view, NEAR, geometry=False).maps.alpha.flatten()
    error = (ray_opacity(splats, view, NEAR, points) - drawn).abs()[drawn < 0.98]  # ahead of where the image stops
    assert (error > 2e-4).float().mean() < 0.01 and error.median() < 1e-5


def test_one_splat_counts_in_part_for_points_that_lie_in_it():
    """A ball at a distance of 2: along the axis alpha is that of the density at the point, then at the centre."""
    splats, view = make("plain", "gaussian")
    turn, shift = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]

    def world(z):
        return (torch.stack([torch.zeros_like(z), torch.zeros_like(z), z], 1) - shift) @ turn

    z = torch.tensor([1.0, 1.8, 1.9, 2.0, 2.1, 5.0], dtype=torch.float64)
    one = double(splats).first(1)
    ball = one.with_named(
        one.named()
        | {"means": world(torch.tensor([2.0], dtype=torch.float64)), "scales": torch.full((1, 3), 0.1).double()}
        | {"opacities": torch.tensor([0.8], dtype=torch.float64)}
    )
    alpha = 0.8 * torch.exp(-((torch.minimum(z, torch.tensor(2.0)) - 2) ** 2) / 0.02)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    assert torch.allclose(ray_opacity(ball, view, NEAR, world(z)).double(), alpha, atol=1e-6)
    assert torch.allclose(ray_opacity_reference(ball, view, NEAR, world(z)), alpha, atol=1e-9)
    flat = Reference().opacity_before(ball, view, NEAR, world(z))
    assert flat[2] == 0 and flat[3] > 0.79, "by its depth in the image it is hidden all at once"


@needs_native
@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize("kernels", ["avx512", "avx2", "baseline"])
def test_every_compilation_agrees(kernels, solid):
    module = native.module()
    if kernels not in module.kernels():
        pytest.skip(f"this machine cannot run {kernels}")
    splats, view = make("needle", "gaussian")
    points, best = points_about(splats), module.kernels_in_use()
    found = []
    try:
        for name in (best, kernels):
            module.use_kernels(name)
            found.append(ray_opacity(splats, view, NEAR, points, solid).nan_to_num())
    finally:
        module.use_kernels(best)
    assert ((found[0] - found[1]).abs() > 1e-4).float().mean() < 0.01 and (found[0] - found[1]).abs().median() < 1e-6


def test_the_number_of_threads_does_not_change_a_bit():
    splats, view = make("huge", "gaussian")
    points, before, found = points_about(splats), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(ray_opacity(splats, view, NEAR, points))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(found[0].nan_to_num(), other.nan_to_num()) for other in found)


def test_discs_and_values_that_are_not_finite_are_refused():
    discs, view = make("plain", "surfel")
    with pytest.raises(BadInput, match="ellipsoids.*surfel splats"):
        ray_opacity(discs, view, NEAR, torch.zeros(1, 3, dtype=torch.float64))
    splats, view = make("plain", "gaussian")
    splats.scales[3, 1] = torch.nan
    with pytest.raises(BadInput, match="scales"):
        ray_opacity(splats, view, NEAR, torch.zeros(1, 3, dtype=torch.float64))
    none = ray_opacity(splats.first(0), view, NEAR, points_about(splats.first(3)))
    assert not none.nan_to_num().any() and not none.isnan().all()
