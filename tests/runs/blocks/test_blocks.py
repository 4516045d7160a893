"""Whole runs with blocks: who works on them, and how they are interrupted, changes nothing."""

import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch
from two_blocks import EVERY, STEPS, params, same, stop_after

from surfkit.appearance.exposure import Exposure
from surfkit.cli import main
from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json
from surfkit.raster.select import select
from surfkit.runs import pipeline
from surfkit.runs.blocks import block_forecast as forecast
from surfkit.runs.blocks import train_blocks as schedule
from surfkit.runs.blocks import worker
from surfkit.runs.blocks.block import BlockRun
from surfkit.runs.blocks.train_blocks import Compute, Unfinished
from surfkit.runs.execute import Inline, Pool
from surfkit.runs.execute.block_state import read_state
from surfkit.runs.pipeline import load_run, run
from surfkit.runs.run_stage import Intervals
from surfkit.train import checkpoint, streaming
from surfkit.train.data_cache import CacheSettings


def test_what_a_run_leaves(undisturbed, data, recipe):
    plan = json.loads((undisturbed / "blocks" / "plan.json").read_text())["plan"]
    assert [block["points"] for block in plan["blocks"]] == [100, 100]
    assert (undisturbed / "blocks" / "plan.png").stat().st_size > 1_000
    assert all(read_state(undisturbed / "blocks" / name).status == "done" for name in ("000", "001"))
    gave = json.loads((undisturbed / "blocks" / "merge.json").read_text())
    assert gave["points"] == sum(block["kept"] for block in gave["blocks"]) == len(params(undisturbed)["means"])
    metrics = json.loads((undisturbed / "metrics.json").read_text())
    assert metrics["points"] == gave["points"] and metrics["images"]["psnr"] > 8
    assert metrics["steps"] == 2 * STEPS, "of both stages"
    stages = map(json.loads, (undisturbed / "events.jsonl").read_text().splitlines())
    assert sum(line["event"] == "StepDone" for line in stages) == STEPS, "blocks have journals of their own"
    loaded, state, _ = load_run(undisturbed)
    assert loaded.last.name == "tune" and state.index == STEPS


def test_merged_points_lie_in_their_block(undisturbed):
    """ViewCounts from the blocks' own results: what each owns of what it has come to, in their order."""
    plan = read_json(undisturbed / "blocks" / "plan.json", schedule.BlocksRecord).plan
    parts = []
    for index in range(2):
        state, _ = checkpoint.load_last(undisturbed / "blocks" / f"{index:03}" / "tune" / "checkpoint.safetensors")
        flat = plan.cells.ground.flat(state.points.params["means"])
        border = plan.cells.boxes[0][2]
        parts.append(state.points.params["means"][(flat[:, 0] < border) == (index == 0)])
    assert torch.equal(torch.cat(parts), params(undisturbed)["means"])


def test_tuning_changes_what_it_should(undisturbed):
    coarse = checkpoint.load_last(undisturbed / "pretrain" / "checkpoint.safetensors")[0].points.params
    assert coarse["means"].shape == params(undisturbed)["means"].shape
    assert not torch.equal(coarse["sh0"], params(undisturbed)["sh0"])


def test_a_pool_comes_to_the_same_bits(undisturbed, data, recipe, tmp_path):
    run(recipe, data, tmp_path, Compute("cpu", Pool(workers=2)), EVERY)
    assert same(tmp_path, undisturbed)
    again = run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    assert again["points"] == len(params(undisturbed)["means"])


@pytest.mark.usefixtures("forked_jobs")
def test_interrupted_in_a_block_and_continued(undisturbed, data, recipe, tmp_path, monkeypatch):
    """Ctrl-C between two steps of the second block; then another executor finishes."""
    train_block = schedule.train_block

    def stopped(ctx, block):
        if block.index == 1:
            ctx = replace(ctx, intervals=Intervals(checkpoint=4, pictures=0))
            monkeypatch.setattr(worker, "optimise", stop_after(worker.optimise, 6))
        return train_block(ctx, block)

    with monkeypatch.context() as patch:
        patch.setattr(schedule, "train_block", stopped)
        with pytest.raises(KeyboardInterrupt):
            run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    monkeypatch.undo()
    state = read_state(tmp_path / "blocks" / "001")
    assert (state.status, state.kind) == ("failed", "interrupted") and not (tmp_path / "metrics.json").exists()
    with pytest.raises(BadInput, match="not all blocks are tuned"):
        load_run(tmp_path)
    run(recipe, data, tmp_path, Compute("cpu", Pool(workers=1)), EVERY)
    assert same(tmp_path, undisturbed)


@pytest.mark.usefixtures("forked_jobs")
def test_a_worker_that_is_killed_is_tried_again(undisturbed, data, recipe, tmp_path, capsys):
    """The first process of block 0 kills itself in the middle of its steps; the next one goes on."""
    command = schedule.job_of

    def deadly(ctx, block, compute):
        job = command(ctx, block, compute)
        if block.index == 0 and not (tmp_path / "killed").exists():
            code = (
                "import os, sys, surfkit.runs.run_stage as o\nfrom pathlib import Path\nD = o.TrainingDisplay\n"
                "class K(D):\n    def show(self, done):\n        super().show(done)\n        if done.index == 7:\n"
                f"            Path({str(tmp_path / 'killed')!r}).touch(); os.kill(os.getpid(), 9)\n"
                f"o.TrainingDisplay = K\nfrom surfkit.cli import main\nsys.exit(main({list(job.command[2:])!r}))"
            )
            job = replace(job, command=("-c", code))
        return job

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule, "job_of", deadly)
        run(recipe, data, tmp_path / "run", Compute("cpu", Pool(workers=2)), EVERY)
    assert (
        tmp_path / "killed"
    ).exists() and "block 0 was ended by SIGKILL; it is tried again" in capsys.readouterr().err
    assert same(tmp_path / "run", undisturbed)


def test_a_block_that_always_fails_leaves_the_others(undisturbed, data, recipe, tmp_path, capsys):
    optimise = worker.optimise

    def failing(job, state):
        if job.stage.out.name == "001":
            raise Fault("numbers are not finite")
        return optimise(job, state)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker, "optimise", failing)
        with pytest.raises(Unfinished, match="block 1 failed: .*not finite") as told:
            run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    assert told.value.status == 3
    assert read_state(tmp_path / "blocks" / "000").status == "done"
    assert main(["status", str(tmp_path)]) == 3
    said = capsys.readouterr().out
    assert "1 of 2 done" in said and "failed (fault): numbers are not finite, step 0 of 12" in said
    run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    assert same(tmp_path, undisturbed)


def test_a_block_that_is_said_to_be_done(data, recipe, tmp_path, monkeypatch):
    """By a worker that does not see our disk, say; nothing of its work is here."""
    command = schedule.job_of
    monkeypatch.setattr(schedule, "FILE_ARRIVAL_S", 0.2)
    monkeypatch.setattr(schedule, "job_of", lambda *given: replace(command(*given), command=("-c", "pass")))
    with pytest.raises(Unfinished, match="block 1 failed: nothing of"):
        run(recipe, data, tmp_path, Compute("cpu", Pool(workers=2)), EVERY)


@pytest.mark.usefixtures("forked_jobs")
def test_the_driver_is_killed_and_started_again(undisturbed, data, recipe, tmp_path):
    """Its workers notice, save and leave; the same command finishes to the same bits."""
    recipe_file = undisturbed / "recipe.json"
    words = [
        "train",
        f"recipe:{recipe_file}",
        "--data",
        str(data.path),
        "--out",
        str(tmp_path / "run"),
        "--device",
        "cpu",
    ]
    words += ["executor:pool", "--executor.workers", "2", "--checkpoint-every", "4", "--pictures-every", "0"]
    driver = subprocess.Popen([sys.executable, "-m", "surfkit.cli", *words], stderr=subprocess.DEVNULL)
    while not any((tmp_path / "run" / "blocks").glob("00*/state.json")) and driver.poll() is None:
        time.sleep(0.01)
    driver.kill()
    driver.wait()
    assert main(words) == 0
    assert same(tmp_path / "run", undisturbed)


def test_another_coarse_model_puts_blocks_aside(data, recipe, tmp_path):
    run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    longer = replace(recipe, pretrain=replace(recipe.pretrain, steps=STEPS + 4))
    run(longer, data, tmp_path, Compute("cpu"), EVERY)
    assert (tmp_path / "blocks-before" / "000").is_dir()
    assert "blocks are tuned anew" in (tmp_path / "run.json").read_text()
    before = read_json(tmp_path / "blocks-before" / "plan.json", schedule.BlocksRecord)
    (tmp_path / "blocks" / "plan.json").unlink()
    run(longer, data, tmp_path, Compute("cpu"), EVERY)
    assert read_json(tmp_path / "blocks-before" / "plan.json", schedule.BlocksRecord) == before, (
        "nothing is overwritten"
    )
    assert (tmp_path / "blocks-before-2" / "000").is_dir() and "blocks-before-2" in (tmp_path / "run.json").read_text()


def test_a_block_that_was_deleted_is_tuned_again(undisturbed, data, recipe, tmp_path):
    shutil.copytree(undisturbed, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "blocks" / "001")
    (tmp_path / "run" / "point_cloud.ply").write_bytes(b"of an older merge")
    (tmp_path / "run" / "blocks" / ".surfkit-merge.json.7.part").write_bytes(b"of a process that is gone")
    run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert same(tmp_path / "run", undisturbed) and not list((tmp_path / "run").rglob(".surfkit-*"))


def test_blocks_of_a_finished_run_can_be_deleted(undisturbed, data, recipe, tmp_path, capsys):
    shutil.copytree(undisturbed, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "blocks")
    run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert "is finished" in capsys.readouterr().err and not (tmp_path / "run" / "blocks").exists()
    shutil.rmtree(tmp_path / "run" / "tune")
    run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert same(tmp_path / "run", undisturbed), "without the merged model they are tuned again"


def test_a_damaged_result_is_not_merged(undisturbed, data, recipe, tmp_path):
    """The merged model is gone, a checkpoint damaged: the block goes on from the one before, to the same bits."""
    shutil.copytree(undisturbed, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "tune")
    path = tmp_path / "run" / "blocks" / "000" / "tune" / "checkpoint.safetensors"
    content = path.read_bytes()
    path.write_bytes(content[:-8] + b"damaged!")
    run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert same(tmp_path / "run", undisturbed)
    assert "block 0 has lost steps" in (tmp_path / "run" / "run.json").read_text()


def test_a_longer_coarse_stage_makes_the_old_result_void(undisturbed, data, recipe, tmp_path, monkeypatch):
    shutil.copytree(undisturbed, tmp_path / "run")
    longer = replace(recipe, pretrain=replace(recipe.pretrain, steps=STEPS + 8))
    monkeypatch.setattr(pipeline, "optimise", stop_after(pipeline.optimise, STEPS + 3))
    with pytest.raises(KeyboardInterrupt):
        run(longer, data, tmp_path / "run", Compute("cpu"), EVERY)
    with pytest.raises(BadInput, match=f"step {STEPS + 3} of {STEPS + 8}"):
        load_run(tmp_path / "run")


def test_exposures_of_blocks_are_folded(data, recipe, tmp_path):
    tune = replace(recipe.tune, appearance=Exposure())
    metrics = run(replace(recipe, tune=tune), data, tmp_path, Compute("cpu"), EVERY)
    assert metrics["images"]["psnr_aligned"] > 8 and load_run(tmp_path)[1].appearances


def test_a_block_that_is_worked_on_is_left_alone(undisturbed, tmp_path, capsys):
    shutil.copytree(undisturbed, tmp_path / "run")
    folder = tmp_path / "run" / "blocks" / "000"
    before = (folder / "state.json").read_bytes()
    holding = "import sys, time\nfrom pathlib import Path\nfrom surfkit.core.lock import locked\n"
    holding += f"with locked(Path({str(folder)!r})):\n    print('held', flush=True)\n    time.sleep(3600)"
    other = subprocess.Popen([sys.executable, "-c", holding], stdout=subprocess.PIPE)
    try:
        assert other.stdout.readline() == b"held\n"
        assert main(["train-block", str(tmp_path / "run"), "0"]) == worker.BUSY_STATUS
    finally:
        other.kill()
        other.wait()
    assert "works in it" in capsys.readouterr().err and (folder / "state.json").read_bytes() == before


def test_a_plan_that_cannot_be(undisturbed, data, recipe, tmp_path):
    shutil.copytree(undisturbed, tmp_path / "run")
    path = tmp_path / "run" / "blocks" / "plan.json"
    sound = json.loads(path.read_text())
    for spoil in (
        lambda plan: plan["cells"].update(blocks=[0]),
        lambda plan: plan["cells"].update(blocks=[0, 0]),
        lambda plan: plan["blocks"].reverse(),
        lambda plan: plan["blocks"][0].update(views=["nowhere.png"]),
    ):
        record = json.loads(json.dumps(sound))
        spoil(record["plan"])
        path.write_text(json.dumps(record))
        with pytest.raises(BadInput, match="plan"):
            run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)


def test_blocks_of_a_plan_that_is_gone_are_put_aside(undisturbed, data, recipe, tmp_path):
    shutil.copytree(undisturbed, tmp_path / "run")
    (tmp_path / "run" / "blocks" / "plan.json").unlink()
    longer = replace(recipe, pretrain=replace(recipe.pretrain, steps=STEPS + 4))
    run(longer, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert (tmp_path / "run" / "blocks-before" / "000").is_dir()
    began = (tmp_path / "run" / "blocks" / "000" / "events.jsonl").read_text().splitlines()
    assert sum('"StepDone"' in line for line in began) == STEPS, "from the first step, not on top of the old ones"
    assert read_state(tmp_path / "run" / "blocks" / "000").attempts == 1


def test_tune_by_hand(undisturbed, tmp_path, capsys):
    assert main(["train-block", str(undisturbed), "0"]) == 0
    assert "block 0 has all its " in capsys.readouterr().err
    assert main(["train-block", str(undisturbed), "2"]) == 2 and "has blocks 0 to 1" in capsys.readouterr().err
    assert main(["train-block", str(tmp_path), "0"]) == 2


def test_a_block_begins_with_what_it_owns_and_what_its_views_show(undisturbed, monkeypatch):
    """From pieces of 7 points, against the whole coarse model and pictures of all of it."""
    monkeypatch.setattr(streaming, "PIECE_POINTS", 7)
    loaded, _, scene = load_run(undisturbed)
    plan = read_json(undisturbed / "blocks" / "plan.json", schedule.BlocksRecord).plan
    rasterizer = select("cpu")[0]
    ctx = worker.RunContext(loaded, scene, rasterizer, EVERY, CacheSettings())
    coarse = checkpoint.load(undisturbed / "pretrain" / "checkpoint.safetensors")
    splats = loaded.recipe.primitive.activate(coarse.points.params, coarse.sh_degree)
    for index in range(2):
        views = [view for view in scene.train if view.name in plan.blocks[index].views][:1]
        wanted = plan.cells.owner(coarse.points.params["means"]) == index
        wanted |= rasterizer.render(splats, views[0].camera, loaded.recipe.pretrain.near).seen
        begun = worker.BlockStart(ctx, BlockRun(loaded, plan, index), views)()
        found = begun.params
        assert begun.sh_degree == coarse.sh_degree == 3
        assert 100 < int(wanted.sum()) and found.keys() == coarse.points.params.keys()
        assert all(torch.equal(value, coarse.points.params[name][wanted]) for name, value in found.items())


def test_blocks_begin_with_the_harmonics_of_the_coarse_model(undisturbed):
    """And so does what they are merged into."""
    folders = [undisturbed / "blocks" / "000", undisturbed / "blocks" / "001", undisturbed]
    states = [checkpoint.load(folder / "tune" / "checkpoint.safetensors") for folder in folders]
    assert [state.sh_degree for state in states] == [3, 3, 3]


def test_a_block_is_tuned_without_the_data_set(undisturbed, data, recipe, tmp_path, capsys):
    """Only its photographs are there; afterwards all is as if it had been."""
    shutil.copytree(undisturbed, tmp_path / "run")
    folder = tmp_path / "run" / "blocks" / "001"
    (folder / "state.json").unlink()
    shutil.rmtree(folder / "tune")
    model, away = data.path / "sparse", tmp_path / "sparse"
    model.rename(away)
    try:
        assert main(["train-block", str(tmp_path / "run"), "1", "--device", "cpu"]) == 0
    finally:
        away.rename(model)
    run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert same(tmp_path / "run", undisturbed)
    (folder / "views.npz").write_bytes(b"damaged")
    (folder / "state.json").unlink()
    assert (
        main(["train-block", str(tmp_path / "run"), "1"]) == 2 and "views.npz cannot be used" in capsys.readouterr().err
    )
    run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert read_state(folder).status == "done"


def test_what_a_block_begins_with_is_foretold(undisturbed, data, recipe, tmp_path):
    """Not what it owns: what its views show is drawn, too. Its few views are all looked at here, so it is exact."""
    loaded, _, scene = load_run(undisturbed)
    plan = read_json(undisturbed / "blocks" / "plan.json", schedule.BlocksRecord).plan
    begun = read_state(undisturbed / "blocks" / "000").begun_points
    assert plan.blocks[0].begins == begun > plan.blocks[0].points
    fresh = worker.RunContext(replace(loaded, out=tmp_path), scene, select("cpu")[0], EVERY, CacheSettings())
    memory = [schedule.job_of(fresh, BlockRun(fresh.run, plan, 0), Compute("cpu")).memory_bytes]
    BlockRun(fresh.run, plan, 0).write(begun_points=begun + 10)
    memory.append(schedule.job_of(fresh, BlockRun(fresh.run, plan, 0), Compute("cpu")).memory_bytes)
    assert memory[1] - memory[0] == 10 * 3 * forecast.TRAINED_POINT_BYTES, "what it has really begun with counts more"


def test_an_inline_executor_is_the_default(recipe):
    assert Compute().workers == Inline() and Compute().device == "auto"


@pytest.mark.parametrize(
    "word",
    [["--tune.steps", "7"], ["tune.densify:none"], ["assign:airspace"], ["--min-views", "3"], ["--context", "frozen"]],
)
def test_settings_of_blocks_where_there_are_none(data, tmp_path, capsys, word):
    words = ["train", "recipe:2dgs", *word, "--data", str(data.path), "--out", str(tmp_path / "run")]
    assert main(words) == 2 and not (tmp_path / "run").exists()
    assert f"surfkit: {word[0]}: the recipe does not divide" in capsys.readouterr().err
