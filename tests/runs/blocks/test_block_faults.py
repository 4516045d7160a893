"""What gives out while blocks are tuned: memory, disk, and patience with another process in the folder."""

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from surfkit.cli import main
from surfkit.core.check import BadInput, Fault
from surfkit.densify import PointCap
from surfkit.densify.adc import ADC
from surfkit.densify.base import Densify, Step
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import map_path, write_map, write_record
from surfkit.io.datasets.depth_prior import alignment
from surfkit.io.datasets.read import read as read_scene
from surfkit.losses.depth import DepthRegression
from surfkit.partition import PictureShare, QuantileGrid
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points
from surfkit.runs.blocks import block_forecast as forecast
from surfkit.runs.blocks import train_blocks as schedule
from surfkit.runs.blocks import worker
from surfkit.runs.blocks.block import BlockRun, read_plan
from surfkit.runs.blocks.oom_retry import NO_CACHE, NO_GROWTH, START_AGAIN, apply_fallback, next_fallback
from surfkit.runs.blocks.train_blocks import Compute, Unfinished
from surfkit.runs.execute import Pool, base
from surfkit.runs.execute.base import Job, JobResult
from surfkit.runs.execute.block_state import BlockState, read_state, write_state
from surfkit.runs.pipeline import opened, run
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_stage import Intervals
from surfkit.scene import available_memory as memory
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings
from surfkit.train.faults import DiskFull, Diverged, OutOfMemory
from surfkit.train.stage import Stage
from surfkit.train.trainer import Trainer

STEPS = 12
EVERY = Intervals(checkpoint=3, pictures=0)
GROWING = ADC(threshold=1e-12, start=3, every=4, until=9, cull_opacity=0.0)
"""Twice as many points after step 4, and again after step 8."""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(views=16, width=32, height=24, points=200)))
    return Data(folder)


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """Two blocks, whose points multiply."""
    stage = Stage(steps=STEPS)
    tune = replace(stage, sh_every=1, densify=GROWING)
    return Recipe(pretrain=stage, partition=QuantileGrid((2, 1)), assign=PictureShare(), tune=tune)


@pytest.fixture(scope="module")
def undisturbed(data, recipe, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "run"
    run(recipe, data, out, Compute("cpu"), EVERY)
    return out


def without_block_0(undisturbed: Path, out: Path) -> Path:
    """A copy of a run in which one block is still to be tuned: fewer processes to wait for."""
    shutil.copytree(undisturbed, out)
    shutil.rmtree(out / "tune")
    shutil.rmtree(out / "blocks" / "000")
    return out


def points_of(out: Path, index: int) -> int:
    return len(checkpoint.load_last(out / "blocks" / f"{index:03}" / "tune" / "checkpoint.safetensors")[0].points)


def notes(out: Path) -> list[str]:
    return json.loads((out / "run.json").read_text())["notes"]


def same(a: Path, b: Path) -> bool:
    return (a / "point_cloud.ply").read_bytes() == (b / "point_cloud.ply").read_bytes()


def short_above(limit: int, patch: pytest.MonkeyPatch, block: int = 0, on_gpu: bool = False) -> None:
    """Memory gives out in a block whenever it has more than some points."""
    wanted = "Tried to allocate 20.00 GiB"
    optimise, step = worker.optimise, Trainer.step

    def optimising(job, state):
        def short(self, state):
            if job.stage.block == block and len(state.points) > limit:
                if on_gpu:
                    raise torch.OutOfMemoryError(f"CUDA out of memory. {wanted}")
                raise RuntimeError(f"DefaultCPUAllocator: can't allocate memory. {wanted}")
            return step(self, state)

        patch.setattr(Trainer, "step", short)
        return optimise(job, state)

    patch.setattr(worker, "optimise", optimising)


@pytest.mark.parametrize("on_gpu", [False, True])
def test_a_block_for_which_memory_is_short_stops_to_grow(
    undisturbed, data, recipe, tmp_path, monkeypatch, capsys, on_gpu
):
    """It has about 200 points in its last checkpoint when it comes to 400; with 300 it would fit."""
    before = points_of(undisturbed, 0)
    with monkeypatch.context() as patch:
        short_above(300, patch, on_gpu=on_gpu)
        run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    state = read_state(tmp_path / "blocks" / "000")
    assert (state.status, state.fallback, state.attempts, state.kind) == ("done", NO_GROWTH, 3, None)
    assert points_of(tmp_path, 0) <= state.most_points == 199 < 700 < before
    assert read_state(tmp_path / "blocks" / "001").fallback == 0 and points_of(tmp_path, 1) > 700
    said = notes(tmp_path)
    where, kept = ("GPU ", "not") if on_gpu else ("", "no longer")
    failed = next(text for text in said if text.startswith(f"block 0 failed: out of {where}memory"))
    assert f"photographs are {kept} kept in it; it is tried again: photographs are not kept" in failed
    assert any("block 0: after" in text and "at most 199 points from step 3" in text for text in said)
    assert said[-1].startswith("block 0 was tuned with less") and "at most 199 points from step 3" in said[-1]
    capsys.readouterr()
    main(["status", str(tmp_path)])
    told = capsys.readouterr().out
    assert "then at most 199 points from step 3" in " ".join(told.split())
    run(recipe, data, tmp_path, Compute("cpu"), EVERY)  # and it is not forgotten
    assert notes(tmp_path) == said


def test_a_block_too_large_since_its_checkpoint_begins_anew(data, recipe, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        short_above(300, patch)
        run(recipe, data, tmp_path, Compute("cpu"), replace(EVERY, checkpoint=4))
    state = read_state(tmp_path / "blocks" / "000")
    assert (state.fallback, state.most_points, state.begun_points) == (START_AGAIN, 199, 199) and points_of(
        tmp_path, 0
    ) <= 199
    assert state.reduced[1:] == ("at most 390 points from step 4 on", "started again, at most 199 points")


def test_a_block_that_never_fits_fails_and_may_be_tried_elsewhere(data, recipe, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        short_above(100, patch)
        with pytest.raises(Unfinished, match="block 0 failed: out of memory .*more blocks"):
            run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    state = read_state(tmp_path / "blocks" / "000")
    assert (state.kind, state.fallback, state.attempts) == ("oom", NO_GROWTH, 3), (
        "it has not grown: nothing to begin anew for"
    )
    assert read_state(tmp_path / "blocks" / "001").status == "done"
    run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    state = read_state(tmp_path / "blocks" / "000")
    assert (state.status, state.fallback) == ("done", NO_GROWTH), "the same command goes on from the rung"


@pytest.mark.usefixtures("forked_jobs")
def test_a_worker_without_memory_comes_down_the_ladder(undisturbed, data, recipe, tmp_path, monkeypatch):
    """Real processes with a real limit: 10 MB for each point, and 3 GB more than the program has."""
    command, out = schedule.job_of, without_block_0(undisturbed, tmp_path / "run")
    write_state(
        out / "blocks" / "000",
        read_state(out / "blocks" / "000"),
        fallback=NO_CACHE,
        reduced=("photographs not kept in memory",),
    )

    def limited(ctx, block, compute):
        job = command(ctx, block, compute)
        code = (
            "import resource, sys, psutil, torch\nfrom surfkit.cli import main\nimport surfkit.apps.train_block\n"
            "from surfkit.train.trainer import Trainer\nstep = Trainer.step\n"
            "def hungry(self, state):\n    held = torch.empty(10_000_000 * len(state.points), dtype=torch.uint8)\n"
            "    return step(self, state)\nTrainer.step = hungry\n"
            "most = psutil.Process().memory_info().vms + 3_000_000_000\n"
            "resource.setrlimit(resource.RLIMIT_AS, (most, most))\n"
            f"sys.exit(main({list(job.command[2:])!r}))"
        )
        return replace(job, command=("-c", code))

    with monkeypatch.context() as patch:
        patch.setattr(schedule, "job_of", limited)
        run(recipe, data, out, Compute("cpu", Pool(workers=2)), EVERY)
    state = read_state(out / "blocks" / "000")
    log = (out / "blocks" / "000" / "log.txt").read_text()
    assert (state.status, state.fallback, state.most_points) == ("done", NO_GROWTH, 199), log
    assert any("block 0: after" in text and "at most 199 points" in text for text in notes(out)), "a worker's note"
    assert "are lowered from" not in log, "on its rung there is no cache to lower"


@pytest.mark.usefixtures("forked_jobs")
def test_a_worker_that_the_system_ends_for_want_of_memory(undisturbed, data, recipe, tmp_path, monkeypatch):
    """SIGKILL, and the system counts one more; the first rung leaves the result as it is."""
    command, kills, out = schedule.job_of, iter([7, 8, 8]), without_block_0(undisturbed, tmp_path / "run")

    def deadly(ctx, block, compute):
        job = command(ctx, block, compute)
        first = block.index == 0 and not read_state(job.folder).error
        return replace(job, command=("-c", "import os; os.kill(os.getpid(), 9)")) if first else job

    with monkeypatch.context() as patch:
        patch.setattr(schedule, "job_of", deadly)
        patch.setattr(base, "oom_kills", lambda: next(kills))
        run(recipe, data, out, Compute("cpu", Pool(workers=2)), EVERY)
    assert read_state(out / "blocks" / "000").fallback == NO_CACHE and same(out, undisturbed)
    assert any("ended by SIGKILL while memory ran out" in text for text in notes(out))
    assert not any("less than the recipe" in text for text in notes(out))


@pytest.mark.parametrize("kind", [None, "oom", "lost", "crash"])
def test_the_kind_of_a_failure_is_what_the_executor_reports(undisturbed, kind):
    """Whatever words its reason has."""
    loaded = opened(undisturbed)
    plan = read_plan(loaded).plan
    for why, status in (("an OutOfMemoryError, or OUT_OF_MEMORY", 70), (None, -9)):
        block = BlockRun(replace(loaded, out=loaded.out / "elsewhere"), plan, 0)
        told = schedule.record_failure(block, JobResult(Job(0, block.folder, lambda: 0, ()), status, why, kind))
        assert told.startswith(f"failed: {why}" if why else "was ended by SIGKILL")
        assert read_state(block.folder).kind == block.state.kind == (kind or "crash")
        assert block.is_out_of_memory == (kind == "oom")
    shutil.rmtree(loaded.out / "elsewhere")


def test_the_system_counts_whom_it_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "CGROUP_ROOT", tmp_path)
    monkeypatch.setattr(memory, "PROCESS_CGROUP", tmp_path / "own")
    monkeypatch.setattr(memory, "VMSTAT", tmp_path / "vmstat")
    assert memory.oom_kills() == 0
    (tmp_path / "vmstat").write_text("nr_free_pages 7\noom_kill 4\n")
    assert memory.oom_kills() == 4
    (tmp_path / "own").write_text("0::/job\n")
    (tmp_path / "job").mkdir()
    (tmp_path / "job" / "memory.events").write_text("low 0\noom 2\noom_kill 1\n")
    assert memory.oom_kills() == 1
    (tmp_path / "own").write_text("4:memory:/old\n")
    (tmp_path / "memory" / "old").mkdir(parents=True)
    (tmp_path / "memory" / "old" / "memory.oom_control").write_text("oom_kill_disable 0\nunder_oom 0\noom_kill 3\n")
    assert memory.oom_kills() == 3


def test_fallbacks():
    assert (
        next_fallback(BlockState(), None).number == NO_CACHE
        and next_fallback(BlockState(fallback=NO_CACHE), None) is None
    )
    assert next_fallback(BlockState(fallback=NO_GROWTH, most_points=9, begun_points=9), GROWING) is None
    assert next_fallback(BlockState(fallback=START_AGAIN, most_points=9, begun_points=5), GROWING) is None


@dataclass(frozen=True)
class Splitting(Densify):
    """Of a package outside this repository: neither a cap nor filters."""

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Split every point."""
        return Edit(split=torch.ones(len(points), dtype=torch.bool))


def test_after_memory_ran_out_any_densifier_goes_on_with_a_limit(undisturbed, data, recipe, tmp_path):
    """Not one that has a setting for it alone: it is neither left as it is nor left out."""
    loaded = opened(undisturbed)
    for densify, wanted in ((Splitting(), PointCap(Splitting(), 300)), (GROWING, GROWING.limited(300)), (None, None)):
        changed = replace(loaded.recipe, tune=replace(loaded.recipe.tune, densify=densify))
        block = BlockRun(replace(loaded, out=tmp_path, recipe=changed), read_plan(loaded).plan, 0)
        assert apply_fallback(block, CacheSettings())[0] == block.stage
        block.write(fallback=NO_GROWTH, most_points=300)
        stage, caches = apply_fallback(block, CacheSettings())
        assert stage.stage.densify == wanted and caches.cache == "0"
        (block.folder / "state.json").unlink()


def test_a_state_of_an_older_version_is_read(tmp_path):
    write_state(tmp_path, BlockState(), status="done")
    path = tmp_path / "state.json"
    older = json.loads(path.read_text())
    older = {name: value for name, value in older.items() if name not in ("fallback", "reduced")}
    path.write_text(json.dumps(older | {"rung": 2, "eased": ["at most 9 points"]}))
    state = read_state(tmp_path)
    assert (state.status, state.fallback, state.reduced) == ("done", NO_GROWTH, ("at most 9 points",))
    path.write_text(json.dumps(older | {"rungs": 2}))
    with pytest.raises(BadInput, match="rungs.*delete it"):
        read_state(tmp_path)


@pytest.mark.parametrize("workers", [None, Pool(workers=2)])
def test_a_disk_that_fills_while_blocks_are_tuned(undisturbed, data, recipe, tmp_path, monkeypatch, workers):
    """Room for what is small only: one line, the last checkpoint stays, and later the same bits."""
    out, limits = without_block_0(undisturbed, tmp_path / "run"), resource.getrlimit(resource.RLIMIT_FSIZE)
    compute = Compute("cpu") if workers is None else Compute("cpu", workers)
    size = (undisturbed / "pretrain" / "checkpoint.safetensors").stat().st_size
    train = schedule.train_waiting

    def limited(*args):
        resource.setrlimit(resource.RLIMIT_FSIZE, (2 * size, limits[1]))  # enough before points multiply twice
        return train(*args)

    monkeypatch.setattr(schedule, "train_waiting", limited)
    try:
        with pytest.raises(DiskFull, match=r"block \d failed: .*the disk is full"):
            run(recipe, data, out, compute, EVERY)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    last, damage = checkpoint.load_last(out / "blocks" / "000" / "tune" / "checkpoint.safetensors")
    assert read_state(out / "blocks" / "000").kind == "disk" and not list(out.rglob(".surfkit-*"))
    assert 0 < last.index < STEPS and damage is None
    monkeypatch.setattr(schedule, "train_waiting", train)
    run(recipe, data, out, Compute("cpu"), EVERY)
    assert same(out, undisturbed)


def test_blocks_do_not_begin_without_room(undisturbed, data, recipe, tmp_path, monkeypatch, capsys):
    whole = (undisturbed / "pretrain" / "checkpoint.safetensors").stat().st_size
    usage = type("Usage", (), {"free": whole // 2})
    monkeypatch.setattr(forecast.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(BadInput, match=r"at least \S+ MB of disk"):
        run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    assert not list((tmp_path / "blocks").glob("00*"))
    usage.free = 2 * whole
    monkeypatch.setattr(forecast, "free_bytes", lambda: 1 << 20)
    run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    said = notes(tmp_path)
    assert any("may need about" in text and "of disk" in text for text in said)
    assert any("may need about" in text and "of memory" in text for text in said)
    assert re.search(rf"{2 * STEPS} steps to tune, about \d:\d\d", capsys.readouterr().err)


def test_two_drivers_in_one_folder(undisturbed, data, tmp_path, capsys):
    """The second is refused, while the coarse model is made and while blocks are tuned; the first is not disturbed.

    The first stops itself after three steps of each, until it is told to go on.
    """
    out = tmp_path / "run"
    words = ["train", f"recipe:{undisturbed / 'recipe.json'}", "--data", str(data.path), "--out", str(out)]
    words += ["--device", "cpu", "--checkpoint-every", "3", "--pictures-every", "0"]
    halting = (
        "import os, signal, sys, surfkit.runs.run_stage as o\nD = o.TrainingDisplay\n"
        "class Halting(D):\n    def show(self, done):\n        super().show(done)\n"
        "        if done.index == 3: os.kill(os.getpid(), signal.SIGSTOP)\n"
        f"o.TrainingDisplay = Halting\nfrom surfkit.cli import main\nsys.exit(main({words!r}))"
    )
    driver = subprocess.Popen([sys.executable, "-c", halting], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        for there in ("events.jsonl", "blocks/000/state.json", "blocks/001/state.json"):
            assert os.WIFSTOPPED(os.waitpid(driver.pid, os.WUNTRACED)[1]) and (out / there).exists()
            before = {file: file.stat().st_mtime_ns for file in out.rglob("*")}
            assert main(words) == 2
            assert f"{out}: process {driver.pid} on " in capsys.readouterr().err
            assert {file: file.stat().st_mtime_ns for file in out.rglob("*")} == before
            os.kill(driver.pid, signal.SIGCONT)
        assert driver.wait(120) == 0
    finally:
        driver.kill()
        driver.wait()
    assert same(out, undisturbed)


def test_depth_priors_of_a_block_are_those_of_the_scene(tmp_path, recipe, monkeypatch, capsys):
    """Each block's typical depth is that of all photographs, and a map far from the others stays out in both."""
    truth = photograph(Flight(views=12, width=32, height=24, points=300))
    write_colmap(tmp_path / "data", truth, tracks=True)
    for at, (name, exact) in enumerate(truth.exact.items()):
        inverse = truth.scene.frame.scale / exact.depth.clamp_min(1e-9).numpy()
        write_map(tmp_path / "data", name, inverse * (30 if at == 3 else 1), (exact.depth > 0).float().numpy())
    write_record(tmp_path / "data", {"aligned": False})
    assert map_path(tmp_path / "data", "view_003.png").exists()
    read, given = worker.read_ahead, []

    def reading(data, scene, losses, caches, known):
        given.append((scene, read(data, scene, losses, caches, known)))
        return given[-1][1]

    monkeypatch.setattr(worker, "read_ahead", reading)
    deep = {"losses": recipe.tune.losses | {"depth": DepthRegression()}}
    pretrain, tune = replace(recipe.pretrain, **deep), replace(recipe.tune, **deep)
    apart = replace(recipe, pretrain=pretrain, tune=tune, assign=PictureShare(0.6))
    run(apart, Data(tmp_path / "data"), tmp_path / "run", Compute("cpu"), EVERY)
    whole = alignment(Data(tmp_path / "data"), read_scene(Data(tmp_path / "data")))
    assert len(given) == 2 and len(whole.fits) == 9
    for scene, material in given:
        names = {view.name for view in scene.train}
        priors = dict(zip([view.name for view in scene.train], material.priors, strict=True))
        assert len(names) < 10 and {n for n, prior in priors.items() if prior is not None} == whole.fits.keys() & names
        assert {prior.typical for prior in priors.values() if prior is not None} == {whole.typical}
        assert alignment(Data(tmp_path / "data"), scene).typical != whole.typical
    assert sum("train without a depth prior" in text for text in notes(tmp_path / "run")) == 1
    assert capsys.readouterr().err.count("train without a depth prior") == 1, "and not by every block"


def test_numbers_that_stay_infinite_fail_a_block(data, recipe, tmp_path, monkeypatch):
    """It goes back to its checkpoint twice, and is not begun again."""
    optimise, step = worker.optimise, Trainer.step

    def optimising(job, state):
        def spoilt(self, state):
            if job.stage.block == 1 and state.index == 7:
                raise Diverged(8, "view_001.png", "the losses are nan")
            return step(self, state)

        monkeypatch.setattr(Trainer, "step", spoilt)
        return optimise(job, state)

    monkeypatch.setattr(worker, "optimise", optimising)
    with pytest.raises(Unfinished, match="block 1 failed: .*losses are nan.* 2 times"):
        run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    states = [read_state(tmp_path / "blocks" / name) for name in ("000", "001")]
    assert [(state.status, state.kind, state.attempts) for state in states] == [("done", None, 1), ("failed", "nan", 1)]
    assert sum("block 1: step 8" in text and "back to step 6" in text for text in notes(tmp_path)) == 2


def test_faults_have_kinds(tmp_path):
    assert Fault("x").kind == "fault" and OutOfMemory("x", "y").kind == "oom" and DiskFull(tmp_path, "x").kind == "disk"
    for kind in ("oom", "nan", "disk", "data", "fault", "crash", "interrupted"):
        assert write_state(tmp_path, read_state(tmp_path), kind=kind) and read_state(tmp_path).kind == kind
