"""The curve of the number of points, the draws, and the score against sums that are written out."""

from dataclasses import replace

import pytest
import surfkit_densify
import torch
from surfkit_densify.budget import FIRST_STAT, SCORE_STAT, WEIGHTS, Budget, drawn, relative, score_of

from surfkit.core.registry import plugins
from surfkit.plugin import ADC, BadInput, Densify, ViewStatistics, components, ssim_map
from surfkit.testing import check, check_policy
from surfkit.testing.inputs import crowd

DUE = 1_000


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = Budget in components(Densify).values()
    if not there:
        plugins().register(surfkit_densify, "densify of this test")
    yield
    if not there:
        plugins().unregister(surfkit_densify)


def watched(policy: Budget, index: int = DUE):
    """Points and a step with the statistics that lead to an edit after it."""
    points, step = crowd()
    points.stats.clear()
    for at in (1, *range(index - 9, index + 1)):
        policy.watch(points, replace(step, index=at))
    return points, replace(step, index=index)


def test_it_keeps_to_the_contract():
    check(Budget())
    check_policy(Budget(), *crowd())


def test_the_curve_goes_from_the_first_number_to_the_budget_steep_at_first_and_flat_at_the_end():
    policy, n, first = Budget(budget=101_000), 100, 1_000
    curve = [policy.target(first, x, n) for x in range(n + 1)]
    assert curve[0] == first and curve[-1] == 101_000 and curve == sorted(curve)
    a, k = -(101_000 - first) / n**2, 2 * (101_000 - first) / n
    assert all(abs(curve[x] - (first + k * x + a * x**2)) <= 0.5 for x in range(n + 1))
    steps = [b - a for a, b in zip(curve, curve[1:], strict=False)]
    assert steps[0] == pytest.approx(2 * 100_000 / n, rel=0.01) and steps[-1] == pytest.approx(10, abs=1)
    assert Budget(budget=500).target(first, 3, n) == 500, "no point is added where there are more"


def test_the_budget_is_shared_in_proportion_and_kept():
    policy = Budget(budget=100_000)
    points, step = watched(policy)
    wanted, events = ADC().edit(points, step), ADC().edits(step.steps)
    clones, splits = (int((mask & ~wanted.drop).sum()) for mask in (wanted.clone, wanted.split))
    kept = int((~wanted.drop).sum())
    everything = policy.edit(points, step)
    assert int(everything.clone.sum()) == clones and int(everything.split.sum()) == splits > 20, "no more are named"
    share = (events.index(DUE) + 1) / len(events)
    budget = 200 + round((kept + 10 - 200) / (2 * share - share**2))  # so that there is room for 10
    edit = Budget(budget=budget).edit(points, step)
    assert points.stat(FIRST_STAT).eq(200).all()
    assert int(edit.clone.sum() + edit.split.sum()) in (9, 10, 11)
    assert abs(int(edit.clone.sum()) - 10 * clones / (clones + splits)) <= 1
    assert not (edit.clone & ~wanted.clone).any() and not (edit.split & ~wanted.split).any()


def test_draws_repeat_with_the_seed_and_follow_the_weights():
    weights, among = torch.tensor([0.0, 1, 3, 50, 6, 0]), torch.tensor([True, True, True, False, True, False])

    def once(seed, count=1):
        return drawn(weights, among, count, torch.Generator().manual_seed(seed))

    assert torch.equal(once(4), once(4)) and any(not torch.equal(once(4), once(seed)) for seed in range(5, 20))
    counts = torch.stack([once(seed) for seed in range(20_000)]).double().mean(0)
    assert torch.allclose(counts, torch.tensor([0, 0.1, 0.3, 0, 0.6, 0], dtype=torch.float64), atol=0.015)
    two = torch.stack([once(seed, 2) for seed in range(20_000)]).double().mean(0)
    second = 0.1 * 3 / 9 + 0.6 * 3 / 4  # without replacement
    assert abs(float(two[2]) - (0.3 + second)) < 0.015
    assert once(1, 4).equal(among) and not once(1, 3)[0], "those of weight 0 come last, and others never"


def test_a_step_decides_by_its_seed():
    points, step = watched(Budget())
    narrow = Budget(budget=400)
    one, same, other = (narrow.edit(points, replace(step, seed=seed)) for seed in (1, 1, 2))
    assert torch.equal(one.split, same.split) and not torch.equal(one.split, other.split)


def test_the_score_is_the_loss_of_the_view_times_the_terms():
    _, step = crowd()
    view, splats, found = step.view, step.splats, torch.zeros(200, dtype=torch.float64)
    l1, ssim = (view.color - view.photo).abs().mean(), ssim_map(view.color, view.photo).mean()
    grey = view.photo.mean(0)
    across, down = torch.zeros_like(grey), torch.zeros_like(grey)
    across[:, 1:-1] = (grey[:, 2:] - grey[:, :-2]) / 2
    across[:, 0], across[:, -1] = grey[:, 1] - grey[:, 0], grey[:, -1] - grey[:, -2]
    down[1:-1] = (grey[2:] - grey[:-2]) / 2
    down[0], down[-1] = grey[1] - grey[0], grey[-1] - grey[-2]
    pixels = 50 * (view.color - view.photo).abs().mean(0) + 50 * (across**2 + down**2).sqrt()
    terms = [(25, step.grad_norm), (100, splats.opacities), (10, step.radii), (25, splats.scales.prod(1))]
    for weight, value in [*terms, (50, view.blended(pixels))]:
        found += weight * step.seen * value / value[step.seen & (value > 0)].median()
    wanted = (50 * (0.8 * l1 + 0.2 * (1 - ssim)) * found).float()
    score = score_of(step, view)
    assert torch.allclose(score, wanted, rtol=1e-4) and not score[~step.seen].any() and len(WEIGHTS) == 5
    assert torch.equal(relative(torch.zeros(3)), torch.zeros(3))
    rows = torch.arange(0, 200, 3)
    some = ViewStatistics(rows, step.seen[rows], step.grad_norm[rows], step.radii[rows], step.signed_norm[rows])
    half = replace(step, in_view=some, view=replace(view, blended=lambda values: view.blended(values)[rows]))
    assert score_of(half, half.view).shape == rows.shape


def test_the_score_is_that_of_the_last_views_before_an_edit():
    points, step = crowd()
    policy, one = Budget(), score_of(step, step.view)
    for index in range(1, 991):
        policy.watch(points, replace(step, index=index))
    before = points.stat(SCORE_STAT).clone()
    policy.watch(points, replace(step, index=991))
    assert torch.equal(points.stat(SCORE_STAT), one) and not torch.equal(before, one)
    for index in range(992, 1_001):
        policy.watch(points, replace(step, index=index))
    assert torch.allclose(points.stat(SCORE_STAT), 10 * one, rtol=1e-4)
    with pytest.raises(BadInput, match="without `view`"):
        policy.watch(points, replace(step, index=995, view=None))


@pytest.mark.parametrize("setting", [{"budget": 0}, {"views": 0}])
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        Budget(**setting)
