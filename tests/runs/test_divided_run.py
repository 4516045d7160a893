"""Whole runs by several processes: one that is killed ends all, another number of them goes on; what is refused."""

import multiprocessing
import os
import signal
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
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.runs.run_stage import Intervals
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint

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
