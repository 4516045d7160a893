"""A small scene in two blocks, for tests of blocks and executors: fixtures, and how to interrupt and compare runs."""

import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from surfkit.core.files import replacing
from surfkit.io.datasets.data import Data
from surfkit.partition import PictureShare, QuantileGrid
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_stage import Intervals
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.progress import TrainingDisplay
from surfkit.train.stage import Stage

STEPS = 12
EVERY = Intervals(checkpoint=4, pictures=0)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(views=16, width=32, height=24, points=200)))
    return Data(folder)


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """Two blocks, half of the points each; colours learn all degrees in pretraining, and none would while tuning."""
    stage = Stage(steps=STEPS, sh_every=1_000)
    return Recipe(
        pretrain=replace(stage, sh_every=STEPS // 3), partition=QuantileGrid((2, 1)), assign=PictureShare(), tune=stage
    )


@pytest.fixture(scope="module")
def undisturbed(data, recipe, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "run"
    run(recipe, data, out, Compute("cpu"), EVERY)
    return out


def params(out: Path) -> dict[str, torch.Tensor]:
    """Raw parameters of the merged model."""
    return checkpoint.load_last(out / "tune" / "checkpoint.safetensors")[0].points.params


def same(a: Path, b: Path) -> bool:
    one, other = params(a), params(b)
    cloud = (a / "point_cloud.ply").read_bytes() == (b / "point_cloud.ply").read_bytes()
    return cloud and all(torch.equal(value, other[name]) for name, value in one.items())


def await_sigterm(reached: Path) -> None:
    """Write the number of the parent process into a file, and wait until SIGTERM has come and was handled."""
    came, handler = [], signal.getsignal(signal.SIGTERM)

    def note(*given):
        came.append(1)
        handler(*given)

    signal.signal(signal.SIGTERM, note)
    with replacing(reached) as file:
        file.write(str(os.getppid()).encode())
    while not came:
        time.sleep(0.02)


def stop_after(optimise, step):
    """An `optimise` during which SIGINT comes after a step."""

    class Interrupting(TrainingDisplay):
        def show(self, done):
            super().show(done)
            if done.index == step:
                os.kill(os.getpid(), signal.SIGINT)

    def stopping(job, state):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("surfkit.runs.run_stage.TrainingDisplay", Interrupting)
            return optimise(job, state)

    return stopping
