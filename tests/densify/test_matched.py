"""Densification by the signed and the absolute gradient (GOF), against quantiles as the paper has them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.densify import ADC, AbsGradient, CountCap, LossGradient, MatchedADC, PointCap
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.edit import Edit, apply, merge
from surfkit.primitives.points import Points
from surfkit.runs.recipe import Recipe
from surfkit.scene.scene import SparsePoints
from surfkit.testing import check
from surfkit.testing.inputs import crowd
from surfkit.train.stage import Stage

N = 400
POLICY = MatchedADC(ADC(start=0, every=10, until=1_000, cull_opacity=0.05))


def watched(policy, seed: int = 0):
    """Points and the last of ten steps in which every point was seen in some, and the mean gradients."""
    points, step = crowd(N)
    draw = torch.Generator().manual_seed(seed)
    signed, absolute, views = np.zeros(N), np.zeros(N), np.zeros(N)
    for index in range(11, 21):
        seen = (torch.rand(N, generator=draw) > 0.3) | (index == 11)
        one = 3e-4 * torch.rand(N, generator=draw) ** 2 * seen
        other = one + 3e-3 * torch.rand(N, generator=draw) ** 4 * seen
        signed, absolute, views = signed + one.numpy(), absolute + other.numpy(), views + seen.numpy()
        step = replace(step, index=index, seen=seen, grad_norm=other, signed_norm=one)
        policy.watch(points, step)
    return points, step, signed / views, absolute / views


def test_it_keeps_to_the_contract():
    check(MatchedADC())
    check(MatchedADC(ADC(filters=(CountCap(220),))))


def test_as_many_points_by_the_absolute_gradient_as_by_the_signed_one():
    policy = replace(POLICY, adc=replace(POLICY.adc, threshold=8e-5))
    points, step, signed, absolute = watched(policy)
    edit = policy.edit(points, step)
    share = (signed >= 8e-5).mean()
    assert 0.1 < share < 0.9
    hot = (signed >= 8e-5) | (absolute >= np.quantile(absolute, 1 - share))
    assert ((signed < 8e-5) & hot).sum() > 10, "some come by the absolute gradient alone"
    assert np.array_equal((edit.clone | edit.split).numpy(), hot)
    small = step.splats.scales.amax(1) <= 0.01
    assert torch.equal(edit.clone, small & torch.from_numpy(hot)) and torch.equal(edit.scatter, edit.clone)
    assert torch.equal(edit.drop, step.splats.opacities < 0.05)


def test_without_a_high_signed_gradient_none_is_densified():
    points, step, _, _ = watched(POLICY)
    policy = replace(POLICY, adc=replace(POLICY.adc, threshold=1.0))
    edit = policy.edit(points, step)
    assert not edit.clone.any() and not edit.split.any()


def test_a_limit_prefers_the_points_farthest_above_a_threshold():
    policy = replace(POLICY, adc=replace(POLICY.adc, threshold=8e-5))
    points, step, signed, absolute = watched(policy)
    points.stat("adc/grad")[:3] *= 100  # far above the one threshold, and not above the other
    signed[:3] *= 100
    few = policy.limited(N + 7)
    edit = few.edit(points, step)
    added = (edit.clone | edit.split).numpy()
    assert added.sum() == 7 and few.most_points == N + 7
    least = np.sort(absolute)[-(signed >= 8e-5).sum()]
    want = np.maximum(signed / 8e-5, absolute / least)
    assert set(np.flatnonzero(added)) == set(np.argsort(-want)[:7])


def test_windows_begin_anew_after_an_edit_and_opacities_are_reset():
    points, step, _, _ = watched(POLICY)
    nothing = torch.zeros(N)
    POLICY.watch(points, replace(step, index=21, grad_norm=nothing, signed_norm=nothing))
    assert not any(value.any() for name, value in points.stats.items() if name != "adc/seen")
    policy = replace(POLICY, adc=replace(POLICY.adc, reset_every=20))
    assert policy.edit(points, step).max_opacity == 0.01 and POLICY.edit(points, step).max_opacity is None
    assert policy.edits(100) == policy.adc.edits(100)


def test_it_needs_a_signal_of_absolute_gradients():
    fit = Recipe(primitive=Gaussian3D(), pretrain=Stage(densify=MatchedADC(), signal=AbsGradient()))
    fit.refuse_unfit()
    for densify in (MatchedADC(), PointCap(MatchedADC())):
        with pytest.raises(BadInput, match="pretrain.densify: .*absolute.*loss-gradient"):
            replace(fit, pretrain=Stage(densify=densify, signal=LossGradient())).refuse_unfit()


@pytest.mark.parametrize("primitive", [Gaussian3D(sh_degree=0), Surfel2D(sh_degree=0)])
def test_scattered_copies_are_distributed_as_the_point_is(primitive):
    params = primitive.init(SparsePoints(torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.uint8)), torch.Generator())
    width = params["scales"].shape[1]
    params["scales"] = torch.tensor([0.3, 0.1, 0.02])[:width].log().repeat(2, 1)
    params["quats"] = torch.tensor([[0.8, 0.2, -0.4, 0.4], [1.0, 0, 0, 0]])
    points = Points.fresh(params)
    edit = Edit(clone=torch.tensor([20_000, 2]), scatter=torch.tensor([True, False]))
    after = apply(primitive, points, edit, torch.Generator().manual_seed(0))
    places = after.params["means"][2:20_002].double()
    assert torch.equal(after.params["means"][:2], params["means"]) and not after.params["means"][20_002:].any()
    w, x, y, z = (float(v) for v in params["quats"][0])
    turn = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        dtype=torch.float64,
    )
    axes = turn[:, :width] * torch.tensor([0.3, 0.1, 0.02], dtype=torch.float64)[:width]
    assert torch.allclose(places.mean(0), torch.zeros(3, dtype=torch.float64), atol=0.008)
    assert torch.allclose(places.T @ places / 20_000, axes @ axes.T, atol=2e-3)
    assert torch.equal(after.params["scales"], params["scales"][:1].expand(20_004, -1)), "and no smaller"


def test_merged_edits_scatter_what_one_of_them_does():
    one, two = torch.tensor([True, False]), torch.tensor([False, True])
    assert merge([Edit(clone=one, scatter=one), Edit(clone=two)]).scatter.tolist() == [True, False]


def test_a_split_threshold_would_have_no_effect():
    with pytest.raises(BadInput, match="split_threshold is 0.0004; matched-adc"):
        MatchedADC(adc=ADC(split_threshold=4e-4))
