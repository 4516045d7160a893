"""Points that others own: neither copied nor split, or drawn and otherwise left alone."""

from dataclasses import dataclass, field, replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.densify import ADC
from surfkit.densify.base import Densify, Prune
from surfkit.densify.filters import CountCap
from surfkit.densify.trim import Trim
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points
from surfkit.train import checkpoint, streaming
from surfkit.train.stage import Stage

QUIET = Stage(steps=6, densify=None, sh_every=2)


@dataclass(frozen=True)
class Greedy(Densify):
    """Of another author, who has never heard of blocks: copies and splits everything, at every step."""

    parents: list = field(default_factory=list)

    def edit(self, points, step):
        self.parents.append(points.params["means"].clone())
        odd = torch.arange(len(points)) % 2 == 1
        return Edit(clone=(~odd).long(), split=odd, scale_by=torch.full((len(points),), 0.9))


@dataclass(frozen=True)
class Everything(Prune):
    """Resets, forgets and notes what it is shown; drops every other point once."""

    shown: list = field(default_factory=list)

    def edit(self, points, step):
        tally = step.views.contributions()
        sizes = {len(points), len(step.splats), len(step.seen), len(step.radii), len(step.grad_norm), len(tally.mean)}
        self.shown.append((sizes, int(tally.views.sum()), len(next(step.views.each(1.0, 1.0))[0])))
        half = torch.arange(len(points)) % 2 == 0
        return Edit(drop=half if step.index == 2 else None, max_opacity=0.01, forget=half)


def west(means):
    return means[:, 0] < 0


def cut(state, rows):
    """A state with some of the points frozen."""
    columns = state.points.params
    state.points = Points.fresh({name: value[~rows].clone() for name, value in columns.items()})
    state.frozen = {name: value[rows].clone() for name, value in columns.items()}
    return state


def test_a_densifier_that_knows_nothing_of_blocks_obeys(begin):
    """One step: each point in the west becomes two, none in the east, and only those that became two shrink."""
    greedy = Greedy()
    trainer, state = begin(replace(QUIET, densify=greedy))
    trainer = replace(trainer, owns=west)
    still, other = begin(QUIET)
    still.step(other)
    trainer.step(state)
    own = west(greedy.parents[0])
    assert 5 < int(own.sum()) < 35 and len(state.points) == 40 + int(own.sum())
    moved = other.points.params
    # the east comes first to last as if nothing had been asked for
    east = state.points.params["means"][: int((~own | (torch.arange(40) % 2 == 0)).sum())]
    kept = ~own | (torch.arange(40) % 2 == 0)
    assert torch.equal(east, moved["means"][kept])
    factor = (state.points.params["scales"][: len(east)] - moved["scales"][kept]).exp()
    assert torch.allclose(factor, torch.where(own[kept], 0.9, 1.0)[:, None].expand_as(factor), atol=1e-6)


def test_who_owns_a_point_is_asked_anew_at_each_edit(begin):
    """Children that come to lie across the border do not multiply, and their kin that come back do."""
    greedy = Greedy()
    trainer, state = begin(replace(QUIET, steps=4, densify=greedy))
    counts = [len(state.points)]
    for _ in replace(trainer, owns=west).run(state):
        counts.append(len(state.points))
    wanted = [len(means) + int(west(means).sum()) for means in greedy.parents]
    assert counts[1:] == wanted
    first = west(greedy.parents[0]).sum()
    assert counts[-1] != 40 + (2**4 - 1) * int(first), "some have crossed the border"


def test_room_under_a_cap_is_for_owned_points(begin):
    """A filter that admits a number of points does not spend it on those that may not multiply."""
    densify = ADC(threshold=1e-12, start=0, every=2, filters=(CountCap(44),), cull_opacity=0.0, reset_every=1_000)
    trainer, state = begin(replace(QUIET, steps=2, densify=densify))
    list(replace(trainer, owns=west).run(state))
    assert len(state.points) == 44


def test_frozen_points_teach_the_others_the_same(begin):
    """One step moves points as it does where all are tuned, to the bit."""
    trainer, whole = begin(QUIET)
    rows = torch.arange(40) >= 25  # the order of points decides between equal depths
    _, part = begin(QUIET)
    part = cut(part, rows)
    trainer.step(whole)
    trainer.step(part)
    for name, value in part.points.params.items():
        assert torch.equal(value, whole.points.params[name][~rows]), name
        assert torch.equal(part.points.exp_avg_sq[name], whole.points.exp_avg_sq[name][~rows]), name
    _, alone = begin(QUIET)
    alone = cut(alone, rows)
    alone.frozen = {}
    trainer.step(alone)
    assert not torch.equal(alone.points.params["means"], part.points.params["means"]), "they hide nothing"


def test_policies_leave_frozen_points_alone(begin):
    seen = Everything()
    trim = Trim(ratio=0.5, start=2, until=9, every=1, recovery=0)
    trainer, state = begin(replace(QUIET, prune=(seen, trim)))
    state = cut(state, torch.arange(40) < 15)
    before = {name: value.clone() for name, value in state.frozen.items()}
    list(trainer.run(state))
    assert all(torch.equal(state.frozen[name], value) for name, value in before.items())
    assert 0 < len(state.points) < 14 and (state.points.params["opacities"].sigmoid() < 0.2).all()
    assert all(sizes == {each} and views > 0 for sizes, views, each in seen.shown)
    assert seen.shown[0][2] == 25


def test_a_state_with_frozen_points_on_disk(begin, tmp_path):
    """Interrupted, it ends with the same bits; in pieces it has only the others."""
    stage = replace(QUIET, densify=ADC(start=1, until=6, every=2, threshold=1e-9))
    trainer, state = begin(stage)
    state, path = cut(state, torch.arange(40) < 15), tmp_path / "c.safetensors"
    for done in trainer.run(state):
        if done.index == 3:
            checkpoint.save(path, state)
    again = checkpoint.load(path)
    list(trainer.run(again))
    for one, other in ((state.points.params, again.points.params), (state.frozen, again.frozen)):
        assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
    checkpoint.save(path, again)
    stored = streaming.opened(path)
    assert sum(len(piece.points) for piece in stored.pieces()) == len(again.points)
    assert len(stored.state.frozen["means"]) == 15 and stored.state.frozen["means"].device.type == "meta"


def test_frozen_points_that_do_not_fit_are_refused(begin, tmp_path):
    path = tmp_path / "c.safetensors"
    for spoil in (
        lambda frozen: frozen.pop("quats"),
        lambda frozen: frozen.update(means=frozen["means"][:3]),
        lambda frozen: frozen.update(sh_rest=frozen["sh_rest"][:, :1]),
    ):
        _, state = begin(QUIET)
        spoil(cut(state, torch.arange(40) < 15).frozen)
        checkpoint.save(path, state)
        with pytest.raises(BadInput, match="c.safetensors: .*frozen points"):
            checkpoint.load(path)


def test_nothing_frozen_is_not_the_same_as_no_column(begin, tmp_path):
    """A block that sees nothing around it has 0 frozen points; one from before there were any has none at all."""
    trainer, state = begin(QUIET)
    state, path = cut(state, torch.zeros(40, dtype=torch.bool)), tmp_path / "c.safetensors"
    trainer.step(state)
    checkpoint.save(path, state)
    assert checkpoint.load(path).frozen.keys() == state.points.params.keys()
    state.frozen = {}
    checkpoint.save(path, state)
    assert checkpoint.load(path).frozen == {}
