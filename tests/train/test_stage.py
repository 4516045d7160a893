import sys
from dataclasses import dataclass, replace

import pytest
import torch

from surfkit.appearance import Exposure
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.core.events import PhotoSkipped
from surfkit.core.schedule import LearningRate
from surfkit.densify import ADC, AbsGradient, LossGradient, Trim
from surfkit.densify.base import Prune
from surfkit.losses.base import Regularizer
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.regularizers import MeanOpacity, MeanScale
from surfkit.losses.surface import NormalConsistency
from surfkit.primitives import Flat3D, Gaussian3D, Surfel2D
from surfkit.primitives.columns import RATES
from surfkit.primitives.edit import Edit
from surfkit.raster.psnr import psnr
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.faults import Diverged
from surfkit.train.stage import Stage

QUIET = Stage(steps=40, densify=None, sh_every=10)


def scored(trainer, state) -> float:
    """Mean PSNR over all views."""
    splats = trainer.primitive.activate(state.points.params, 0)
    return sum(
        psnr(trainer.rasterizer.render(splats, view.camera, 0.005, geometry=False).maps.color, photo.float() / 255)
        for view, photo in zip(trainer.views, trainer.photos, strict=True)
    ) / len(trainer.views)


@pytest.mark.parametrize("primitive", [Surfel2D(1), Gaussian3D(1), Flat3D(1)], ids=lambda part: type(part).__name__)
def test_training_raises_psnr(begin, primitive):
    trainer, state = begin(QUIET, primitive)
    before = scored(trainer, state)
    steps = list(trainer.run(state))
    assert [done.index for done in steps] == list(range(1, 41)) and state.index == 40
    assert scored(trainer, state) > before + 3
    assert state.seconds > 0 and state.cpu_seconds > 0


def test_one_step_moves_parameters_against_a_numerical_gradient(begin):
    stage = replace(
        QUIET, losses={"l1": L1(weight=0.8), "ssim": SSIM(weight=0.2)}, rates={k: LearningRate(1e-3) for k in RATES}
    )
    trainer, state = begin(stage)
    before = {name: value.clone() for name, value in state.points.params.items()}
    done = trainer.step(state)
    # colours, because the blend has no jumps in them
    slopes = state.points.exp_avg["sh0"] * 10  # the first step leaves a tenth of the gradient there

    def loss(way: float) -> float:
        params = before | {"sh0": before["sh0"] + way * slopes.sign()}
        maps = trainer.rasterizer.render(trainer.primitive.activate(params, 0), done.target.view.camera, 0.005).maps
        return float(0.8 * L1()(maps, done.target) + 0.2 * SSIM()(maps, done.target))

    assert float(slopes.abs().sum()) == pytest.approx((loss(0.01) - loss(-0.01)) / 0.02, rel=0.02)
    moved = state.points.params["sh0"] - before["sh0"]
    assert torch.allclose(moved, -1e-3 * slopes.sign(), atol=1e-6)


def test_a_step_needs_no_sympy(begin, monkeypatch):
    """torch imports it, for a second or more, where gradients are given to `torch.autograd.grad`."""
    monkeypatch.setitem(sys.modules, "torch.fx.experimental.symbolic_shapes", None)
    trainer, state = begin(replace(QUIET, regularizers={"opacity": MeanOpacity(weight=0.1)}))
    trainer.step(state)


def test_harmonics_grow_by_a_degree_every_so_often(begin):
    trainer, state = begin(replace(QUIET, steps=12, sh_every=5))
    grown = {done.index: bool(state.points.params["sh_rest"].any()) for done in trainer.run(state)}
    assert not grown[4] and grown[5]


class Recording:
    """A rasterizer that notes what it is asked for."""

    def __init__(self, inner):
        self.inner, self.geometry, self.backwards, self.absolute = inner, [], [], []
        self.where = inner.where

    def render(self, splats, camera, near, geometry=True, distortion=True):
        self.geometry.append(geometry)
        render, outer = self.inner.render(splats, camera, near, geometry, distortion), self

        class Noted:
            maps, seen, radii = render.maps, render.seen, render.radii

            def backward(self, total, chosen=None, absolute=False, rows=None):
                outer.backwards.append((total, chosen))
                outer.absolute.append(absolute)
                return render.backward(total, chosen, absolute, rows)

        return Noted()


def recorded(begin, stage, steps=None):
    trainer, state = begin(stage)
    notes = Recording(trainer.rasterizer)
    for _ in replace(trainer, rasterizer=notes).run(state):
        pass
    return notes


def test_geometry_is_made_only_while_a_loss_reads_it(begin):
    losses = {"l1": L1(), "normal": NormalConsistency(weight=0.05, start=3)}
    active = [losses["normal"].weight_at(i, 5) > 0 for i in range(1, 6)]
    assert recorded(begin, replace(QUIET, steps=5, losses=losses)).geometry == active and len(set(active)) == 2
    assert recorded(begin, replace(QUIET, steps=3)).geometry == [False] * 3


def test_one_backward_a_step_and_no_second_cotangent_unless_losses_are_chosen(begin):
    plain = recorded(begin, replace(QUIET, steps=3))
    assert [chosen for _, chosen in plain.backwards] == [None] * 3
    split = recorded(begin, replace(QUIET, steps=3, signal=LossGradient(terms=("ssim",))))
    only = recorded(begin, replace(QUIET, steps=3, losses={"ssim": SSIM()}))
    assert len(split.backwards) == 3
    (total, chosen), (alone, _), (whole, _) = split.backwards[0], only.backwards[0], plain.backwards[0]
    assert torch.allclose(chosen.color, alone.color, atol=1e-9) and chosen.color.any()
    assert torch.allclose(total.color, whole.color, atol=1e-9) and not torch.allclose(total.color, chosen.color)


def test_sizes_of_the_gradients_of_chosen_or_all_losses(begin):
    every = recorded(begin, replace(QUIET, steps=2, signal=AbsGradient()))
    assert every.absolute == [True] * 2 and all(chosen is total for total, chosen in every.backwards)
    some = recorded(begin, replace(QUIET, steps=2, signal=AbsGradient(terms=("ssim",))))
    assert some.absolute == [True] * 2 and not torch.equal(some.backwards[0][0].color, some.backwards[0][1].color)
    assert recorded(begin, replace(QUIET, steps=2)).absolute == [False] * 2


@dataclass(frozen=True)
class Notebook(Prune):
    """Notes what it is told."""

    def edit(self, points, step):
        NOTES.append((step.index, step.since_reset, step.seed, step.rates["means"]))
        return Edit(max_opacity=0.5) if step.index == 3 else None


NOTES: list[tuple] = []


def test_policies_are_told_of_resets_rates_and_a_seed(begin):
    NOTES.clear()
    trainer, state = begin(replace(QUIET, steps=6, prune=(Notebook(),)), seed=5)
    list(trainer.run(state))
    assert [note[1] for note in NOTES] == [1, 2, 3, 1, 2, 3], "told before the reset of the step itself is applied"
    assert len({note[2] for note in NOTES}) == 6 and all(0 <= note[2] < 2**63 for note in NOTES)
    assert NOTES[0][3] > NOTES[5][3] == pytest.approx(1.6e-6)


def test_regularizers_add_their_gradient_to_that_of_the_losses(begin):
    stage = replace(QUIET, steps=1, losses={"l1": L1(weight=0.0), "ssim": SSIM(weight=1e-9)})
    pull = {"opacity": MeanOpacity(weight=0.3), "size": MeanScale(weight=0.2)}
    trainer, state = begin(replace(stage, regularizers=pull))
    before = {name: value.clone() for name, value in state.points.params.items()}
    done = trainer.step(state)
    opacity, scales = before["opacities"].sigmoid(), before["scales"].exp()
    assert done.losses["opacity"] == pytest.approx(0.3 * float(opacity.mean()))
    assert done.losses["size"] == pytest.approx(0.2 * float(scales.mean()))
    found = {name: state.points.exp_avg[name] * 10 for name in ("opacities", "scales")}
    assert torch.allclose(found["opacities"], 0.3 * opacity * (1 - opacity) / len(opacity), rtol=1e-3, atol=1e-7)
    assert torch.allclose(found["scales"], 0.2 * scales / scales.numel(), rtol=1e-3, atol=1e-7)


@dataclass(frozen=True)
class SeenOpacity(MeanOpacity):
    only_seen = True

    def __call__(self, splats):
        return splats.opacities.sum() / 7


def test_a_regularizer_may_ask_for_the_points_of_the_view_alone(begin):
    stage = replace(QUIET, steps=1, losses={"l1": L1(weight=0.0), "ssim": SSIM(weight=1e-9)})
    trainer, state = begin(replace(stage, regularizers={"opacity": SeenOpacity(weight=0.3)}))
    state.points.params["means"][::3, 2] = -5.0  # behind every camera
    before = {name: value.clone() for name, value in state.points.params.items()}
    done = trainer.step(state)
    camera = done.target.view.camera
    seen = trainer.rasterizer.render(trainer.primitive.activate(before, 0), camera, stage.near, False).seen
    assert 0 < seen.sum() < len(seen)
    opacity = before["opacities"].sigmoid()
    assert done.losses["opacity"] == pytest.approx(0.3 * float(opacity[seen].sum()) / 7)
    found = state.points.exp_avg["opacities"] * 10
    assert torch.allclose(found, 0.3 * opacity * (1 - opacity) * seen / 7, rtol=1e-3, atol=1e-7)


@dataclass(frozen=True)
class Diary(Regularizer):
    """Writes down what it is told, and counts the steps in a column of its own."""

    @property
    def reads(self):
        return ("median",)

    def weight_at(self, index, steps):
        return 1.0 if index > 2 else 0.0

    def __call__(self, splats):
        raise AssertionError("a stage asks for the term in a step")

    def in_step(self, splats, given):
        count = given.stat("diary/steps")
        count += 1
        assert len(given.seen) == len(splats) and given.seen.any() and not given.maps.median.requires_grad
        DIARY.append((given.index, given.steps, given.target.view.name, given.target.seed, float(count.max())))
        return (count * splats.opacities).mean()


DIARY: list[tuple] = []


def test_regularizers_are_told_of_the_step_and_keep_columns(begin):
    DIARY.clear()
    trainer, state = begin(replace(QUIET, steps=5, regularizers={"diary": Diary()}, prune=(Notebook(),)))
    done = list(trainer.run(state))
    assert [entry[0] for entry in DIARY] == [3, 4, 5] and {entry[1] for entry in DIARY} == {5}
    assert [entry[2] for entry in DIARY] == [each.target.view.name for each in done[2:]]
    assert [entry[3] for entry in DIARY] == [each.target.seed for each in done[2:]]
    assert [entry[4] for entry in DIARY] == [1, 2, 3] and set(state.points.stat("diary/steps").tolist()) == {3.0}
    assert [each.maps.median is None for each in done] == [True, True, False, False, False], "drawn when it is read"
    assert ["diary" in each.losses for each in done] == [False, False, True, True, True]


def test_chosen_losses_that_are_not_yet_active_give_no_signal(begin):
    losses = {"l1": L1(), "normal": NormalConsistency(weight=0.05, start=100)}
    stage = replace(QUIET, steps=2, losses=losses, signal=LossGradient(terms=("normal",)), densify=ADC())
    trainer, state = begin(stage)
    list(trainer.run(state))
    assert not state.points.stat("adc/grad").any() and state.points.stat("adc/seen").any()


def test_densification_adds_points_with_the_rest_in_step(begin):
    stage = Stage(steps=30, densify=ADC(start=5, until=25, every=5, threshold=1e-6, reset_every=10))
    trainer, state = begin(stage)
    counts = [done.points for done in trainer.run(state)]
    assert counts[9] > counts[8] == 40 and counts[-1] > counts[9]
    points = state.points
    for group in (points.params, points.exp_avg, points.exp_avg_sq, points.stats):
        assert {len(value) for value in group.values()} == {counts[-1]}


@dataclass(frozen=True)
class DropAll(Prune):
    """Drops every point at step 2."""

    def edit(self, points, step):
        return Edit(drop=torch.ones(len(points), dtype=torch.bool)) if step.index == 2 else None


def test_a_run_without_points_stops(begin):
    trainer, state = begin(replace(QUIET, prune=(DropAll(),)))
    with pytest.raises(BadInput, match="step 2 .*every point; .*culls"):
        list(trainer.run(state))


@dataclass(frozen=True)
class Broken(L1):
    """Not a number."""

    def __call__(self, maps, sample):
        return maps.color.sum() * float("nan")


def test_a_loss_that_is_not_finite_names_step_and_view(begin):
    trainer, state = begin(replace(QUIET, losses={"l1": Broken()}))
    with pytest.raises(Diverged, match=r"step 1, view \d.png: the losses") as error:
        list(trainer.run(state))
    assert error.value.index == 1 and error.value.view in {view.name for view in trainer.views}


@dataclass(frozen=True)
class Spoiling(Prune):
    """Spoils the scale of a point at step 3."""

    def edit(self, points, step):
        if step.index == 3:
            points.params["scales"].data[5, 1] = float("inf")  # as a fault of numbers would: a part may not


def test_parameters_that_are_not_finite_name_step_and_view(begin):
    trainer, state = begin(replace(QUIET, prune=(Spoiling(),)))
    with pytest.raises(Diverged, match=r"step 3, view \d.png: the scales"):
        list(trainer.run(state))


def test_halved_rates_move_everything_half_as_far(begin):
    moved = []
    for halvings in (0, 1):
        trainer, state = begin(replace(QUIET, appearance=Exposure()))
        state.halvings = halvings
        start = {name: value.clone() for name, value in (state.points.params | state.appearances).items()}
        trainer.step(state)
        moved.append({name: (state.points.params | state.appearances)[name] - start[name] for name in start})
    for name in ("means", "sh0", "opacities", "value"):
        assert moved[0][name].any() and torch.allclose(moved[0][name], 2 * moved[1][name], atol=1e-6), name


class Damaged(list):
    """Photographs of which some cannot be read."""

    bad = frozenset({1, 4})

    def __getitem__(self, at):
        if at in self.bad:
            raise BadInput(f"{at}.png: not a whole picture")
        return super().__getitem__(at)


def test_damaged_photographs_are_passed_over_and_named_once(begin, monkeypatch):
    trainer, state = begin(replace(QUIET, steps=12))
    said = []
    monkeypatch.setattr("surfkit.train.next_view.emit", said.append)
    trainer = replace(trainer, photos=Damaged(trainer.photos))
    shown = [done.target.view.name for done in trainer.run(state)]
    assert sorted(state.skipped) == [1, 4] and len(shown) == 12
    assert {shown.count(name) for name in ("0.png", "2.png", "3.png", "5.png")} == {3}, "all others, evenly"
    assert [event.name for event in said if isinstance(event, PhotoSkipped)] in (["1.png", "4.png"], ["4.png", "1.png"])
    monkeypatch.setattr(Damaged, "bad", range(6))
    with pytest.raises(BadInput, match="6 photographs .*0.png for one"):
        list(replace(trainer, stage=replace(QUIET, steps=20)).run(state))


def test_the_degree_of_the_harmonics_never_falls(begin):
    trainer, state = begin(replace(QUIET, steps=6, sh_every=5))
    list(trainer.run(state))
    assert state.sh_degree == 1
    list(replace(trainer, stage=replace(QUIET, steps=8, sh_every=50)).run(state))
    assert state.sh_degree == 1


def test_stages_that_make_no_sense_are_refused(begin):
    with pytest.raises(BadInput, match="normal; the losses are l1, ssim"):
        Stage(signal=LossGradient(terms=("normal",)))
    with pytest.raises(BadInput, match="0 steps"):
        Stage(steps=0)
    with pytest.raises(BadInput, match="sh_every is 0"):
        Stage(sh_every=0)


def test_a_view_that_sees_nothing_changes_no_colour_and_gives_no_signal(begin):
    away = torch.eye(4, dtype=torch.float64)
    away[2, 3] = -50.0  # everything lies behind
    stage = replace(QUIET, steps=4, signal=LossGradient(terms=("ssim",), boost=0.9), densify=ADC(start=0, every=2))
    trainer, state = begin(replace(stage, appearance=Exposure()))
    views = tuple(replace(view, camera=replace(view.camera, world_to_camera=away)) for view in trainer.views)
    trainer, before = replace(trainer, views=views), state.points.params["sh0"].clone()
    done = trainer.step(state)
    assert not state.points.stat("adc/seen").any() and not done.maps.alpha.any()
    assert len(state.points) == 40 and torch.equal(state.points.params["sh0"], before)
    trimmed = replace(trainer, stage=replace(stage, prune=(Trim(),)))
    with pytest.raises(BadInput, match="step 1 would drop every point"):  # unseen by all views, all of them
        trimmed.step(trimmed.begin(state.points, torch.Generator()))


@pytest.mark.parametrize(("update", "optimizer"), [("in-view", AdamInView()), ("all", Adam())])
def test_stages_of_before_there_were_optimizers_are_read(update, optimizer):
    written = {**dump(Stage(steps=7)), "update": update}
    del written["optimizer"]
    assert load(Stage, written) == Stage(steps=7, optimizer=optimizer)


def test_unknown_settings_are_refused_still():
    with pytest.raises(BadInput, match="updates: unknown setting"):
        load(Stage, {**dump(Stage()), "updates": "all"})
