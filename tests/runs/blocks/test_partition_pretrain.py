"""Blocks that another pretraining decides on."""

import json
from dataclasses import replace

import pytest
import torch
from two_blocks import EVERY, same, stop_after

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.core.schedule import LearningRate
from surfkit.runs import pipeline
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.train import checkpoint
from surfkit.train.stage import Stage


@pytest.fixture(scope="module")
def other(recipe):
    """A pretraining of its own, of which every point moves to other places."""
    return replace(recipe, partition_pretrain=Stage(steps=8, rates={"means": LearningRate(0.05)}))


@pytest.fixture(scope="module")
def made(data, other, tmp_path_factory):
    out = tmp_path_factory.mktemp("other") / "run"
    return out, run(other, data, out, Compute("cpu"), EVERY)


def plan_of(out):
    return json.loads((out / "blocks" / "plan.json").read_text())["plan"]


def middle(out, model):
    """Half of the points lie to each side of it, along the first axis of the ground."""
    found = plan_of(out)["cells"]
    means = checkpoint.load_last(model / "pretrain" / "checkpoint.safetensors")[0].points.params["means"]
    flat = means.double() @ torch.tensor(found["ground"]["x"], dtype=torch.float64)
    return flat.sort().values[len(flat) // 2].item()


def border(out):
    return plan_of(out)["cells"]["boxes"][0][2]


def test_the_blocks_are_those_of_the_other_model_and_begin_with_that_of_pretrain(made, undisturbed):
    out, metrics = made
    assert border(undisturbed) == middle(undisturbed, undisturbed)
    assert border(out) == middle(out, out / "partition") != border(undisturbed)
    first, second = (path / "pretrain" / "checkpoint.safetensors" for path in (out, undisturbed))
    ours, theirs = (checkpoint.load_last(path)[0].points.params for path in (first, second))
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items()), "pretraining itself is the same"
    blocks = plan_of(out)["blocks"]
    assert sum(block["points"] for block in blocks) == len(ours["means"]), "points of the coarse model are counted"
    assert blocks[0]["points"] != blocks[1]["points"], "the border halves the points of the other model"
    assert not same(out, undisturbed)
    states = [
        checkpoint.load_last(first)[0],
        *[checkpoint.load_last(p)[0] for p in out.glob("blocks/0*/tune/checkpoint.safetensors")],
    ]
    decided = checkpoint.load_last(out / "partition" / "pretrain" / "checkpoint.safetensors")[0]
    assert metrics["seconds"] == pytest.approx(sum(state.seconds for state in states) + decided.seconds)


def test_an_interrupted_one_goes_on(made, data, other, tmp_path, monkeypatch):
    out, real = tmp_path / "run", pipeline.optimise
    stopped = stop_after(real, 5)
    with monkeypatch.context() as patch:
        patch.setattr(
            pipeline, "optimise", lambda job, state: (stopped if "partition" in job.run.out.name else real)(job, state)
        )
        with pytest.raises(KeyboardInterrupt):
            run(other, data, out, Compute("cpu"), EVERY)
    assert not (out / "blocks" / "plan.json").exists() and (out / "partition" / "pretrain").exists()
    run(other, data, out, Compute("cpu"), EVERY)
    assert same(out, made[0])
    (out / "metrics.json").unlink()
    before = (out / "partition" / "pretrain" / "checkpoint.safetensors").stat().st_mtime_ns
    run(other, data, out, Compute("cpu"), EVERY)
    assert (out / "partition" / "pretrain" / "checkpoint.safetensors").stat().st_mtime_ns == before


def test_it_is_part_of_the_recipe(other, data, tmp_path):
    assert load(Recipe, dump(other)) == other and with_steps(other, 24).partition_pretrain.steps == 16
    assert [path for path, _, _ in other.stages()] == ["pretrain", "partition_pretrain", "tune"]
    assert Run(tmp_path, replace(other, partition_pretrain=None), data).partition is None
    whole = replace(other, partition=None)
    with pytest.raises(BadInput, match="partition_pretrain: .*leave it out"):
        run(whole, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert not (tmp_path / "run" / "recipe.json").exists()
