"""What becomes of the points around a block, in whole runs."""

import json
import os
from dataclasses import dataclass, replace

import pytest
import torch
from two_blocks import EVERY, STEPS, same, stop_after

from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.densify import ADC
from surfkit.densify.trim import Trim
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import confidence_path, map_path, write_map, write_record
from surfkit.losses.depth import DepthRegression
from surfkit.partition import PictureShare
from surfkit.raster.select import select
from surfkit.runs.blocks import block_forecast as forecasts
from surfkit.runs.blocks import train_blocks as schedule
from surfkit.runs.blocks import worker
from surfkit.runs.blocks.block import BlockRun
from surfkit.runs.blocks.block_forecast import (
    FROZEN_POINT_BYTES,
    TRAINED_POINT_BYTES,
    BlockPoints,
    forecast,
    initial_points,
    point_memory,
)
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.execute import Pool
from surfkit.runs.execute.block_state import read_state
from surfkit.runs.pipeline import load_run, run
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings

DENSIFY = ADC(start=2, until=STEPS, every=2, threshold=1e-9, reset_every=7, recovery=0)


@pytest.fixture(scope="module")
def growing(recipe):
    """Points multiply from the first steps on, and are reset, culled and trimmed."""
    prune = (Trim(ratio=0.1, start=2, until=STEPS, every=1, recovery=0),)
    return replace(
        recipe, tune=replace(recipe.tune, densify=DENSIFY, prune=prune), pretrain=replace(recipe.pretrain, densify=None)
    )


@pytest.fixture(scope="module")
def runs(data, growing, tmp_path_factory):
    """A run of each kind, in this process."""
    found = {}
    for context in ("densified", "tuned", "frozen"):
        found[context] = tmp_path_factory.mktemp(context) / "run"
        run(replace(growing, context=context), data, found[context], Compute("cpu"), EVERY)
    return found


def block_state(out, index):
    return checkpoint.load(out / "blocks" / f"{index:03}" / "tune" / "checkpoint.safetensors")


def coarse_and_plan(out):
    coarse = checkpoint.load(out / "pretrain" / "checkpoint.safetensors")
    return coarse, read_json(out / "blocks" / "plan.json", schedule.BlocksRecord).plan


def test_frozen_points_end_as_the_coarse_model_has_them(runs):
    """All that the views of a block show of others', found by drawing the whole coarse model, and in its order."""
    loaded, _, scene = load_run(runs["frozen"])
    coarse, plan = coarse_and_plan(runs["frozen"])
    params, rasterizer = coarse.points.params, select("cpu")[0]
    splats = loaded.recipe.primitive.activate(params, coarse.sh_degree)
    for index in range(2):
        own = plan.cells.owner(params["means"]) == index
        seen = torch.zeros_like(own)
        for view in scene.train:
            if view.name in plan.blocks[index].views:
                seen |= rasterizer.render(splats, view.camera, loaded.recipe.pretrain.near).seen
        state = block_state(runs["frozen"], index)
        wanted = {name: value[seen & ~own] for name, value in params.items()}
        assert len(wanted["means"]) > 20
        assert all(torch.equal(state.frozen[name], value) for name, value in wanted.items())
        assert read_state(runs["frozen"] / "blocks" / f"{index:03}").begun_points == int(own.sum())
        assert len(state.points) != int(own.sum()) and state.reset_at == 7, "edits and a reset were made"


def test_only_owned_points_come_to_more(runs):
    """The merge keeps what lies in the block, and what it leaves out has not multiplied."""
    left = {}
    for context, out in runs.items():
        _, plan = coarse_and_plan(out)
        gave = json.loads((out / "blocks" / "merge.json").read_text())["blocks"]
        for index in range(2):
            means = block_state(out, index).points.params["means"]
            own = plan.cells.owner(means) == index
            assert (gave[index]["given"], gave[index]["kept"]) == (len(means), int(own.sum()))
            left[context, index] = int((~own).sum())
    begins = [block.begins - block.points for block in plan.blocks]
    for index in range(2):
        # children of owned points are drawn across the border, too; once there, they multiply no more
        assert 0 < left["frozen", index] < 0.5 * begins[index]
        assert left["tuned", index] < 1.3 * begins[index] < 0.8 * left["densified", index]


def test_the_plan_tells_the_borders(runs):
    """Without surfkit: which of the merged points lies where, from plan.json alone."""
    plan = json.loads((runs["frozen"] / "blocks" / "plan.json").read_text())["plan"]
    cells = plan["cells"]
    x = torch.tensor(cells["ground"]["x"], dtype=torch.float64)
    border, other = cells["boxes"][0][2], cells["boxes"][1][0]
    assert border == other and cells["contraction"] is None and cells["blocks"] == [0, 1]
    means = checkpoint.load(runs["frozen"] / "tune" / "checkpoint.safetensors").points.params["means"].double()
    gave = json.loads((runs["frozen"] / "blocks" / "merge.json").read_text())["blocks"]
    assert int((means @ x < border).sum()) == gave[0]["kept"] and int((means @ x >= border).sum()) == gave[1]["kept"]


@pytest.mark.usefixtures("forked_jobs")
def test_a_pool_comes_to_the_same_bits(runs, data, growing, tmp_path):
    run(replace(growing, context="tuned"), data, tmp_path, Compute("cpu", Pool(workers=2)), EVERY)
    assert same(tmp_path, runs["tuned"])


def killed_in_block_1(monkeypatch):
    """A worker that is killed without a word after step 7 of block 1, three steps after its last checkpoint."""
    command = schedule.job_of

    def deadly(ctx, block, compute):
        job = command(ctx, block, compute)
        mark = ctx.run.out / "killed"
        if block.index == 1 and not mark.exists():
            code = (
                "import os, sys, surfkit.runs.run_stage as o\nfrom pathlib import Path\nD = o.TrainingDisplay\n"
                "class K(D):\n    def show(self, done):\n        super().show(done)\n        if done.index == 7:\n"
                f"            Path({str(mark)!r}).touch(); os.kill(os.getpid(), 9)\n"
                f"o.TrainingDisplay = K\nfrom surfkit.cli import main\nsys.exit(main({list(job.command[2:])!r}))"
            )
            job = replace(job, command=("-c", code))
        return job

    monkeypatch.setattr(schedule, "job_of", deadly)


@pytest.mark.usefixtures("forked_jobs")
def test_killed_in_the_middle_of_a_block(runs, data, growing, tmp_path, monkeypatch):
    """In a pool; what was made in this process, undisturbed, has the same bits, those of the frozen points too."""
    killed_in_block_1(monkeypatch)
    run(replace(growing, context="frozen"), data, tmp_path, Compute("cpu", Pool(workers=2)), EVERY)
    assert (tmp_path / "killed").exists() and same(tmp_path, runs["frozen"])
    for index in range(2):
        found, true = block_state(tmp_path, index), block_state(runs["frozen"], index)
        assert all(torch.equal(value, found.frozen[name]) for name, value in true.frozen.items())


def test_a_block_of_another_context_is_refused(data, growing, tmp_path, monkeypatch, capsys):
    """As a checkpoint from before points were frozen is, in one line; nothing of it is lost."""
    frozen = replace(growing, context="frozen")
    with monkeypatch.context() as patch:
        patch.setattr(worker, "optimise", stop_after(worker.optimise, 6))
        with pytest.raises(KeyboardInterrupt):
            run(frozen, data, tmp_path, Compute("cpu"), EVERY)
    path = tmp_path / "blocks" / "000" / "tune" / "checkpoint.safetensors"
    state = checkpoint.load(path)
    state.frozen = {}
    checkpoint.save(path, state)
    with pytest.raises(schedule.Unfinished, match="000/tune/checkpoint.safetensors .*no frozen points"):
        run(frozen, data, tmp_path, Compute("cpu"), EVERY)
    assert checkpoint.load(path).index == 6 and "delete" in capsys.readouterr().err
    with pytest.raises(BadInput, match='context "frozen", .*"tuned"'):
        run(replace(growing, context="tuned"), data, tmp_path, Compute("cpu"), EVERY)


def test_a_recipe_from_before_there_was_a_choice(runs, data, growing, tmp_path):
    """Its blocks go on as they began."""
    run(replace(growing, context="densified"), data, tmp_path, Compute("cpu"), EVERY)
    path = tmp_path / "recipe.json"
    old = json.loads(path.read_text())
    del old["context"]
    path.write_text(json.dumps(old))
    assert load_run(tmp_path)[0].recipe.context == "densified" and same(tmp_path, runs["densified"])


def test_a_block_needs_no_depth_maps_but_its_own(recipe, tmp_path):
    """With those of all other photographs deleted it comes to the same bits."""
    truth = photograph(Flight(views=12, width=32, height=24, points=300))
    write_colmap(tmp_path / "data", truth, tracks=True)
    for name, exact in truth.exact.items():
        inverse = truth.scene.frame.scale / exact.depth.clamp_min(1e-9).numpy()
        write_map(tmp_path / "data", name, inverse, (exact.depth > 0).float().numpy())
    write_record(tmp_path / "data", {"aligned": False})
    deep = replace(recipe.tune, losses=recipe.tune.losses | {"depth": DepthRegression()})
    apart = replace(recipe, tune=deep, assign=PictureShare(0.6), context="frozen")
    made = Data(tmp_path / "data")
    run(apart, made, tmp_path / "run", Compute("cpu"), EVERY)
    true = block_state(tmp_path / "run", 0)
    loaded, _, scene = load_run(tmp_path / "run")
    _, plan = coarse_and_plan(tmp_path / "run")
    others = {view.name for view in scene.train} - set(plan.blocks[0].views)
    assert others
    for path in (map_path(made.path, name) for name in [*others, *(view.name for view in scene.held_out)]):
        confidence_path(path).unlink()
        path.unlink()
    checkpoint.discard(loaded.out / "blocks" / "000" / "tune" / "checkpoint.safetensors")
    os.unlink(loaded.out / "blocks" / "000" / "state.json")
    ctx = worker.RunContext(loaded, scene, select("cpu")[0], EVERY, CacheSettings())
    assert worker.train_block(ctx, BlockRun(loaded, plan, 0)) == 0
    again = block_state(tmp_path / "run", 0)
    assert all(torch.equal(value, again.points.params[name]) for name, value in true.points.params.items())
    map_path(made.path, plan.blocks[0].views[0]).unlink()
    os.unlink(loaded.out / "blocks" / "000" / "state.json")
    checkpoint.discard(loaded.out / "blocks" / "000" / "tune" / "checkpoint.safetensors")
    assert worker.train_block(ctx, BlockRun(loaded, plan, 0)) == 2, "its own it does need"


@dataclass(frozen=True)
class Found:
    memory: int
    least: int
    disk: int
    seconds: float


def test_what_is_foretold_of_each_kind(runs, data, growing, tmp_path, capsys):
    loaded, _, scene = load_run(runs["frozen"])
    coarse, plan = coarse_and_plan(runs["frozen"])
    found = {}
    for context in runs:
        place = replace(loaded, out=tmp_path / context, recipe=replace(growing, context=context))
        (place.out / "pretrain").mkdir(parents=True)
        os.link(runs["frozen"] / "pretrain" / "checkpoint.safetensors", place.out / "pretrain/checkpoint.safetensors")
        block = BlockRun(place, plan, 0)
        told = forecast([block], worker.open_coarse_model(place), [])
        found[context] = Found(point_memory(block), told.least_bytes, told.disk_bytes, told.seconds)
        own, both = block.planned.points, block.planned.begins
        wanted = {
            "densified": BlockPoints(both, 0, False),
            "tuned": BlockPoints(own, both - own, False),
            "frozen": BlockPoints(own, both - own, True),
        }
        assert initial_points(block) == wanted[context]
        block.write(begun_points=own + 7 if context == "frozen" else both + 7)
        more = {"densified": 3 * 7, "tuned": 7, "frozen": 3 * 7}[context] * TRAINED_POINT_BYTES
        assert point_memory(block) - found[context].memory == more
    held = {"peak": 10_000_000, "photographs": 4_000_000, "points": 1_000_000, "steps": 5_000_000}
    (place.out / "run.json").write_text(json.dumps({"gpu_memory_bytes": held}))
    told_of_gpu = forecast([block], worker.open_coarse_model(place), [])
    assert told.gpu_bytes == 0 and told_of_gpu.memory_bytes == 0
    assert told_of_gpu.gpu_bytes == initial_points(block).bytes(
        6e6 / len(coarse.points), 3e6 / len(coarse.points), forecasts.DENSIFIED_GROWTH
    )
    forecasts.report_forecast(place.out, told_of_gpu)
    assert f"needs up to {told_of_gpu.gpu_bytes / 1e6:.0f} MB" in capsys.readouterr().err
    around = plan.blocks[0].begins - plan.blocks[0].points
    assert found["densified"].memory - found["tuned"].memory == 2 * around * TRAINED_POINT_BYTES
    less = TRAINED_POINT_BYTES - FROZEN_POINT_BYTES
    assert found["tuned"].memory - found["frozen"].memory == around * less
    pace = coarse.seconds / coarse.index
    assert found["densified"].seconds == found["tuned"].seconds == pytest.approx(STEPS * pace)
    shorter = STEPS * pace * (1 - 0.25 * around / plan.blocks[0].begins)
    assert found["frozen"].seconds == pytest.approx(shorter)
    assert found["densified"].disk > found["tuned"].disk > found["frozen"].disk
    assert found["densified"].least == found["tuned"].least > found["frozen"].least
    there = block_state(runs["frozen"], 0)
    each = sum(value.nbytes for value in there.points.params.values()) / len(there.points)
    wanted = 3 * each * plan.blocks[0].points + each * around
    assert found["frozen"].least == pytest.approx(wanted, rel=0.1)


def test_recipes_with_blocks_densify_what_a_block_owns():
    made = recipes()
    names = ("citygs2", "citygs2-short", "citygs2-s", "citygs2-t", "citygs2-aerial", "citygs2-street", "surface-blocks")
    assert {made[name].context for name in names} == {"tuned"} and made["citygs"].context == "densified"
