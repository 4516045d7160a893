"""Steps that are for the points in view alone."""

from dataclasses import dataclass, field, replace

import pytest
import torch
from needs import needs_native

from surfkit.core.schedule import LearningRate
from surfkit.densify import ADC, Trim
from surfkit.densify.base import Prune
from surfkit.losses.photometric import L1
from surfkit.losses.regularizers import MeanOpacity
from surfkit.losses.reprojection import Reprojection
from surfkit.primitives import Flat3D, Gaussian3D, Surfel2D
from surfkit.primitives.points import Points
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.train import checkpoint, in_view, point_blocks, policies
from surfkit.train.adam import UPDATED, Adam, AdamInView
from surfkit.train.faults import Diverged
from surfkit.train.in_view import PointsInView
from surfkit.train.point_blocks import put_in_order
from surfkit.train.stage import Stage

from .conftest import looking_down

QUIET = Stage(steps=6, densify=None, sh_every=2, optimizer=AdamInView())


@dataclass(frozen=True)
class Noted(Prune):
    """Keeps what policies are told, and reads it while it is true."""

    steps: list = field(default_factory=list)

    def edit(self, points, step):
        self.steps.append(step)
        assert len(step.seen) == len(step.splats) == len(points)


@pytest.fixture
def apart(begin):
    """As `begin`, with small points and views so far apart that none shows all of them."""

    def start(stage, primitive=None):
        trainer, state = begin(stage, primitive)
        params = state.points.params
        params["means"] = params["means"] * torch.tensor([2.0, 2.0, 1.0])
        params["scales"] = params["scales"] - 0.5
        cameras = [looking_down(x, y) for x in (-0.7, 0.0, 0.7) for y in (-0.4, 0.4)]
        views = tuple(replace(view, camera=camera) for view, camera in zip(trainer.views, cameras, strict=True))
        put_in_order(state.points)  # as the first step does
        return replace(trainer, views=views), state

    return start


def held(points):
    return {name: value.clone() for name, value in points.params.items()}


def visible(trainer, state, done):
    """(N,) what the view of a step may show, of points as they are."""
    camera = done.target.view.camera
    rows = PointsInView.of(trainer.primitive, state.points.params, camera, trainer.rasterizer, trainer.stage.near).rows
    return torch.zeros(len(state.points), dtype=torch.bool).index_fill(0, rows, True)


@pytest.mark.parametrize("primitive", [Surfel2D(1), Gaussian3D(1), Flat3D(1)], ids=lambda part: type(part).__name__)
def test_only_points_in_view_change(apart, primitive):
    trainer, state = apart(QUIET, primitive)
    other, whole = apart(replace(QUIET, optimizer=Adam()), primitive)
    left = 0
    for _ in range(6):
        before, twin = held(state.points), {name: value.clone() for name, value in state.points.params.items()}
        done = trainer.step(state)
        inside = visible(trainer, replace(state, points=replace(state.points, params=twin)), done)
        for name, value in state.points.params.items():
            assert torch.equal(value[~inside], before[name][~inside]), name
        assert not torch.equal(state.points.params["means"][inside], before["means"][inside])
        assert state.points.stats[UPDATED][inside].eq(state.index).all()
        left += int((~inside).sum())
    assert left > 6, "all points were in view"
    list(other.run(whole))
    assert not torch.equal(state.points.params["means"], whole.points.params["means"])


def test_the_first_step_is_that_of_all_points(apart):
    """The gradients are the same, moments begin at 0, and points out of view have no gradient."""
    notes = [Noted(), Noted()]
    states = []
    for optimizer, note in zip((AdamInView(), Adam()), notes, strict=True):
        trainer, state = apart(replace(QUIET, optimizer=optimizer, prune=(note,)))
        trainer.step(state)
        states.append(state)
    (one,), (other,) = (note.steps for note in notes)
    assert not other.seen.all() and other.grad_norm.any()
    for name in ("seen", "radii", "grad_norm", "signed_norm"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(one.splats, name), getattr(other.splats, name)), name
    for name, value in states[0].points.params.items():
        assert torch.equal(value, states[1].points.params[name]), name


@dataclass(frozen=True)
class Sums(Prune):
    """Keeps statistics in both ways: of the points in view alone, and of all."""

    def watch(self, points, step):
        step.shown.add(points.stat("view/grad"), step.shown.grad_norm)
        step.shown.add(points.stat("view/seen"), step.shown.seen)
        step.shown.raise_to(points.stat("view/size"), step.shown.radii)
        points.stat("all/grad").add_(step.grad_norm)
        points.stat("all/seen").add_(step.seen)
        torch.maximum(points.stat("all/size"), step.radii, out=points.stat("all/size"))

    def edit(self, points, step):
        return None


def test_points_that_are_all_in_view_are_not_copied():
    columns = {"means": torch.rand(4, 3), "opacities": torch.rand(4)}
    found = PointsInView(torch.arange(4), 4).of_columns(columns)
    assert all(found[name].data_ptr() == value.data_ptr() for name, value in columns.items())
    some = PointsInView(torch.tensor([1, 3]), 4).of_columns(columns)
    assert torch.equal(some["means"], columns["means"][[1, 3]])


@pytest.mark.parametrize("optimizer", [Adam(), AdamInView()], ids=["all", "in view"])
def test_statistics_of_what_is_shown_are_those_of_all(apart, optimizer):
    trainer, state = apart(replace(QUIET, optimizer=optimizer, prune=(Sums(),)))
    list(trainer.run(state))
    stats = state.points.stats
    for name in ("grad", "seen", "size"):
        assert torch.equal(stats[f"view/{name}"], stats[f"all/{name}"]) and stats[f"all/{name}"].any(), name
    assert not stats["all/seen"].eq(6).all()


def test_adc_looks_at_no_other_point_between_edits(apart, monkeypatch):
    """What is made of all points would cost more the larger a survey is."""
    trainer, state = apart(replace(QUIET, densify=ADC(), prune=(Trim(),)))
    trainer.step(state)  # trim looks at all once
    monkeypatch.setattr(policies, "all_splats", None)
    monkeypatch.setattr(PointsInView, "among_all", None)
    trainer.step(state)
    assert state.points.stats["adc/seen"].max() == 2


@pytest.mark.parametrize("change", [
    {"regularizers": {"opacity": MeanOpacity(weight=0.1)}},
    {"losses": {"l1": L1(), "two": Reprojection(weight=0.1, start=0, every=1)}},
], ids=["regularizers", "two views"])  # fmt: skip
def test_steps_that_need_all_points_update_all(apart, change):
    found = []
    for optimizer in (AdamInView(), Adam()):
        trainer, state = apart(replace(QUIET, optimizer=optimizer, **change))
        list(trainer.run(state))
        found.append(held(state.points))
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])


def test_a_view_that_shows_no_point(begin):
    trainer, state = begin(replace(QUIET, losses={"l1": L1()}))
    state.points.params["means"] = state.points.params["means"] + 100
    put_in_order(state.points)
    before = held(state.points)
    done = list(trainer.run(state))
    assert all(step.losses["l1"] > 0 for step in done)
    assert all(torch.equal(value, before[name]) for name, value in state.points.params.items())


def test_training_raises_psnr_as_with_all_points(begin):
    from .test_stage import scored

    scores = []
    for optimizer in (AdamInView(), Adam()):
        trainer, state = begin(replace(QUIET, steps=60, optimizer=optimizer))
        before = scored(trainer, state)
        list(trainer.run(state))
        scores.append(scored(trainer, state) - before)
    assert scores[0] > 3 and scores[0] == pytest.approx(scores[1], abs=1.0)


def test_it_densifies_trims_and_goes_on_from_a_checkpoint(apart, tmp_path):
    """With the same bits, on any number of threads."""
    densify = ADC(start=1, until=9, every=2, threshold=1e-9)
    stage = replace(QUIET, steps=9, densify=densify, prune=(Trim(ratio=0.2, start=4, until=9, every=3, recovery=0),))
    path, ends = tmp_path / "c.safetensors", []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        trainer, state = apart(stage)
        for done in trainer.run(state):
            if done.index == 5:
                checkpoint.save(path, state)
        ends.append(state.points)
    again = checkpoint.load(path)
    list(trainer.run(again))
    ends.append(again.points)
    assert ends[0].stats[UPDATED].unique().numel() > 2 and len(ends[0]) != 40
    for other in ends[1:]:
        for group in ("params", "exp_avg", "exp_avg_sq", "stats"):
            one, two = getattr(ends[0], group), getattr(other, group)
            assert one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one), group


def test_frozen_points_teach_the_others_the_same(apart):
    """Of these too, only those in view are drawn."""
    trainer, whole = apart(QUIET)
    rows = torch.arange(40) >= 25
    _, part = apart(QUIET)
    columns = part.points.params
    part.points = Points.fresh({name: value[~rows].clone() for name, value in columns.items()})
    part.frozen = {name: value[rows].clone() for name, value in columns.items()}
    note = Noted()
    replace(trainer, stage=replace(trainer.stage, prune=(note,))).step(part)
    trainer.step(whole)
    kept = whole.points.take(~rows)
    put_in_order(kept)  # which is that of other points when others are among them
    for name, value in part.points.params.items():
        assert torch.equal(value, kept.params[name]), name
    assert len(note.steps[0].splats) == 25 and len(note.steps[0].views.contributions().mean) == 25


@dataclass(frozen=True)
class Steep(L1):
    """So steep that the squares of gradients are infinite."""

    def __call__(self, maps, sample):
        return maps.color.sum() * 1e25


def test_gradients_that_are_too_large_name_step_and_view(begin):
    trainer, state = begin(replace(QUIET, losses={"l1": Steep()}))
    put_in_order(state.points)
    before = held(state.points)
    with pytest.raises(Diverged, match=r"step 1, view \d.png: the gradients of"):
        trainer.step(state)
    assert all(torch.equal(value, before[name]) for name, value in state.points.params.items())


@dataclass(frozen=True)
class WithoutBoxes(NativeRasterizer):
    """Looks at every point."""

    def boxes_in_view(self, boxes, camera, near):
        return None


@needs_native
@pytest.mark.parametrize("primitive", [Surfel2D(1), Gaussian3D(1)], ids=lambda part: type(part).__name__)
@pytest.mark.parametrize("edited", [True, False])
def test_blocks_that_no_view_shows_make_no_difference(apart, primitive, edited, monkeypatch):
    """The same bits, with blocks of 4 points, and with edits and points that are put in order on the way, or with
    points that fly out of the boxes of the begin."""
    monkeypatch.setattr(point_blocks, "BLOCK_POINTS", 4)
    monkeypatch.setattr(point_blocks, "GROUP_BLOCKS", 2)
    monkeypatch.setattr(in_view, "SORTED_EVERY", 5 if edited else 100)
    stage = replace(QUIET, steps=14, sh_every=4, rates={"means": LearningRate(1e-3 if edited else 0.1)})
    if edited:
        stage = replace(stage, densify=ADC(start=2, every=4, threshold=1e-7, until=12))
    ends, opened = [], []
    for rasterizer in (NativeRasterizer(), WithoutBoxes()):
        trainer, state = apart(stage, primitive)
        trainer = replace(trainer, rasterizer=rasterizer)
        for done in trainer.run(state):
            if state.blocks is not None:  # after an edit they are still to be made
                shown = rasterizer.boxes_in_view(state.blocks.blocks, done.target.view.camera, stage.near)
                opened += [] if shown is None else [float(shown.float().mean())]
        ends.append(state.points)
    assert min(opened) < (0.7 if edited else 1), "some blocks are not opened"
    assert (len(ends[0]) > 40) == edited and len(ends[0]) == len(ends[1]), "points were added"
    for group in ("params", "exp_avg", "exp_avg_sq", "stats"):
        for name, value in getattr(ends[0], group).items():
            assert torch.equal(value, getattr(ends[1], group)[name]), (group, name)


def test_points_in_order_are_the_same_points(apart):
    trainer, state = apart(QUIET)
    for _ in range(3):
        trainer.step(state)
    before = state.points.take(torch.randperm(len(state.points), generator=torch.Generator().manual_seed(1)))
    after = before.take(torch.arange(len(before)))
    put_in_order(after)
    where = (after.params["means"][:, None] == before.params["means"]).all(2).nonzero()[:, 1]
    assert sorted(where.tolist()) == list(range(len(before))) and where.tolist() != sorted(where.tolist())
    for group in ("params", "exp_avg", "exp_avg_sq", "stats"):
        for name, value in getattr(after, group).items():
            assert torch.equal(value, getattr(before, group)[name][where]), (group, name)
    apart_before, apart_after = (points.params["means"].diff(dim=0).norm(dim=1).mean() for points in (before, after))
    assert apart_after < 0.6 * apart_before
