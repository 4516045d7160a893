"""Whole runs by several processes: one that is killed ends all, another number of them goes on; what is refused."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch

from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput, Fault
from surfkit.core.events import StepDone
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.divided import Work, refuse_early_end
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.runs.run_stage import Intervals
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings
from surfkit.train.faults import in_one_line

pytestmark = pytest.mark.usefixtures("compiled")
TWO, EVERY, STEPS = Compute(device="cpu", processes=2), Intervals(checkpoint=5, pictures=0), 20


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(width=48, height=36, points=200)))
    return Data(folder)


@pytest.fixture(scope="module")
def recipe():
    small = evolve(with_steps(recipes()["2dgs"], STEPS), "primitive.sh_degree", 1)
    return replace(evolve(evolve(small, "pretrain.densify.every", 5), "pretrain.densify.start", 4), mesh=None)


class AfterStep:
    """Does something in this process after a step of another, once."""

    def __init__(self, index, action):
        self.index, self.action = index, action

    @hookimpl
    def surfkit_event(self, event):
        if isinstance(event, StepDone) and event.index >= self.index and self.action:
            action, self.action = self.action, None
            action()


@pytest.fixture
def after():
    """A function that lets something happen after a step."""
    there = []

    def register(index, action):
        there.append(plugins().register(AfterStep(index, action), f"after step {index}"))

    yield register
    for index in (7, 8):
        if plugins().has_plugin(f"after step {index}"):
            plugins().unregister(name=f"after step {index}")


def test_a_killed_process_ends_all_and_one_alone_goes_on(data, recipe, tmp_path, after):
    out = tmp_path / "run"
    after(7, lambda: os.kill(multiprocessing.active_children()[-1].pid, signal.SIGKILL))
    with pytest.raises(Fault, match="process . was ended by signal 9; all 2 have been ended; the last checkpoint is"):
        run(recipe, data, out, TWO, EVERY)
    assert not multiprocessing.active_children()
    begun = checkpoint.load(out / "pretrain" / "checkpoint.safetensors")
    assert 5 <= begun.index < STEPS and begun.index % 5 == 0

    metrics = run(recipe, data, out, Compute(device="cpu"), EVERY)
    state = checkpoint.load(out / "pretrain" / "checkpoint.safetensors")
    assert state.index == STEPS and metrics["points"] == len(state.points) and (out / "point_cloud.ply").exists()


def test_an_interrupted_run_is_saved_and_goes_on(data, recipe, tmp_path, after):
    out = tmp_path / "run"
    after(8, lambda: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(KeyboardInterrupt):
        run(recipe, data, out, TWO, EVERY)
    saved = checkpoint.load(out / "pretrain" / "checkpoint.safetensors")
    assert 8 <= saved.index < STEPS and not multiprocessing.active_children()
    run(recipe, data, out, TWO, EVERY)
    state = checkpoint.load(out / "pretrain" / "checkpoint.safetensors")
    assert state.index == STEPS and all(torch.isfinite(value).all() for value in state.points.params.values())


def test_ctrl_c_of_a_terminal_is_passed_on_by_the_one_that_has_started_them_alone(data, recipe, tmp_path, after):
    """A terminal sends it to all of them, also while they start, when it would be told with a trace of each."""
    after(7, lambda: [os.kill(each.pid, signal.SIGINT) for each in multiprocessing.active_children()])
    run(recipe, data, tmp_path / "run", TWO, EVERY)
    assert checkpoint.load(tmp_path / "run" / "pretrain" / "checkpoint.safetensors").index == STEPS


def test_the_processes_end_with_the_one_that_has_started_them(data, tmp_path):
    """Else they would train on, and write into the folder, beside the run that goes on there."""
    out, words = (
        tmp_path / "run",
        "train recipe:2dgs mesh:none --device cpu --processes 2 --steps 100000 --checkpoint-every 1".split(),
    )
    command = [
        sys.executable,
        "-m",
        "surfkit",
        *words,
        "--data",
        str(data.path),
        "--out",
        str(out),
        "--checkpoint-every",
        "1",
    ]
    given = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": {**os.environ, "TMPDIR": str(tmp_path)}}
    with subprocess.Popen(command, **given) as started:
        try:
            for _ in range(600):
                workers = started_by(started.pid)
                if len(list(out.glob("pretrain/checkpoint*.safetensors"))) == 2:  # of the beginning, and theirs
                    break
                time.sleep(0.1)
        finally:
            started.kill()
    assert len(workers) == 2
    for _ in range(200):
        if not any(map(is_running, workers)):
            assert not list(tmp_path.glob("surfkit-processes-*")), "where they have found each other"
            return
        time.sleep(0.1)
    for number in workers:
        os.kill(number, signal.SIGKILL)
    pytest.fail("they are still there")


def started_by(number):
    """Numbers of the processes that train for another."""
    listed = subprocess.run(["ps", "-ww", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True).stdout
    rows = (line.split(None, 2) for line in listed.splitlines())
    return [int(pid) for pid, parent, *words in rows if int(parent) == number and "spawn_main" in "".join(words)]


def is_running(number):
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(number)], capture_output=True, text=True).stdout.strip()
    return bool(state) and not state.startswith("Z")


def test_a_full_disk_is_told_as_in_a_run_of_one_process(data, recipe, tmp_path):
    at = Run(tmp_path / "run", recipe, data).pretrain
    work = Work(Run(tmp_path / "run", recipe, data), at, EVERY, CacheSettings(), 2, 1, "")
    with pytest.raises(Fault, match="x.safetensors: the disk is full"), in_one_line(tmp_path):
        refuse_early_end(
            work, [1, 1], {"disk": (28, "No space left on device", "x.safetensors"), "crash": (1, "silence")}
        )


@pytest.mark.parametrize(
    "name, processes, text",
    [
        ("citygs2", 2, "divides the scene into blocks"),
        ("lightgaussian", 2, "refine.0 works on the whole model"),
        ("import", 2, "trains no points"),
        ("2dgs", 65, "give 1 to 64"),
        ("surface", 2, "does not work with several processes"),
    ],
)
def test_runs_that_are_not_divided_are_refused_before_anything_is_written(name, processes, text, data, tmp_path):
    recipe = replace(recipes()[name], mesh=None)
    with pytest.raises(BadInput) as refused:
        run(recipe, data, tmp_path / "run", replace(TWO, processes=processes), EVERY)
    assert text in str(refused.value)
    assert not list((tmp_path / "run").glob("*.json"))
