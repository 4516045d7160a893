"""Ellipsoids as stochastic solids: against their attenuation integrated along each ray, and compiled against that."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.raster.api import Maps
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.rays import ray_opacity, ray_opacity_reference

from .scenes import NEAR, SCENES, double, make
from .test_rays import points_about

SAMPLES = 20_001


def along_axis(view, z, x=0.0):
    """(n, 3) places of the world at depths z, on the ray through x of the plane z = 1."""
    z = torch.as_tensor(z, dtype=torch.float64)
    return (torch.stack([x * z, 0 * z, z], 1) - view.world_to_camera[:3, 3]) @ view.world_to_camera[:3, :3]


def one_ball(opacity=0.8, scale=0.1):
    """A ball at a depth of 2 on the axis of the camera."""
    splats, view = make("plain", "gaussian")
    one = double(splats).first(1)
    values = {"means": along_axis(view, [2.0]), "scales": torch.full((1, 3), scale).double()}
    return one.with_named(one.named() | values | {"opacities": torch.tensor([opacity], dtype=torch.float64)}), view


def integrated(splats, view, point):
    """What is left open of the way to a point: exp(-integral of |d log v / dt|), v = sqrt(1 - G) (eq. 3 and 4); numpy.

    G is by the inverse of the covariance. The integral is the total variation of log v, from where v is 1.
    """
    pose = view.world_to_camera.numpy()
    centre = -pose[:3, :3].T @ pose[:3, 3]
    z = (pose[:3, :3] @ point + pose[:3, 3])[2]
    places = centre + np.linspace(NEAR / z, 1, SAMPLES)[:, None] * (point - centre)
    left = 1.0
    for i in range(len(splats)):
        w, a, b, c = splats.quats[i].numpy() / splats.quats[i].norm().item()
        cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        variances = turn @ np.diag(splats.scales[i].numpy() ** 2) @ turn.T
        mean = splats.means[i].numpy()
        depth, deep = (pose[:3, :3] @ mean + pose[:3, 3])[2], pose[2, :3] @ variances @ pose[2, :3]
        if depth <= NEAR or 2 * np.log(255) * deep >= depth**2:
            continue
        apart = places - mean
        density = splats.opacities[i].item() * np.exp(
            -np.einsum("pi,ij,pj->p", apart, np.linalg.inv(variances), apart) / 2
        )
        density = np.where(density >= 1 / 255, np.minimum(density, 0.99), 0.0)
        log_vacancy = np.log1p(-density) / 2
        left *= np.exp(log_vacancy[0] - np.abs(np.diff(log_vacancy)).sum())
    return left


def test_the_formula_is_the_attenuation_integrated():
    splats, view = make("plain", "gaussian")
    splats = double(splats).first(25)
    points = points_about(splats)[:100]
    found = ray_opacity_reference(splats, view, NEAR, points, solid=True)
    seen = (~found.isnan()).nonzero()[:, 0]
    exact = torch.tensor([1 - integrated(splats, view, points[i].numpy()) for i in seen])
    assert len(seen) > 20 and exact.max() > 0.5
    # A peak or the cut between two samples, and nothing else.
    assert ((found[seen] - exact).abs() > 1e-4).sum() <= 2 and (found[seen] - exact).abs().max() < 0.01
    other = ray_opacity_reference(splats, view, NEAR, points)
    assert (other - found)[seen].abs().max() > 0.02, "they are other fields"


@needs_native
@pytest.mark.parametrize("name", SCENES)
def test_compiled_equals_the_formula(name):
    splats, view = make(name, "gaussian")
    points = points_about(splats)
    found = ray_opacity(splats, view, NEAR, points, solid=True)
    exact = ray_opacity_reference(double(splats), view, NEAR, points, solid=True)
    assert torch.equal(found.isnan(), exact.isnan()) and int((~exact.isnan()).sum()) > 20
    error = (found.double() - exact).abs()[~exact.isnan()]
    assert (error > 2e-4).double().mean() < 0.01 and error.median() < 2e-6
    assert error.max() < 0.01, "what a splat at the least alpha may come to"


@pytest.mark.parametrize("name", SCENES)
def test_behind_everything_both_ways_hide_the_same(name):
    splats, view = make(name, "gaussian")
    rays = view.rays(torch.float64).flatten(1).T * 5_000
    points = (rays - view.world_to_camera[:3, 3]) @ view.world_to_camera[:3, :3]
    solid, largest = (ray_opacity(splats, view, NEAR, points, solid) for solid in (True, False))
    assert (solid - largest).abs().max() < 1e-5


@pytest.mark.parametrize("opacity", [0.05, 0.8, 1.0])
def test_it_falls_continuously_to_what_is_drawn(opacity):
    """Along the axis of a ball: v up to its centre, v*^2 / v behind it, also where 1 - G is cut at ALPHA_MAX."""
    ball, view = one_ball(opacity)
    z = torch.linspace(1.0, 3.0, 4_001, dtype=torch.float64)
    for left in (1 - f(ball, view, NEAR, along_axis(view, z), solid=True).double()
                 for f in (ray_opacity, ray_opacity_reference)):  # fmt: skip
        density = (opacity * torch.exp(-((z - 2) ** 2) / 0.02)).clamp_max(0.99)
        density = torch.where(density >= 1 / 255, density, 0.0)
        at_centre = min(opacity, 0.99)
        told = torch.where(z <= 2, (1 - density).sqrt(), (1 - at_centre) / (1 - density).sqrt())
        assert torch.allclose(left, told, atol=1e-5)
        assert (left[1:] - left[:-1]).max() < 1e-6, "it never rises"
        steep = max(1.0, 1 / (1 - at_centre) ** 0.5) * opacity / 0.1 * (z[1] - z[0])
        assert (left[:-1] - left[1:]).max() < 0.002 + steep, "but for the step of the tail that is cut"
        assert left[-1] == pytest.approx(1 - at_centre, abs=1e-6)


def test_where_peaks_lie_behind_it_is_the_product_of_vacancies():
    """Then it is the same from everywhere: a place between two balls, looked at from the side of neither."""
    ball, view = one_ball(0.9)
    two = ball.and_then(ball.with_named(ball.named() | {"means": along_axis(view, [2.05], 0.02)}))
    place = along_axis(view, [1.95], 0.01)
    apart = (two.means - place).square().sum(1)
    vacancy = (1 - 0.9 * torch.exp(-apart / 0.02)).sqrt().prod()
    assert float(1 - ray_opacity_reference(two, view, NEAR, place, solid=True)) == pytest.approx(float(vacancy))
    assert float(1 - ray_opacity(two, view, NEAR, place, solid=True)) == pytest.approx(float(vacancy), abs=1e-6)


@needs_native
@pytest.mark.parametrize("name", ("plain", "huge", "opaque"))
def test_the_median_depth_is_where_half_is_left(name):
    splats, view = make(name, "solid")
    maps = NativeRasterizer().render(splats, view, NEAR).maps
    first = NativeRasterizer().render(replace(splats, geometry="ray"), view, NEAR).maps.median
    depth = maps.median.double()
    seen = depth > 0
    assert seen.sum() > 0.8 * (first > 0).sum() > 100 and not (seen & (first == 0)).any()
    assert ((depth - first).abs() > 1e-3)[seen].float().mean() > 0.5, "it is not the median of splatting"

    def hidden(share):
        points = ((view.rays(torch.float64) * depth * share)[:, seen].T - view.world_to_camera[:3, 3]) @ turn
        return ray_opacity(splats, view, NEAR, points, solid=True)

    turn = view.world_to_camera[:3, :3]
    # Densities below ALPHA_MIN count in the depth, and not in what is asked here.
    assert ((hidden(1.0) - 0.5).abs() < 0.02).float().mean() > 0.95
    assert (hidden(0.98) < 0.5).float().mean() > 0.95 and (hidden(1.02) > 0.5).float().mean() > 0.95


@needs_native
@pytest.mark.parametrize("opacity", [0.4, 0.6, 0.9])
def test_the_depth_of_one_ball_and_its_gradient(opacity):
    """Before the centre where G is 3/4, behind it where (1 - o) / sqrt(1 - G) is 1/2; none where it hides less."""
    ball, view = one_ball(opacity)
    view = replace(view, cx=20.5, cy=16.5)
    values = {name: value.float() for name, value in ball.tensors().items()}
    drawn = NativeRasterizer().render(replace(ball, **values, geometry="solid"), view, NEAR)
    depth = float(drawn.maps.median[16, 20])
    if opacity < 0.5:
        assert not drawn.maps.median.any()
        return

    def told(o):
        density = 0.75 if o >= 0.75 else 1 - 4 * (1 - o) ** 2
        return 2 + np.sign(0.75 - o) * 0.1 * np.sqrt(2 * np.log(o / density))

    assert depth == pytest.approx(told(opacity), abs=1e-6)
    one = torch.zeros_like(drawn.maps.median)
    one[16, 20] = 1
    found = drawn.backward(Maps(median=one))
    along = view.world_to_camera[2, :3].float()
    assert torch.allclose(found.means[0], along, atol=1e-4), "it moves with the ball"
    assert float(found.opacities) == pytest.approx((told(opacity + 1e-5) - told(opacity - 1e-5)) / 2e-5, rel=1e-3)


@needs_native
def test_points_very_far_behind_small_splats():
    ball, view = one_ball(0.8, scale=1e-6)
    left = 1 - ray_opacity(ball, view, NEAR, along_axis(view, [1e3, 1e6]), solid=True)
    assert torch.allclose(left, torch.full((2,), 0.2), atol=1e-3)
