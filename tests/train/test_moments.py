"""Moments in 16 bits."""

from dataclasses import dataclass

import pytest
import torch

from surfkit.densify.base import Prune
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points
from surfkit.raster import native
from surfkit.train import adam, checkpoint
from surfkit.train.adam import Adam, AdamInView, adam_step, update
from surfkit.train.moments import SHORT, dithered, mixed
from surfkit.train.stage import Stage


@dataclass(frozen=True)
class Halved(Prune):
    """Drops every other point after the second step."""

    def edit(self, points, step):
        return Edit(drop=torch.arange(len(points)) % 2 == 0) if step.index == 2 else None


def test_the_second_moment_follows_that_of_float32():
    """Steady gradients, then ones a third as large: to nearest, a moment would stand still."""
    count, draw = 4_000, torch.Generator().manual_seed(0)
    ways = [[torch.zeros(count), *torch.zeros(2, count, dtype=kind)] for kind in (torch.float32, SHORT)]
    for index in range(1, 4_001):
        grad = torch.randn(count, generator=draw) / (1 if index < 2_000 else 3)
        for way in ways:
            update(way[0], grad, *way[1:], 1e-3, index)
    exact, short = ways[0][2], ways[1][2].float()
    ratio = short / exact
    assert abs(ratio.mean() - 1) < 0.005 and 0.02 < ratio.std() < 0.07
    steps = (ways[1][0] - ways[0][0]).abs().mean() / ways[0][0].abs().mean()
    assert steps < 0.03, "values go another way"


@pytest.mark.parametrize("compiled", [True, False])
def test_rows_are_those_of_a_whole_step(compiled, monkeypatch):
    if compiled and native.module() is None:
        pytest.skip("surfkit was installed without its compiled part")
    if not compiled:
        monkeypatch.setattr(native, "module", lambda: None)
    draw = torch.Generator().manual_seed(1)
    start = {"sh_rest": torch.randn(90, 15, 3, generator=draw), "means": torch.randn(90, 3, generator=draw)}
    ways = [Points.fresh({name: value.clone() for name, value in start.items()}).with_moments(SHORT) for _ in range(3)]
    rates = {"sh_rest": 0.01, "means": 0.1}
    for index in range(1, 6):
        grads = {name: torch.randn(value.shape, generator=draw) for name, value in start.items()}
        wide = torch.cat([torch.zeros(90, 1, 3), grads["sh_rest"]], 1)[:, 1:]
        assert not wide.is_contiguous()
        adam_step(ways[0], grads, rates, index)
        adam_step(ways[1], grads, rates, index, torch.arange(90))
        adam_step(ways[2], grads | {"sh_rest": wide}, rates, index)
    for name in start:
        for group in ("params", "exp_avg", "exp_avg_sq"):
            one, *others = (getattr(way, group)[name] for way in ways)
            assert all(torch.equal(one, other) for other in others), (group, name)
        assert ways[0].exp_avg_sq[name].dtype == SHORT


@pytest.mark.parametrize("optimizer", [Adam(moments="bfloat16"), AdamInView(moments="bfloat16")])
def test_a_run_that_goes_on_has_the_same_bits(begin, tmp_path, optimizer):
    """A checkpoint keeps the moments as they are, and edits move them."""
    stage = Stage(steps=6, densify=None, prune=(Halved(),), optimizer=optimizer)
    trainer, whole = begin(stage)
    list(trainer.run(whole))
    trainer, state = begin(stage)
    for _ in range(3):
        trainer.step(state)
    checkpoint.save(tmp_path / "stage", state)
    state = checkpoint.load(tmp_path / "stage")
    list(trainer.run(state))
    for group in ("params", "exp_avg", "exp_avg_sq"):
        one, other = getattr(whole.points, group), getattr(state.points, group)
        assert all(torch.equal(one[name], other[name]) for name in one), group
    assert {value.dtype for value in state.points.exp_avg.values()} == {SHORT}


def test_pieces_have_the_bits_of_the_whole(monkeypatch):
    draw = torch.Generator().manual_seed(2)
    whole, pieces = ([torch.zeros(50, 3), *torch.zeros(2, 50, 3, dtype=SHORT)] for _ in range(2))
    for index in range(1, 4):
        grad = torch.randn(50, 3, generator=draw)
        update(whole[0], grad, *whole[1:], 0.1, index)
        with monkeypatch.context() as small:
            small.setattr(adam, "VALUES_TOGETHER", 20)
            update(pieces[0], grad, *pieces[1:], 0.1, index)
    assert all(torch.equal(one, other) for one, other in zip(whole, pieces, strict=True))


def test_numbers_have_no_pattern():
    places = torch.arange(1 << 16)
    one, next_step = mixed(places, 5).double(), mixed(places, 6).double()
    assert one.min() >= 0 and one.max() < 1 << 16 and abs(one.mean() / (1 << 15) - 1) < 0.01
    for other in (next_step, one.roll(1), one.roll(45)):
        assert abs(torch.corrcoef(torch.stack([one, other]))[0, 1]) < 0.02


def test_rounding_goes_to_neighbours_and_keeps_the_mean():
    value = torch.full((20_000,), 1.0 + 0.3 * 2**-7)
    found = dithered(value, torch.arange(20_000), 1).float()
    assert set(found.tolist()) == {1.0, 1.0 + 2**-7}
    assert abs(((found - 1) * 2**7).mean() - 0.3) < 0.01
    assert dithered(torch.zeros(3), torch.arange(3), 1).eq(0).all()
