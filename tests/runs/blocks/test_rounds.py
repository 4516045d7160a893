"""Blocks that agree after every round: the same bits however they are interrupted, and whoever trains them."""

import shutil
from dataclasses import replace

import pytest
import torch
from two_blocks import EVERY, STEPS, same, stop_after

from surfkit.core.check import BadInput
from surfkit.losses.consensus import Consensus, column
from surfkit.partition import PictureShare
from surfkit.runs.blocks import rounds, worker
from surfkit.runs.blocks.block import BlockRun, agreement_file, read_plan, rounds_agreed
from surfkit.runs.blocks.train_blocks import Compute, Unfinished
from surfkit.runs.execute.base import Inline, JobResult
from surfkit.runs.pipeline import opened, run
from surfkit.runs.recipe import with_steps
from surfkit.train import checkpoint
from surfkit.train.stage import Stage

ROUND = 5


@pytest.fixture(scope="module")
def agreeing(recipe):
    """Three rounds, of 5, 5 and 2 steps."""
    term = Consensus(every=ROUND, strong=1e6, weak=1e6, balance_until=STEPS)
    tune = replace(recipe.tune, regularizers={"agree": term}, densify=None)
    return replace(recipe, tune=tune, assign=PictureShare(0.6), context="tuned")


@pytest.fixture(scope="module")
def whole(data, agreeing, tmp_path_factory):
    out = tmp_path_factory.mktemp("rounds") / "run"
    run(agreeing, data, out, Compute("cpu"), EVERY)
    return out


def states(out):
    return [checkpoint.load(out / "blocks" / f"{at:03}" / "tune" / "checkpoint.safetensors") for at in range(2)]


def test_copies_are_pulled_together(data, agreeing, tmp_path):
    """Nearer to each other than those of blocks that do not agree; the merged model has the mean, each point once."""
    apart = {}
    for name, every in {"with": 10, "without": 60}.items():
        term = Consensus(every=every, strong=1e6, weak=1e6)
        tune, out = replace(agreeing.tune, steps=60, regularizers={"agree": term}), tmp_path / name
        run(replace(agreeing, tune=tune), data, out, Compute("cpu"), EVERY)
        one, other = states(out)
        both = torch.isin(one.points.stats["id"], other.points.stats["id"])
        there = torch.isin(other.points.stats["id"], one.points.stats["id"])
        assert 20 < both.sum() < len(both), "some points are in both blocks, not all"
        a, b = one.points.params["means"][both], other.points.params["means"][there]
        apart[name] = float((a - b).norm())
        coarse = checkpoint.load(out / "pretrain" / "checkpoint.safetensors").points.params["means"]
        merged = checkpoint.load(out / "tune" / "checkpoint.safetensors").points.params["means"]
        wanted = coarse.clone()
        for state in (one, other):
            wanted[state.points.stats["id"]] = state.points.params["means"]
        wanted[one.points.stats["id"][both]] = ((a.double() + b.double()) / 2).float()
        assert torch.equal(merged, wanted)
    assert apart["with"] < 0.7 * apart["without"]


def test_the_rounds_leave_what_is_needed(whole):
    loaded = opened(whole)
    assert rounds_agreed(loaded) == 2, "none after the last step"
    found, state = rounds.load_agreement(loaded, 2), states(whole)[0]
    rows = torch.isin(state.points.stats["id"], found.ids)
    assert torch.equal(state.points.stats[column("z", "means")][rows], found.z["means"])
    assert not state.points.stats[column("rho", "means")][~rows].any() and rows.any() and not rows.all()
    u = [s.points.stats[column("u", "means")][torch.isin(s.points.stats["id"], found.ids)] for s in states(whole)]
    assert u[0].abs().max() > 0 and torch.allclose(u[0], -u[1], atol=1e-6), "differences to a mean cancel"


@pytest.mark.parametrize("step", [3, 5, 7, 10, 11])
def test_interrupted_at_any_step(whole, data, agreeing, tmp_path, monkeypatch, step):
    """In the middle and at the end of rounds, of the first block that comes there."""
    with monkeypatch.context() as patch:
        patch.setattr(worker, "optimise", stop_after(worker.optimise, step))
        with pytest.raises(KeyboardInterrupt):
            run(agreeing, data, tmp_path, Compute("cpu"), EVERY)
    run(agreeing, data, tmp_path, Compute("cpu"), EVERY)
    assert same(tmp_path, whole)


@pytest.mark.parametrize("after", [False, True])
def test_killed_while_blocks_agree(whole, data, agreeing, tmp_path, monkeypatch, after):
    """Before and after what they agree on is written, and when one of the blocks has begun the next round with it."""
    save = rounds.save_agreement

    def dies(path, found):
        if after:
            save(path, found)
        raise SystemExit

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(rounds, "save_agreement", dies)
        run(agreeing, data, tmp_path, Compute("cpu"), EVERY)
    if after:
        loaded = opened(tmp_path)
        block = BlockRun(loaded, read_plan(loaded).plan, 1)
        assert block.goal == 2 * ROUND and not block.is_done
        state = rounds.take_in(block, checkpoint.load(block.stage.checkpoint))
        assert rounds.take_in(block, state) is state, "once only"
    run(agreeing, data, tmp_path, Compute("cpu"), EVERY)
    assert same(tmp_path, whole)


class Backwards(Inline):
    """The last block first, each twice."""

    def run(self, jobs):
        for job in reversed(jobs):
            assert job.call() == 0
            yield JobResult(job, job.call())


def test_the_order_of_blocks_changes_nothing(whole, data, agreeing, tmp_path):
    """Each goes as far as all blocks have agreed, and no farther."""
    run(agreeing, data, tmp_path, Compute("cpu", Backwards()), EVERY)
    assert same(tmp_path, whole)


def test_a_damaged_checkpoint_takes_in_the_round_again(whole, data, agreeing, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(worker, "optimise", stop_after(worker.optimise, 7))
        with pytest.raises(KeyboardInterrupt):
            run(agreeing, data, tmp_path, Compute("cpu"), EVERY)
    path = tmp_path / "blocks" / "000" / "tune" / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:-50])
    run(agreeing, data, tmp_path, Compute("cpu"), EVERY)
    assert same(tmp_path, whole)


def test_what_is_lost_for_good_is_told(whole, data, agreeing, tmp_path, capsys):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    checkpoint.discard(out / "tune" / "checkpoint.safetensors")
    shutil.rmtree(out / "blocks" / "001")
    agreement_file(opened(out), 1).unlink()
    with pytest.raises(Unfinished, match="block 1 .*step 5, .*000001.* is gone"):
        run(agreeing, data, out, Compute("cpu"), EVERY)
    shutil.rmtree(agreement_file(opened(out), 1).parent)
    with pytest.raises(Unfinished, match="step 12, .*step 5 is gone"):
        run(agreeing, data, out, Compute("cpu"), EVERY)


def test_a_block_that_is_lost_is_tuned_again(whole, data, agreeing, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    checkpoint.discard(out / "tune" / "checkpoint.safetensors")
    shutil.rmtree(out / "blocks" / "001" / "tune")
    run(agreeing, data, out, Compute("cpu"), EVERY)
    assert same(out, whole)


def test_recipes_whose_blocks_could_not_agree(agreeing, recipe):
    term = {"agree": Consensus()}
    for wrong, message in (
        (replace(agreeing, context="frozen"), "no point is tuned by two blocks"),
        (replace(agreeing, tune=replace(agreeing.tune, densify=recipe.tune.densify)), "choose tune.densify:none"),
        (replace(agreeing, pretrain=replace(agreeing.pretrain, regularizers=term)), "only blocks agree"),
        (replace(agreeing, tune=replace(agreeing.tune, regularizers=term | {"b": Consensus()})), "several of them"),
    ):
        with pytest.raises(BadInput, match=message):
            wrong.refuse_unfit()
    agreeing.refuse_unfit()
    assert with_steps(replace(agreeing, tune=Stage(300, regularizers=term)), 1).tune.regularizers["agree"].every == 20
