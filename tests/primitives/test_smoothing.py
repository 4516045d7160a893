"""The 3D smoothing filter of Mip-Splatting."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.edit import Edit, apply, observe
from surfkit.primitives.points import Points
from surfkit.primitives.smoothing import INTERVAL, sampling_intervals
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.testing import check_primitive
from surfkit.testing.inputs import cloud

NEAR = 0.1
KINDS = [Gaussian3D(smoothing=0.2, antialias=True, dilation=0.1), Surfel2D(smoothing=0.2)]


def cameras():
    """Two that look along z from different distances with different lenses, and one that looks away."""
    made = []
    for back, focal, turned in ((3.0, 50.0, False), (6.0, 400.0, False), (2.0, 900.0, True)):
        pose = torch.eye(4, dtype=torch.float64)
        pose[2, 3] = back
        if turned:
            pose[[0, 2]] *= -1
        made.append(Camera(pose, focal, 0.9 * focal, 30.0, 20.0, 64, 48))
    return made


def brute_force(means, cameras):
    """Point by point, in float64."""
    found = []
    for point in means.double().numpy():
        seen = []
        for camera in cameras:
            x, y, z = (camera.world_to_camera.numpy() @ [*point, 1.0])[:3]
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            inside = (
                abs(u - camera.width / 2) <= 0.65 * camera.width and abs(v - camera.height / 2) <= 0.65 * camera.height
            )
            if z > NEAR and inside:
                seen.append(z / camera.fx)
        found.append(min(seen, default=math.nan))
    return np.where(np.isnan(found), np.nanmax(found), found)


def model(primitive, interval=None):
    params = primitive.init(cloud(40), torch.Generator().manual_seed(0))
    return params if interval is None else params | {INTERVAL: interval}


def test_intervals_are_those_of_the_sharpest_view_that_sees_a_point():
    means = 1.5 * torch.randn(400, 3, generator=torch.Generator().manual_seed(1))
    wanted = brute_force(means, cameras())
    found = sampling_intervals(means, cameras(), NEAR)
    assert np.allclose(found.numpy(), wanted, rtol=1e-5)
    assert len(np.unique((wanted < 0.03).tolist())) == 2, "both cameras are the sharpest one of some"
    assert not sampling_intervals(means + 1e4, cameras(), NEAR).any(), "seen by none at all"


@pytest.mark.parametrize("primitive", KINDS)
def test_variances_add_and_the_integral_stays(primitive):
    interval = torch.linspace(0.001, 0.5, 40)
    params = model(primitive, interval)
    with torch.no_grad():
        plain = replace(primitive, smoothing=0.0).activate(params, 0)
        found = primitive.activate(params, 0)
    assert torch.allclose(found.scales**2, plain.scales**2 + 0.2 * interval[:, None] ** 2, rtol=1e-5)
    mass = [splats.opacities * splats.scales.prod(-1) for splats in (plain, found)]
    assert torch.allclose(mass[0], mass[1], rtol=1e-5) and (found.opacities < plain.opacities).all()
    sharp = primitive.activate(model(primitive), 0)
    assert torch.equal(sharp.scales, plain.scales) and torch.equal(sharp.opacities, plain.opacities)


@pytest.mark.parametrize("primitive", KINDS)
def test_intervals_are_not_trained(primitive):
    params = {name: value.requires_grad_() for name, value in model(primitive, torch.full((40,), 0.1)).items()}
    splats = primitive.activate(params, 0)
    (splats.opacities.sum() + splats.scales.sum()).backward()
    assert params[INTERVAL].grad is None and primitive.columns()[INTERVAL].rate.at(1, 10) == 0
    for name in ("scales", "opacities"):
        assert (params[name].grad != 0).all()


@pytest.mark.parametrize("primitive", KINDS)
def test_opacities_are_asked_for_after_the_filter(primitive):
    params = model(primitive, torch.full((40,), 0.01))
    share = primitive.activate(params, 0).opacities / params["opacities"].sigmoid()
    wanted = torch.linspace(0.001, 0.8, 40) * share
    wanted[3] = math.nan
    found = primitive.activate(primitive.with_opacities(params, wanted), 0).opacities
    wanted[3] = primitive.activate(params, 0).opacities[3]
    assert torch.allclose(found, wanted, rtol=1e-4)
    table = primitive.table(params)
    drawn = primitive.activate(params, primitive.sh_degree)
    assert torch.allclose(table.opacity_logits.sigmoid(), drawn.opacities) and torch.equal(
        table.log_scales, drawn.scales.log()
    ), "files hold what is drawn"


@pytest.mark.parametrize("primitive", KINDS)
def test_copies_get_intervals_of_their_own(primitive):
    views = [View(str(at), camera, None) for at, camera in enumerate(cameras())]
    points = observe(primitive, Points.fresh(model(primitive)), views, NEAR)
    split = torch.arange(40) < 9
    points = apply(primitive, points, Edit(split=split), torch.Generator().manual_seed(3))
    points = observe(primitive, points, views, NEAR)
    assert len(points) == 49
    assert torch.equal(points.params[INTERVAL], sampling_intervals(points.params["means"], cameras(), NEAR))
    assert observe(Gaussian3D(), points, views, NEAR) is points


@pytest.mark.parametrize("primitive", KINDS)
def test_the_contract(primitive):
    check_primitive(primitive)


def test_settings_that_make_no_sense():
    assert INTERVAL not in Gaussian3D().columns() and INTERVAL not in Surfel2D().columns()
    with pytest.raises(BadInput, match="primitive.smoothing is -1; .*0 or more"):
        Surfel2D(smoothing=-1.0)
    with pytest.raises(BadInput, match="primitive.dilation is 0; .*above 0"):
        Gaussian3D(dilation=0.0)
