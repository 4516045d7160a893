"""Trim, importance and opacity pruning against plain evaluations of their formulas."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.schedule import rescale
from surfkit.densify import ADC, PruneByImportance, PruneByOpacity, Trim
from surfkit.densify.base import Contribution
from surfkit.densify.prune import significance
from surfkit.densify.trim import lowest, released_score, summed
from surfkit.raster.api import Splats
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.train.view_order import ViewContributions

DRAW = torch.Generator().manual_seed(2)
AMOUNT = torch.rand(7, 200, generator=DRAW) * 30
COUNT = torch.randint(0, 40, (7, 200), generator=DRAW)
COUNT[:, :9] = 0  # never seen


class Seven:
    """Seven views of 200 points."""

    def __len__(self):
        return 7

    def each(self, alpha_power, transmittance_power):
        assert (alpha_power, transmittance_power) in ((1.0, 1.0), (0.0, 1.0))
        yield from zip(AMOUNT * (COUNT > 0) * (2 - alpha_power), COUNT, strict=True)

    def contributions(self, alpha_power=0.5, transmittance_power=0.5):
        each = AMOUNT / COUNT.clamp_min(1) * (COUNT > 0)
        return Contribution(each.mean(0), each.amax(0), COUNT.sum(0), (COUNT > 0).sum(0))


def at(crowd, index, since_reset=1_000):
    points, step = crowd
    return points, replace(step, index=index, since_reset=since_reset, views=Seven())


def dropped(policy, crowd, index, **other):
    edit = policy.edit(*at(crowd, index, **other))
    return None if edit is None else edit.drop


def test_the_lowest_share_goes_and_equal_scores_go_together():
    scores = torch.tensor([5.0, 1, 3, 1, 4, 2, 9, 8, 7, 6])
    assert lowest(scores, 0.3).nonzero().flatten().tolist() == [1, 3, 5]
    assert lowest(scores, 0.1).nonzero().flatten().tolist() == [1, 3], "both are as low as the lowest"
    assert not lowest(scores, 0.09).any() and not lowest(torch.zeros(0), 0.5).any()


def test_trim_drops_the_unseen_at_the_first_step_and_then_the_lowest_means(crowd):
    assert dropped(Trim(), crowd, 1).nonzero().flatten().tolist() == list(range(9))
    found = dropped(Trim(ratio=0.1, every=500), crowd, 1_001)
    mean = [
        np.mean([AMOUNT[v, n] / COUNT[v, n] if COUNT[v, n] else 0 for v in range(7)]) for n in range(200)
    ]  # fmt: skip
    assert set(found.nonzero().flatten().tolist()) == set(np.argsort(mean, kind="stable")[:20].tolist())


def test_trim_by_the_view_that_shows_a_point_best(crowd):
    found = dropped(Trim(ratio=0.1, every=500, score="peak"), crowd, 1_001)
    peak = [max(AMOUNT[v, n] / COUNT[v, n] if COUNT[v, n] else 0 for v in range(7)) for n in range(200)]
    assert set(found.nonzero().flatten().tolist()) == set(np.argsort(peak, kind="stable")[:20].tolist())


def test_trims_end_epochs_and_leave_reset_points_alone(crowd):
    policy = Trim(start=1_000, until=3_000, every=500)
    assert [i for i in range(2, 5_000) if dropped(policy, crowd, i) is not None] == [1001, 1505, 2009, 2513]
    assert dropped(policy, crowd, 1001, since_reset=499) is None
    assert dropped(policy, crowd, 1001, since_reset=500) is not None
    every = replace(policy, every=3)
    assert [i for i in range(2, 1_020) if dropped(every, crowd, i) is not None] == [1001, 1008, 1015]
    short = rescale(Trim(), 2_000 / 30_000)
    assert (short.start, short.until, short.every, short.recovery) == (800, 1_000, 500, 100)


def test_trims_at_given_steps_whatever_an_epoch_is(crowd):
    policy = Trim(start=1_000, until=3_000, every=500, whole_epochs=False, recovery=0)
    assert [i for i in range(2, 5_000) if dropped(policy, crowd, i, since_reset=0) is not None] == [
        1000, 1500, 2000, 2500, 3000,
    ]  # fmt: skip


@pytest.mark.parametrize(
    "policy",
    [
        Trim(start=1_000, until=2_000, every=300),
        PruneByImportance(at=(0, 7, 1_200, 9_000)),
        PruneByOpacity(start=500, until=1_100, every=100),
        PruneByImportance(at=(9_000,)),
        Trim(until=900),
    ],
)
@pytest.mark.parametrize("steps", [900, 1_500])
def test_steps_that_remove_points_are_foretold(crowd, policy, steps):
    unseen = isinstance(policy, Trim)  # which drops, at the first step, what no view sees
    found = [i for i in range(1 + unseen, steps + 1) if dropped(policy, crowd, i) is not None]
    assert list(policy.edits(steps, 7)) == found


def schedule(recipe_steps, epoch):
    """Steps that add points and steps that trim, of a run of so many steps with so many views."""
    adc, trim = (rescale(policy, recipe_steps / 30_000) for policy in (ADC(), Trim()))
    edits, trims, reset = list(adc.edits(recipe_steps)), [], 0
    for index in range(2, recipe_steps + 1):
        if trim.is_due(index, index - reset, epoch):
            trims.append(index)
        if index % adc.reset_every == 0 and index < adc.until:
            reset = index
    return edits, trims


def test_a_trim_that_falls_into_a_recovery_is_put_off_and_two_are_never_close():
    assert schedule(30_000, 3_001)[1] == [3_500, 6_500, 9_500, 12_500]
    assert schedule(30_000, 502)[1].count(3_500) == 0, "3,012 is left out, as 3,514 follows"
    epochs = {3_000: range(1, 1_400, 37), 4_000: range(1, 1_900, 53), 30_000: (1, 958, 3_124, 6_249, 9_499, 12_499)}
    for steps, epoch in ((steps, epoch) for steps, some in epochs.items() for epoch in some):
        trims = schedule(steps, epoch)[1]
        assert trims or not rescale(Trim(), steps / 30_000).edits(steps, epoch), f"{steps} steps with {epoch} views"
        assert all(b - a >= 500 for a, b in pairwise(trims))


@pytest.mark.parametrize("epoch", [1, 7, 21, 24, 45, 70, 100])
@pytest.mark.parametrize("steps", [2_000, 3_000, 4_000, 7_000, 30_000])
def test_trims_and_edits_keep_their_ratio_at_any_length(steps, epoch):
    edits, trims = schedule(steps, epoch)
    assert 4.5 <= len(edits) / len(trims) <= 8, "144 edits and 22 to 29 trims at full length"
    assert trims[0] >= edits[3]


def test_no_trim_comes_before_the_second_edit():
    for steps in range(20, 3_000, 7):
        edits, trims = schedule(steps, 1)
        assert len(trims) * 5 <= len(edits) and (not trims or trims[0] >= edits[3]), steps


def test_the_released_score_is_the_mean_of_its_list_of_records():
    expected = []
    for n in range(200):
        values = [float(AMOUNT[v, n]) / (int(COUNT[v, n]) + 1e-6) if COUNT[v, n] else 0.0 for v in range(7)]
        top = [values[0]] * 5
        for value in values[1:]:
            if value > top[0]:
                top = [value, value, top[1], top[2], top[3]]
        expected.append(sum(top) / 5)
    assert torch.allclose(released_score(Seven()), torch.tensor(expected), rtol=1e-5)
    late = torch.tensor([0.0, 0, 8])

    class Late(Seven):
        def each(self, *powers):
            yield from ((value[None], torch.tensor([1])) for value in late)

    assert float(released_score(Late())) == pytest.approx(0.4 * 8, rel=1e-4), "seen in the last view alone"


def test_trim_by_the_released_score(crowd):
    found = dropped(Trim(ratio=0.25, score="released"), crowd, 1001)
    order = released_score(Seven()).argsort()
    assert set(found.nonzero().flatten().tolist()) == set(order[:50].tolist())


def discs():
    """White discs, apart, half of them behind black ones, and three cameras that see 12, 12 and 6 of them."""
    at = torch.tensor([(0.5 * (i % 4) - 0.75, 0.5 * (i // 4) - 0.5, 2.0) for i in range(12)])
    veils = at[6:] - torch.tensor([0.0, 0, 0.5])
    sizes = torch.cat([torch.linspace(0.03, 0.07, 12).roll(5), torch.full((6,), 0.2)])
    opacities = torch.cat([torch.linspace(0.1, 0.9, 12).flip(0).roll(2), torch.linspace(0.3, 0.9, 6)])
    colors = torch.cat([torch.full((12, 1, 3), 0.5), torch.full((6, 1, 3), -0.5)]) / 0.28209479
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(18, 1)
    splats = Splats("surfel", torch.cat([at, veils]), quats, sizes[:, None].repeat(1, 2), opacities, colors)
    cameras = []
    for back, middle in ((0.0, 100.0), (0.3, 100.0), (0.0, 0.0)):
        pose = torch.eye(4, dtype=torch.float64)
        pose[2, 3] = back
        cameras.append(Camera(pose, 150.0, 150.0, middle, 75.0, 200, 150))
    return splats, cameras


def test_the_sum_is_the_change_of_the_pictures_when_a_point_is_removed():
    splats, cameras = discs()
    rasterizer, _ = select("cpu")

    def pictures(keep):
        some = replace(splats, **{name: value[keep] for name, value in splats.tensors().items()})
        return torch.stack([rasterizer.render(some, camera, 0.01, False).maps.color for camera in cameras]).double()

    everything, whole = torch.ones(18, dtype=torch.bool), pictures(torch.ones(18, dtype=torch.bool))
    change = []
    for removed in range(12):
        keep = everything.clone()
        keep[removed] = False
        change.append(float((whole - pictures(keep)).abs().sum()) / 3)
    views = ViewContributions(
        [View(str(i), camera, None) for i, camera in enumerate(cameras)], rasterizer, splats, 0.01
    )
    found = summed(views)[:12]
    assert found.tolist() == pytest.approx(change, rel=1e-4)
    tally = views.contributions()
    assert torch.equal(found.argsort(), torch.tensor(change).argsort())
    for other in (tally.mean, tally.peak):
        assert not torch.equal(other[:12].argsort(), found.argsort()), "no other score tells"


def test_the_sum_of_a_disc_is_the_integral_of_its_kernel():
    """2 pi sigma^2 (o - 1/255), with sigma in pixels: the tail below 1/255 is not drawn."""
    splats, cameras = discs()
    bare = replace(splats, **{name: value[:12] for name, value in splats.tensors().items()})
    views = ViewContributions([View("0", cameras[0], None)], select("cpu")[0], bare, 0.01)
    sigma = 150 / 2 * bare.scales[:, 0]
    wanted = 2 * math.pi * sigma**2 * (bare.opacities - 1 / 255)
    assert torch.allclose(summed(views), wanted, rtol=0.02)


def test_trim_by_the_sum(crowd):
    found = dropped(Trim(ratio=0.25, score="sum"), crowd, 1001)
    total = [sum(float(AMOUNT[v, n]) for v in range(7) if COUNT[v, n]) for n in range(200)]
    assert set(found.nonzero().flatten().tolist()) == set(np.argsort(total, kind="stable")[:50].tolist())


def test_importance_is_opacity_times_hits_times_a_power_of_the_area(crowd):
    points, step = at(crowd, 15_000)
    opacities, scales = step.splats.opacities.double().numpy(), step.splats.scales.double().numpy()
    area = scales[:, 0] * scales[:, 1]
    score = COUNT.sum(0).numpy() * opacities * (area / np.sort(area)[::-1][180]) ** 0.1
    drop = PruneByImportance(ratio=0.3).edit(points, step).drop
    assert set(drop.nonzero().flatten().tolist()) == set(np.argsort(score, kind="stable")[:60].tolist())
    assert PruneByImportance().edit(points, replace(step, index=15_001)) is None
    assert rescale(PruneByImportance(at=(9_000, 15_000)), 0.1).at == (900, 1_500)


def test_significance_is_opacity_times_transmittance_times_a_power_of_the_clipped_area(crowd):
    points, step = at(crowd, 15_000)
    opacities, scales = step.splats.opacities.double().numpy(), step.splats.scales.double().numpy()
    area = scales[:, 0] * scales[:, 1]
    share = [min(a / np.sort(area)[180], 1.0) for a in area]
    shown = (2 * AMOUNT * (COUNT > 0)).sum(0).double().numpy()
    score = [shown[n] * opacities[n] * share[n] ** 0.1 for n in range(200)]
    assert sum(value == 1 for value in share) == 20
    drop = PruneByImportance(ratio=0.3, score="significance").edit(points, step).drop
    assert set(drop.nonzero().flatten().tolist()) == set(np.argsort(score, kind="stable")[:60].tolist())
    assert np.allclose(significance(step.views, step.splats, 0.1), score, rtol=1e-5)


def test_significance_counts_a_pixel_by_what_the_points_before_it_let_through():
    splats, cameras = discs()
    rasterizer, _ = select("cpu")
    views = ViewContributions([View("0", cameras[0], None)], rasterizer, splats, 0.01)

    def alpha(first, last):
        some = splats.take(torch.arange(first, last))
        return rasterizer.render(some, cameras[0], 0.01, False).maps.alpha.double()

    volume = splats.scales.prod(-1).double()
    volume = (volume / volume.sort().values[16]).clamp_max(1)
    veiled = 1 - alpha(12, 18)
    found = significance(views, splats, 0.5)
    for n in range(12):
        shown = veiled[alpha(n, n + 1) > 0].sum()
        wanted = float(shown * splats.opacities[n] * volume[n].sqrt())
        assert float(found[n]) == pytest.approx(wanted, rel=1e-3), n


def test_faint_points_go_every_so_often(crowd):
    policy = PruneByOpacity(below=0.5, start=100, until=400, every=100, recovery=50)
    points, step = crowd
    faint = replace(step.splats, opacities=torch.linspace(0, 1, 200))
    steps = [i for i in range(1, 600) if policy.edit(points, replace(step, index=i, splats=faint))]
    assert steps == [200, 300, 400]
    drop = policy.edit(points, replace(step, index=200, splats=faint)).drop
    assert torch.equal(drop, faint.opacities < 0.5)
    assert policy.edit(points, replace(step, index=200, since_reset=49)) is None


@pytest.mark.parametrize(
    ("cls", "setting"),
    [(Trim, {"ratio": 1.0}), (Trim, {"gamma": -0.1}), (Trim, {"every": 0}), (PruneByImportance, {"ratio": -1}),
     (PruneByOpacity, {"every": 0})],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(cls, setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        cls(**setting)
