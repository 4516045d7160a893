"""The losses against analytic scenes: a plane, a tilted splat among upright ones, opacities below and above a half."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from surfkit_gaussian_surfels import GAUSSIAN_SURFELS
from surfkit_gaussian_surfels.losses import BimodalOpacity, NormalCurvature, NormalDepthConsistency

from surfkit.plugin import BadInput, Camera, Maps, Splats, Target, View, rescale
from surfkit.primitives.flat3d import NO_THICKNESS
from surfkit.raster.reference import draw
from surfkit.testing import check

CAMERA = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 16.0, 12.0, 32, 24)
TARGET = Target(View("a", CAMERA, Path("a")), torch.zeros(3, 24, 32).double())


def plane_maps(alpha: float = 1.0, bend: float = 0.0) -> Maps:
    """What a tilted plane gives, through (0, 0, 1), or one whose splats' normals turn by radians per pixel along x."""
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0]).double(), dim=0)
    depth = normal[2] / torch.einsum("i,ihw->hw", normal, CAMERA.rays(torch.float64))
    turn = bend * torch.arange(32).double()
    turned = torch.stack([normal[0] * turn.cos() - normal[2] * turn.sin(), normal[1].expand(32),
                          normal[0] * turn.sin() + normal[2] * turn.cos()])  # fmt: skip
    normals, one = turned[:, None].expand(3, 24, 32), torch.full_like(depth, alpha)
    return Maps(torch.zeros(3, 24, 32).double(), one, alpha * depth, depth, alpha * normals)


@pytest.mark.parametrize("alpha", [1.0, 0.6])
def test_consistency_and_curvature_are_zero_on_a_plane(alpha):
    """Whatever its opacity: D and N are divided by 1 - T."""
    for loss in (NormalDepthConsistency(), NormalCurvature()):
        assert float(loss(plane_maps(alpha), TARGET)) == pytest.approx(0, abs=1e-12)


def test_consistency_is_one_minus_the_cosine():
    maps, angle = plane_maps(), 0.4
    normal = maps.need("normal")
    upward = torch.tensor([0, 1.0, 0]).double()[:, None, None].expand(3, 24, 32)
    aside = torch.nn.functional.normalize(torch.linalg.cross(normal, upward, dim=0), dim=0)
    tilted = replace(maps, normal=math.cos(angle) * normal + math.sin(angle) * aside)
    assert float(NormalDepthConsistency()(tilted, TARGET)) == pytest.approx(1 - math.cos(angle), rel=1e-9)


def test_curvature_is_the_change_of_the_normal():
    """Of a normal that turns by a small angle from column to column, the sum of both components' changes."""
    bend = 1e-3
    x, y, z = plane_maps(bend=bend).need("normal")
    wanted = ((x[:, 1:] - x[:, :-1]).abs() + (z[:, 1:] - z[:, :-1]).abs()).mean()
    found = NormalCurvature()(plane_maps(bend=bend), TARGET)
    assert float(found) == pytest.approx(float(wanted), rel=1e-9) and 0.9 * bend < float(found) < 1.5 * bend
    across = replace(plane_maps(), normal=plane_maps(bend=bend).need("normal").flip(2))
    assert float(NormalCurvature()(across, TARGET)) == pytest.approx(float(wanted), rel=1e-9)


def wall(tilt: float) -> Splats:
    """A wall of discs that face the camera at z = 1, the middle one tilted by radians about the y axis."""
    y, x = torch.meshgrid(torch.linspace(-0.5, 0.5, 9), torch.linspace(-0.6, 0.6, 11), indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.ones(99)], 1).double()
    quats = torch.tensor([1.0, 0, 0, 0]).double().repeat(99, 1)
    quats[49] = torch.tensor([math.cos(tilt / 2), 0, math.sin(tilt / 2), 0]).double()
    scales = torch.tensor([0.07, 0.07, NO_THICKNESS]).double().repeat(99, 1)
    return Splats("gaussian", means, quats, scales, torch.full((99,), 0.9).double(), torch.zeros(99, 1, 3).double())


@pytest.mark.parametrize("tilt", [0.5, -0.5])
def test_consistency_turns_a_tilted_splat_back(tilt):
    loss = NormalDepthConsistency()
    assert float(loss(draw(wall(0.0), CAMERA, 0.01).maps, TARGET)) < 1e-9, "all agree"
    splats = wall(tilt)
    quats = splats.quats.clone().requires_grad_()
    before = loss(draw(replace(splats, quats=quats), CAMERA, 0.01).maps, TARGET)
    (grad,) = torch.autograd.grad(before, quats)
    assert grad[49].norm() > 20 * grad[[0, 10, 88, 98]].norm(dim=1).max(), "it is the one that turns most"
    turned = splats.quats - 0.05 * grad / grad[49].norm()
    angle = 2 * math.atan2(float(turned[49, 2]), float(turned[49, 0]))
    assert abs(angle) < abs(tilt) - 0.02 and angle * tilt > 0
    after = loss(draw(replace(splats, quats=turned), CAMERA, 0.01).maps, TARGET)
    assert float(after) < float(before) - 1e-4


def test_opacities_are_pushed_to_either_end():
    opacities = torch.tensor([0.05, 0.2, 0.45, 0.5, 0.55, 0.8, 0.95]).double().requires_grad_()
    value = BimodalOpacity()(replace(wall(0.0).first(7), opacities=opacities))
    wanted = sum(math.exp(-((float(o) - 0.5) ** 2) / 0.05) for o in opacities) / 7
    assert float(value) == pytest.approx(wanted, rel=1e-12)
    (grad,) = torch.autograd.grad(value, opacities)
    assert (grad[:3] > 0).all() and grad[3] == 0 and (grad[4:] < 0).all(), "descent moves them away from a half"
    assert grad[2].abs() > 5 * grad[0].abs(), "little where they are there already"


def test_weights_are_those_of_the_paper():
    stage = GAUSSIAN_SURFELS.pretrain
    assert stage.steps == 15_000
    at = {index: stage.weights_at(index) for index in (1, 7_500, 15_000)}
    assert at[1]["consistency"] == pytest.approx(0.01, abs=1e-4)
    assert at[7_500]["consistency"] == at[15_000]["consistency"] == pytest.approx(0.11)
    assert at[1]["normal-prior"] == pytest.approx(0.04, rel=1e-3) and at[15_000]["normal-prior"] == pytest.approx(0.02)
    assert at[1]["curvature"] == at[15_000]["curvature"] == 0.005
    assert stage.regularizers["opacity"].weight_at(1, 15_000) == 0.01
    assert (
        stage.densify.cull_opacity == 0.1 and stage.densify.reset_opacity == 0.12 and stage.densify.reset_every == 1_000
    )
    assert rescale(stage, 0.1).weights_at(750)["consistency"] == pytest.approx(0.11)


@pytest.mark.parametrize("loss", [NormalDepthConsistency(), NormalCurvature(), BimodalOpacity()])
def test_parts_keep_to_their_contract(loss):
    check(loss)


@pytest.mark.parametrize(
    "part, setting",
    [(NormalDepthConsistency, {"gain": -0.1}), (NormalDepthConsistency, {"weight": -1.0}),
     (NormalCurvature, {"weight": -1.0}), (BimodalOpacity, {"weight": -1.0})],
)  # fmt: skip
def test_weights_below_zero_are_refused(part, setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        part(**setting)
