"""Whole runs whose points are kept in files: the same bits, also where a run goes on elsewhere or memory gives out."""

import json
import os
from dataclasses import replace

import pytest
import torch
from test_gpu_run import EVERY, STEPS, cloud, during, notes

from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput, Fault
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.primitives.storage import DiskStorage
from surfkit.runs import run_stage
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.adam import AdamInView
from surfkit.train.data_cache import CacheSettings
from surfkit.train.points_on import PointsOn


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    torch.set_num_threads(2)
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(width=48, height=36, points=200)))
    return Data(folder)


@pytest.fixture(scope="module")
def recipe():
    small = evolve(with_steps(recipes()["2dgs"], STEPS), "primitive.sh_degree", 1)
    return replace(evolve(evolve(small, "pretrain.densify.every", 5), "pretrain.densify.start", 4), mesh=None)


@pytest.fixture(scope="module")
def in_view(recipe):
    return evolve(recipe, "pretrain.optimizer", AdamInView())


@pytest.fixture(scope="module")
def whole(in_view, data, tmp_path_factory):
    """The cloud of a run whose points are in memory."""
    out = tmp_path_factory.mktemp("whole") / "run"
    run(in_view, data, out, intervals=EVERY, caches=on("device"))
    return cloud(out)


@pytest.fixture
def storages(monkeypatch):
    """Where the points are when a checkpoint is written."""
    found, save = [], checkpoint.save

    def saved(path, state):
        found.append(state.points.storage)
        save(path, state)

    monkeypatch.setattr(checkpoint, "save", saved)
    return found


def on(place, scratch=None):
    return CacheSettings(points=PointsOn(place, scratch))


def record(out):
    return json.loads((out / "run.json").read_text())


def test_same_bits_on_the_disk_also_of_a_run_that_goes_on_elsewhere(
    in_view,
    data,
    whole,
    tmp_path,
    storages,
    monkeypatch,
):
    out, scratch = tmp_path / "run", tmp_path / "scratch"
    scratch.mkdir()

    def stop():
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        during(patch, "view_gradients", 12, stop)
        with pytest.raises(KeyboardInterrupt):
            run(in_view, data, out, intervals=EVERY, caches=on("disk"))
    assert storages == [DiskStorage(folder=out / "pretrain")]
    assert [path.name for path in (out / "pretrain").iterdir()] == ["checkpoint.safetensors"]
    run(in_view, data, out, intervals=EVERY, caches=on("disk", scratch))
    assert storages[1:] == [DiskStorage(folder=scratch)] * 2 and not os.listdir(scratch)
    assert cloud(out) == whole
    assert record(out)["points_on"] == "disk"
    parts = record(out)["memory_bytes"]
    assert 0 <= parts["points"] <= parts["peak"]


def test_a_full_disk_ends_the_run_in_one_line_and_the_same_command_goes_on(
    in_view,
    data,
    whole,
    tmp_path,
    monkeypatch,
):
    out = tmp_path / "run"

    def full(*_):
        raise OSError(28, os.strerror(28))

    with monkeypatch.context() as patch:
        during(patch, "densify", 5, lambda: patch.setattr(os, "posix_fallocate", full))
        with pytest.raises(Fault, match="run/pretrain: the disk is full .*last checkpoint in .* is whole") as fault:
            run(in_view, data, out, intervals=replace(EVERY, checkpoint=4), caches=on("disk"))
    assert fault.value.kind == "disk" and "\n" not in str(fault.value)
    run(in_view, data, out, intervals=EVERY, caches=on("disk"))
    assert cloud(out) == whole


def test_auto_keeps_them_on_the_disk_when_memory_is_short(
    in_view,
    data,
    whole,
    tmp_path,
    storages,
    monkeypatch,
):
    free = iter([10**6] * 3 + [10**12] * 100)
    monkeypatch.setattr(run_stage, "free_bytes", lambda: next(free))
    monkeypatch.setattr(run_stage, "WATCH_EVERY", 5)
    out = tmp_path / "run"
    run(in_view, data, out, intervals=EVERY)
    assert [isinstance(each, DiskStorage) for each in storages] == [False, True, True]
    assert [text for text in notes(out) if "--points-on disk" in text and "step 15: only 0 MiB" in text]
    assert cloud(out) == whole and record(out)["points_on"] == "auto"


def test_a_recipe_whose_steps_need_all_points_is_refused_before_anything_is_written(recipe, data, tmp_path):
    with pytest.raises(
        BadInput, match="^--points-on disk .* pretrain.optimizer:adam is for all points; choose optimizer:adam-in-view"
    ):
        run(recipe, data, tmp_path / "run", caches=on("disk"))
    assert not (tmp_path / "run").exists()
