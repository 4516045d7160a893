import math
from dataclasses import dataclass, replace

import pytest
import torch

from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.core.registry import components
from surfkit.core.schedule import rescale
from surfkit.densify import ADC, CountCap, Elongation, LossGradient
from surfkit.densify.base import ComparedView, Contribution, Densify, Filter, Policy, Signal, Step
from surfkit.primitives import Flat3D, Gaussian3D
from surfkit.primitives.points import Points
from surfkit.raster.api import Splats
from surfkit.scene.scene import SparsePoints
from surfkit.testing import check_policy
from surfkit.train.stage import Stage


class Everything:
    """Answers as training views would."""

    def __len__(self) -> int:
        return 10

    def contributions(self, alpha_power: float = 0.5, transmittance_power: float = 0.5) -> Contribution:
        return Contribution(
            torch.arange(N) / N, torch.arange(N) / N, torch.full((N,), 100), torch.ones(N, dtype=torch.int64)
        )


N = 60
SIZES = torch.linspace(0.001, 0.2, N)
OPACITIES = torch.linspace(0.001, 0.9, N).flip(0)


def scene() -> Points:
    return Points.fresh({"means": torch.zeros(N, 3), "scales": torch.zeros(N, 2), "opacities": torch.zeros(N)})


def compared() -> ComparedView:
    draw = torch.Generator().manual_seed(1)
    color, photo = (torch.rand(3, 12, 16, generator=draw) for _ in range(2))
    return ComparedView(color, photo, lambda values: torch.full((N,), float(values.sum())))


def step(index: int, **other) -> Step:
    splats = Splats(
        "surfel", *[torch.zeros(N, k) for k in (3, 4)], SIZES[:, None].repeat(1, 2), OPACITIES, torch.zeros(N, 1, 3)
    )
    facts = dict(
        index=index, steps=30_000, seen=torch.ones(N, dtype=torch.bool), splats=splats,
        grad_norm=torch.full((N,), 1e-3), signed_norm=torch.full((N,), 1e-3),
        radii=torch.ones(N), image_px=100, views=Everything(), since_reset=1_000, rates={"means": 1e-4}, seed=index,
        view=compared(),
    )  # fmt: skip
    return Step(**(facts | other))


def watched(policy: ADC, points: Points, steps, **other):
    edit = None
    for index in steps:
        policy.watch(points, step(index, **other))
        edit = policy.edit(points, step(index, **other))
    return edit


@pytest.mark.parametrize("name", components(Policy))
def test_contract_of_every_policy(name):
    policy, points = components(Policy)[name](), scene()
    try:
        policy.watch(scene(), step(1))
    except BadInput as refusal:
        pytest.skip(f"{refusal} (its package checks it)")
    for index in (1, 599, 600, 3000, 3100, 29_999):
        check_policy(policy, points, step(index))


@pytest.mark.parametrize("base", [Densify, Signal])
def test_components_round_trip(base):
    for cls in components(base).values():
        assert load(base, dump(cls())) == cls()


def test_small_points_are_cloned_and_large_ones_split():
    edit = watched(ADC(), scene(), range(501, 601))
    assert torch.equal(edit.clone, SIZES <= 0.01) and torch.equal(edit.split, SIZES > 0.01)
    assert torch.equal(edit.drop, OPACITIES < 0.005) and edit.max_opacity is None


def test_the_gradient_is_averaged_over_the_views_that_saw_the_point():
    points, policy = scene(), ADC(threshold=1e-3)
    for index in range(501, 601):
        seen = torch.zeros(N, dtype=torch.bool)
        seen[0], seen[1] = index % 2 == 0, True  # both get 1e-3 in every second step; the other steps count for row 1
        grad = torch.zeros(N)
        grad[:2] = 1.01e-3 * (index % 2 == 0)
        policy.watch(points, step(index, seen=seen, grad_norm=grad))
    assert policy.edit(points, step(600)).clone.nonzero().flatten().tolist() == [0]


def test_edits_happen_between_start_and_until():
    policy = ADC(start=20, until=100, every=10, reset_every=1000)
    assert [i for i in range(1, 200) if watched(policy, scene(), [i])] == [30, 40, 50, 60, 70, 80, 90]


@pytest.mark.parametrize("policy", [ADC(start=20, until=100, every=10), ADC(start=25, until=101, every=10), ADC()])
@pytest.mark.parametrize("steps", [15, 60, 100, 700])
def test_the_steps_of_edits_are_known_beforehand(policy, steps):
    edited = [i for i in range(1, steps + 1) if (edit := watched(policy, scene(), [i])) and edit.clone is not None]
    assert list(policy.edits(steps)) == edited


@pytest.mark.parametrize("steps", [*range(20, 80), 100, 300, 500, 700, 1_000, 1_499])
def test_short_runs_have_some_edits(steps):
    assert len(rescale(ADC(), steps / 30_000).edits(steps)) >= 2


def test_the_first_window_begins_at_the_first_step_and_each_edit_begins_another():
    policy, points, counts = ADC(start=20, until=100, every=10), scene(), {}
    for index in range(1, 120):
        policy.watch(points, step(index))
        counts[index] = int(points.stat("adc/seen")[0])
    assert counts[1] == 1 and counts[20] == 20 and counts[30] == 30, "nothing is edited at 20, so nothing restarts"
    assert counts[31] == 1 and counts[40] == 10 and counts[41] == 1
    assert counts[119] == counts[99] == 9, "after the last edit nothing is counted"


def test_opacities_are_reset_every_so_often_while_densifying():
    policy = ADC(start=5, until=100, every=10, reset_every=30)
    caps = {i: edit.max_opacity for i in range(1, 200) if (edit := watched(policy, scene(), [i]))}
    assert [i for i, cap in caps.items() if cap is not None] == [30, 60, 90] and caps[30] == 0.01
    alone = watched(replace(policy, start=500), scene(), [30])
    assert alone.max_opacity == 0.01 and alone.drop is None


def test_faint_points_are_spared_while_they_recover_from_a_reset():
    policy = ADC(start=5, until=1000, every=10, reset_every=100, recovery=50, cull_scale=0)
    assert watched(policy, scene(), [100]).drop.any()
    assert [i for i in range(110, 200, 10) if watched(policy, scene(), [i]).drop.any()] == [150, 160, 170, 180, 190]


def test_huge_points_go_after_the_first_reset_unless_splitting_makes_them_fit():
    quiet = dict(grad_norm=torch.zeros(N))
    policy = ADC(cull_opacity=0)
    assert not watched(policy, scene(), [3000], **quiet).drop.any()
    assert torch.equal(watched(policy, scene(), [3100], **quiet).drop, SIZES > 0.1)
    assert torch.equal(watched(policy, scene(), [3100]).drop, SIZES / 1.6 > 0.1)
    assert not watched(replace(policy, cull_scale=0), scene(), [3100], **quiet).drop.any()


def test_a_split_threshold_clones_by_the_signed_gradient_and_splits_by_the_other():
    policy = ADC(threshold=2e-4, split_threshold=4e-4, small=0.1)
    small, every = SIZES <= 0.1, torch.arange(N)
    signed = torch.where(every % 2 == 0, 2.1e-4, 1.9e-4)
    absolute = torch.where(every % 3 == 0, 4.1e-4, 3.9e-4)
    edit = watched(policy, scene(), range(501, 601), grad_norm=absolute, signed_norm=signed)
    assert torch.equal(edit.clone, small & (every % 2 == 0)) and torch.equal(edit.split, ~small & (every % 3 == 0))
    points = scene()
    watched(policy, points, [600], signed_norm=torch.full((N,), 9.0))
    again = watched(policy, points, range(601, 701), grad_norm=absolute, signed_norm=signed)
    assert torch.equal(again.clone, edit.clone), "a new window"
    grown = torch.where(every == 0, 9e-4, signed), torch.where(every == 57, 9e-4, absolute)
    limited = policy.limited(N + 2)
    assert limited.needs_absolute and not ADC().needs_absolute
    room = watched(limited, scene(), [600], grad_norm=grown[1], signed_norm=grown[0])
    assert (room.clone | room.split).nonzero().flatten().tolist() == [0, 57], "in multiples of each threshold"


def test_a_split_threshold_needs_absolute_gradients():
    recipe = replace(recipes()["3dgs"], pretrain=Stage(densify=ADC(split_threshold=4e-4)))
    with pytest.raises(BadInput, match="pretrain.densify: adc .*signal:abs-gradient"):
        recipe.refuse_unfit()
    recipes()["absgs"].refuse_unfit()
    with pytest.raises(BadInput, match="densify.split_threshold is 0"):
        ADC(split_threshold=0.0)


def test_points_that_were_large_on_any_screen_since_the_last_edit_go():
    policy, points = ADC(cull_opacity=0, cull_scale=0, cull_screen=0.2), scene()
    radii = torch.zeros(N)
    radii[3], radii[4] = 21, 20
    policy.watch(points, step(3101, radii=radii))
    policy.watch(points, step(3102))
    assert policy.edit(points, step(3200)).drop.nonzero().flatten().tolist() == [3]
    policy.watch(points, step(3201))
    assert not policy.edit(points, step(3300)).drop.any(), "a new window"
    off = replace(policy, cull_screen=0.0)
    assert not watched(off, scene(), [3200], radii=torch.full((N,), 99.0)).drop.any()


@dataclass(frozen=True)
class SmallOnly(Filter):
    """Admits small points."""

    def admits(self, step, want):
        return step.splats.scales.amax(-1) < 0.05


def test_filters_narrow_what_multiplies_but_not_what_is_dropped():
    free, held = (watched(ADC(filters=f), scene(), range(501, 601)) for f in ((), (SmallOnly(),)))
    assert torch.equal(held.split, free.split & (SIZES < 0.05)) and held.split.any()
    assert torch.equal(held.clone, free.clone) and torch.equal(held.drop, free.drop)


def test_a_count_cap_takes_the_highest_gradients():
    grad = torch.linspace(1e-4, 1e-3, N)
    edit = watched(ADC(filters=(CountCap(N + 5),)), scene(), [600], grad_norm=grad)
    assert (edit.clone | edit.split).nonzero().flatten().tolist() == list(range(N - 5, N))
    full = watched(ADC(filters=(CountCap(N - 10),)), scene(), [600], grad_norm=grad)
    assert not (full.clone | full.split).any()
    both = watched(ADC(filters=(SmallOnly(), CountCap(N + 5))), scene(), [600], grad_norm=grad)
    small = (SIZES < 0.05).nonzero().flatten().tolist()
    assert (both.clone | both.split).nonzero().flatten().tolist() == small[-5:], "room goes to those admitted before"


def test_needles_do_not_multiply():
    scales = torch.full((N, 2), 0.05)
    scales[:, 1] = 0.05 * torch.linspace(0, 0.02, N)
    want = torch.ones(N)
    kept = Elongation(0.01).admits(replace(step(600), splats=replace(step(600).splats, scales=scales)), want)
    assert torch.equal(kept, scales[:, 1] / scales[:, 0] > 0.01) and kept.any() and not kept.all()


def test_flat_points_multiply_and_needles_of_three_axes_do_not():
    flat, ball, needle, blade = [0.05, 0.04, 1e-6], [0.05, 0.05, 0.05], [0.05, 1e-4, 1e-4], [1e-4, 1e-6, 0.05]
    shape = replace(step(600).splats, kind="gaussian", scales=torch.tensor([flat, ball, needle, blade]))
    kept = Elongation(0.01).admits(replace(step(600), splats=shape), torch.ones(4))
    assert kept.tolist() == [True, True, False, False]


@pytest.mark.parametrize("primitive", [Flat3D(), Gaussian3D()])
def test_every_primitive_multiplies_through_the_elongation_filter(primitive):
    draw = torch.Generator().manual_seed(0)
    cloud = SparsePoints(torch.rand(N, 3, generator=draw), torch.zeros(N, 3, dtype=torch.uint8))
    points = Points.fresh(primitive.init(cloud, draw))
    points.params["scales"][:, :2] = torch.tensor([0.05, 0.03]).log()
    if points.params["scales"].shape[1] == 3:
        points.params["scales"][:, 2] = math.log(1e-6)
    edit = watched(ADC(filters=(Elongation(),)), points, [600], splats=primitive.activate(points.params, 0))
    assert edit.split.all()


@pytest.mark.parametrize("setting", [dict(every=0), dict(reset_every=0), dict(reset_opacity=1.0)])
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        ADC(**setting)


def test_a_short_run_keeps_windows_and_resets_that_mean_something():
    short = rescale(ADC(), 1000 / 30_000)
    assert short.until == 500 and short.every >= 50 and short.start < short.until
    assert short.reset_every >= short.until, "a run this short never resets"
    middle = rescale(ADC(), 7000 / 30_000)
    assert (middle.until, middle.reset_every) == (3500, 700) and middle.recovery >= 100


def test_signal_of_all_losses_is_the_total():
    total = torch.randn(9, 2)
    assert LossGradient().combine(total, total) is total


def test_chosen_gradient_is_raised_to_a_share_of_the_total():
    total, chosen = torch.zeros(6, 2), torch.zeros(6, 2)
    total[:4, 0], chosen[:4, 1] = torch.tensor([3.0, 5, 1, 7]), torch.tensor([1.0, 1, 2, 0])  # rows 4, 5 are not seen
    raised = LossGradient(terms=("ssim",), boost=0.5).combine(chosen, total)
    assert torch.allclose(raised, chosen * 0.5 * (16 / 4) / (4 / 4))
    assert torch.equal(LossGradient(terms=("ssim",)).combine(chosen, total), chosen)


def test_chosen_gradient_is_never_lowered():
    chosen = torch.ones(4, 2)
    assert torch.equal(LossGradient(terms=("ssim",), boost=0.9).combine(chosen, chosen), chosen)


def test_no_point_seen_is_no_nan():
    zero = torch.zeros(4, 2)
    assert not LossGradient(terms=("ssim",), boost=0.9).combine(zero, zero).any()
    assert not LossGradient(terms=("ssim",), boost=0.9).combine(zero, torch.ones(4, 2)).any()


@pytest.mark.parametrize("setting", [dict(boost=-1.0), dict(terms=())])
def test_signals_that_make_no_sense_are_refused(setting):
    with pytest.raises(BadInput):
        LossGradient(**setting)
