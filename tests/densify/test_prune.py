"""Trim, importance and opacity pruning against plain evaluations of their formulas."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.schedule import rescale
from surfkit.densify import Faint, Importance, Trim
from surfkit.densify.base import Tally
from surfkit.densify.trim import lowest, released_score

DRAW = torch.Generator().manual_seed(2)
AMOUNT = torch.rand(7, 200, generator=DRAW) * 30
COUNT = torch.randint(0, 40, (7, 200), generator=DRAW)
COUNT[:, :9] = 0  # never seen


class Seven:
    """Seven views of 200 points."""

    def __len__(self):
        return 7

    def each(self, alpha_power, transmittance_power):
        assert (alpha_power, transmittance_power) == (1.0, 1.0)
        yield from zip(AMOUNT * (COUNT > 0), COUNT, strict=True)

    def survey(self, alpha_power=0.5, transmittance_power=0.5):
        each = AMOUNT / COUNT.clamp_min(1) * (COUNT > 0)
        return Tally(each.mean(0), each.amax(0), COUNT.sum(0), (COUNT > 0).sum(0))


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
    found = dropped(Trim(ratio=0.1, every=500), crowd, 504 * 2)
    mean = [
        np.mean([AMOUNT[v, n] / COUNT[v, n] if COUNT[v, n] else 0 for v in range(7)]) for n in range(200)
    ]  # fmt: skip
    assert set(found.nonzero().flatten().tolist()) == set(np.argsort(mean, kind="stable")[:20].tolist())


def test_trim_by_the_view_that_shows_a_point_best(crowd):
    found = dropped(Trim(ratio=0.1, every=500, score="peak"), crowd, 504 * 2)
    peak = [max(AMOUNT[v, n] / COUNT[v, n] if COUNT[v, n] else 0 for v in range(7)) for n in range(200)]
    assert set(found.nonzero().flatten().tolist()) == set(np.argsort(peak, kind="stable")[:20].tolist())


def test_trims_end_epochs_and_leave_reset_points_alone(crowd):
    policy = Trim(start=1_000, until=3_000, every=500)
    assert [i for i in range(2, 5_000) if dropped(policy, crowd, i) is not None] == [1008, 1512, 2016, 2520]
    assert dropped(policy, crowd, 1008, since_reset=499) is None
    assert dropped(policy, crowd, 1008, since_reset=500) is not None
    every = replace(policy, every=3)
    assert [i for i in range(2, 1_020) if dropped(every, crowd, i) is not None] == [1001, 1008, 1015]
    short = rescale(Trim(), 2_000 / 30_000)
    assert (short.start, short.until, short.every, short.recovery) == (67, 1_000, 100, 100)


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
    found = dropped(Trim(ratio=0.25, score="released"), crowd, 1008)
    order = released_score(Seven()).argsort()
    assert set(found.nonzero().flatten().tolist()) == set(order[:50].tolist())


def test_importance_is_opacity_times_hits_times_a_power_of_the_area(crowd):
    points, step = at(crowd, 15_000)
    opacities, scales = step.shape.opacities.double().numpy(), step.shape.scales.double().numpy()
    area = scales[:, 0] * scales[:, 1]
    score = COUNT.sum(0).numpy() * opacities * (area / np.sort(area)[::-1][180]) ** 0.1
    drop = Importance(ratio=0.3).edit(points, step).drop
    assert set(drop.nonzero().flatten().tolist()) == set(np.argsort(score, kind="stable")[:60].tolist())
    assert Importance().edit(points, replace(step, index=15_001)) is None
    assert rescale(Importance(at=(9_000, 15_000)), 0.1).at == (900, 1_500)


def test_faint_points_go_every_so_often(crowd):
    policy = Faint(below=0.5, start=100, until=400, every=100, recovery=50)
    points, step = crowd
    faint = replace(step.shape, opacities=torch.linspace(0, 1, 200))
    steps = [i for i in range(1, 600) if policy.edit(points, replace(step, index=i, shape=faint))]
    assert steps == [200, 300, 400]
    drop = policy.edit(points, replace(step, index=200, shape=faint)).drop
    assert torch.equal(drop, faint.opacities < 0.5)
    assert policy.edit(points, replace(step, index=200, since_reset=49)) is None


@pytest.mark.parametrize(
    ("cls", "setting"),
    [(Trim, {"ratio": 1.0}), (Trim, {"gamma": -0.1}), (Trim, {"every": 0}), (Importance, {"ratio": -1}),
     (Faint, {"every": 0})],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(cls, setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        cls(**setting)
