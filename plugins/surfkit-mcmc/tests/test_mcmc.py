"""The formula against stacked Gaussians, the policy against its contract, and a short training."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import surfkit_mcmc
import torch
from surfkit_mcmc.relocation import Relocation, drawn, shared

from surfkit.core.registry import plugins
from surfkit.core.schedule import LearningRate, rescale
from surfkit.densify import Elongation
from surfkit.plugin import BadInput, Densify, Points, Step, components
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.columns import RATES
from surfkit.primitives.edit import apply
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints, View
from surfkit.testing import check, check_policy
from surfkit.train.trainer import Trainer

N = 400


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = Relocation in components(Densify).values()
    if not there:
        plugins().register(surfkit_mcmc, "mcmc of this test")
    yield
    if not there:
        plugins().unregister(surfkit_mcmc)


def crowd(primitive=None, dead: int = 60) -> tuple[Points, Step]:
    """Points of which the first are dead, and a step at which they move."""
    primitive, draw = primitive or Gaussian3D(sh_degree=1), torch.Generator().manual_seed(0)
    cloud = SparsePoints(torch.rand(N, 3, generator=draw), torch.zeros(N, 3, dtype=torch.uint8))
    params = primitive.init(cloud, draw)
    params["opacities"] = torch.linspace(-2, 3, N)
    params["opacities"][:dead] = -8
    step = Step(
        index=1_000, steps=30_000, seen=torch.ones(N, dtype=torch.bool), splats=primitive.activate(params, 1),
        grad_norm=torch.zeros(N), radii=torch.ones(N), image_px=100, views=None, rates={"means": 1e-4}, seed=7,
    )  # fmt: skip
    return Points.fresh(params), step


@pytest.mark.parametrize("n", [2, 3, 10, 51])
@pytest.mark.parametrize("opacity", [0.02, 0.5, 0.97])
def test_points_at_one_place_look_like_the_one_they_came_from(n, opacity):
    each, factor = (float(v) for v in shared(torch.tensor([opacity], dtype=torch.float64), torch.tensor([n]), 1e-9))
    assert 1 - (1 - each) ** n == pytest.approx(opacity, rel=1e-9), "at the centre"
    x = np.linspace(-12, 12, 20_001)
    one = opacity * np.exp(-(x**2) / 2)
    stack = 1 - (1 - each * np.exp(-((x / factor) ** 2) / 2)) ** n
    assert stack.sum() == pytest.approx(one.sum(), rel=1e-6), "and in sum along a line"


def test_one_point_stays_as_it_is_and_huge_numbers_stay_finite():
    each, factor = shared(torch.tensor([0.3, 0.9, 1.0]), torch.tensor([1, 10_000, 51]), 0.005)
    assert float(each[0]) == pytest.approx(0.3) and float(factor[0]) == 1
    assert torch.isfinite(each).all() and torch.isfinite(factor).all() and (factor > 0).all()


def test_draws_follow_the_weights():
    weights = torch.tensor([0.0, 1, 3, 0, 6])
    counts = drawn(weights, 100_000, torch.Generator().manual_seed(1))
    assert counts.sum() == 100_000 and counts[0] == counts[3] == 0
    assert torch.allclose(counts / 1e5, weights / 10, atol=0.01)


@pytest.mark.parametrize("primitive", [Gaussian3D(sh_degree=1), Surfel2D(sh_degree=1)])
def test_it_keeps_to_the_contract(primitive):
    points, step = crowd(primitive)
    check(Relocation(filters=(Elongation(),)))
    for policy in (Relocation(), Relocation(noise=0), Relocation(filters=(Elongation(0.5),))):
        check_policy(policy, points, step)
        check_policy(policy, points, replace(step, index=1_001))


def test_the_dead_move_and_a_few_more_come_up_to_the_cap():
    points, step = crowd()
    edit = Relocation().edit(points, step)
    assert edit.drop.sum() == 60 and edit.clone.sum() == 60 + 20, "a twentieth more"
    assert not edit.clone[:60].any() and torch.equal(edit.forget, edit.clone > 0)
    assert Relocation(cap=N + 5).edit(points, step).clone.sum() == 65
    assert Relocation(cap=N - 100).edit(points, step).clone.sum() == 60, "no point is taken away"
    opacity = torch.where(edit.opacities.isnan(), step.splats.opacities, edit.opacities)
    moved, number = edit.clone > 0, edit.clone + 1
    assert torch.allclose(1 - (1 - opacity[moved]) ** number[moved], step.splats.opacities[moved], atol=1e-4)
    assert (edit.scale_by[moved] < 1).all() and (edit.scale_by[~moved] == 1).all()


def test_a_move_is_carried_out_as_asked():
    points, step = crowd()
    after = apply(Gaussian3D(sh_degree=1), points, Relocation().edit(points, step), torch.Generator())
    assert len(after) == 1.05 * N and (after.params["opacities"].sigmoid() > 0.005).all(), "no dead point is left"
    capped = Relocation(cap=N).edit(points, step)
    assert len(apply(Gaussian3D(sh_degree=1), points, capped, torch.Generator())) == N


@pytest.mark.parametrize("logit", [-5.2, 25.0])
def test_points_nearly_dead_and_wholly_opaque_move_too(logit):
    primitive, (points, step) = Gaussian3D(sh_degree=1), crowd()
    points.params["opacities"][60:] = logit  # 0.0055, less than twice that of the dead; 1 in float32
    step = replace(step, splats=primitive.activate(points.params, 1))
    edit = Relocation(noise=0).edit(points, step)
    after = edit.opacities[edit.clone > 0]
    wanted, _ = shared(step.splats.opacities, edit.clone + 1, 0.00505)
    assert torch.allclose(after, wanted[edit.clone > 0], rtol=1e-4) and (after > 0.005).all()


def test_the_seed_of_the_step_decides():
    points, step = crowd()
    one, other = Relocation().edit(points, step), Relocation().edit(points, replace(step, seed=8))
    assert not torch.equal(one.clone, other.clone) and not torch.equal(one.move, other.move)


def test_steps_between_moves_only_add_noise():
    points, step = crowd()
    policy = Relocation(start=500, until=2_000, every=100)
    moves = [i for i in range(1, 3_000) if policy.edit(points, replace(step, index=i)).drop is not None]
    assert moves == list(range(600, 2_001, 100))
    assert Relocation(noise=0).edit(points, replace(step, index=1)) is None


def test_needles_are_not_moved_onto():
    points, step = crowd()
    scales = step.splats.scales.clone()
    scales[100:, 1:] *= 1e-3
    edit = Relocation(filters=(Elongation(),)).edit(points, replace(step, splats=replace(step.splats, scales=scales)))
    assert edit.clone[60:100].any() and not edit.clone[100:].any()


@pytest.mark.parametrize("steps", [20, 60, 100, 300, 2_000])
def test_points_move_in_runs_of_any_length_at_the_steps_that_are_foretold(steps):
    policy, (points, step) = replace(rescale(Relocation(), steps / 30_000), noise=0.0), crowd()
    moved = [i for i in range(1, steps + 1) if policy.edit(points, replace(step, index=i)) is not None]
    assert list(policy.edits(steps)) == moved and len(moved) >= 2


def test_without_a_live_point_nothing_moves():
    points, step = crowd(dead=N)
    edit = Relocation().edit(points, step)
    assert edit.drop is None and edit.clone is None


def test_noise_has_the_covariance_squared_and_stays_within_a_disc():
    points, step = crowd(Surfel2D(sh_degree=1))
    shape = step.splats
    turn = torch.tensor([0.5, 0.5, 0.5, 0.5]).expand(N, 4)  # x to y, y to z, z to x
    shape = replace(shape, quats=turn, scales=torch.tensor([0.1, 0.2]).expand(N, 2), opacities=torch.full((N,), 0.005))
    step = replace(step, splats=shape, index=1)
    noise = torch.cat([Relocation(noise=1e4).edit(points, replace(step, seed=seed)).move for seed in range(100)])
    assert not noise[:, 0].abs().max() > 1e-6, "none along the normal"
    deviation = 1e4 * 1e-4 * 0.5 * torch.tensor([0.01, 0.04])
    assert torch.allclose(noise[:, 1:].std(0), deviation, rtol=0.03)
    opaque = replace(step, splats=replace(shape, opacities=torch.full((N,), 0.5)))
    assert Relocation(noise=1e4).edit(points, opaque).move.abs().max() < 1e-6


@pytest.mark.parametrize("setting", [{"cap": 0}, {"every": 0}, {"dead": 0.0}, {"growth": -1.0}, {"noise": -1.0}])
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        Relocation(**setting)


def test_a_short_training_with_the_recipe():
    draw, rasterizer = torch.Generator().manual_seed(3), select("cpu")[0]
    recipe, views = surfkit_mcmc.surfkit_recipes()["mcmc"], []
    for x in (-0.1, 0.1):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3], pose[2, 3] = -x, 1.0
        views.append(View(f"{x}.png", Camera(pose, 40.0, 40.0, 16.0, 12.0, 32, 24), Path(f"{x}.png")))
    y, x = torch.meshgrid(torch.arange(24), torch.arange(32), indexing="ij")
    photo = (127 + 120 * torch.stack([torch.sin(x / 3), torch.sin(y / 4), torch.cos((x + y) / 5)])).to(torch.uint8)
    cloud = SparsePoints(0.6 * (torch.rand(50, 3, generator=draw) - 0.5), torch.full((50, 3), 127, dtype=torch.uint8))
    moves = Relocation(cap=120, start=10, until=150, every=10, growth=0.2)
    rates = RATES | {"means": LearningRate(1.6e-4)}
    stage = replace(recipe.pretrain, steps=160, densify=moves, rates=rates, sh_every=1_000)
    trainer = Trainer(stage, recipe.primitive, views, [photo, photo], rasterizer)
    state = trainer.begin(Points.fresh(recipe.primitive.init(cloud, draw)), draw)
    done = list(trainer.run(state))
    first, last = (sum(d.losses["l1"] for d in part) for part in (done[:20], done[-20:]))
    assert last < 0.8 * first and len(state.points) == 120
    assert max(d.points for d in done) == 120 and math.isfinite(last)
