"""Whole runs whose points are kept elsewhere than where they are drawn, from the begin or from where memory gave out."""

import json
import os
from dataclasses import replace

import pytest
from test_gpu_run import EVERY, cloud, data, during, gpu, notes, recipe  # noqa: F401  (fixtures)

from surfkit.core.check import BadInput, Fault
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.primitives.storage import DiskStorage
from surfkit.runs import run_stage
from surfkit.runs.pipeline import run
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings
from surfkit.train.points_on import PointsOn


@pytest.fixture(scope="module")
def in_view(recipe):  # noqa: F811
    return evolve(recipe, "pretrain.update", "in-view")


@pytest.fixture(scope="module")
def whole(in_view, data, tmp_path_factory):  # noqa: F811
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
    in_view, data, whole, tmp_path, storages, monkeypatch  # noqa: F811
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
    in_view, data, whole, tmp_path, monkeypatch  # noqa: F811
):
    out = tmp_path / "run"

    def full(*_):
        raise OSError(28, os.strerror(28))

    with monkeypatch.context() as patch:
        during(patch, "densify", 5, lambda: patch.setattr(os, "posix_fallocate", full))
        with pytest.raises(Fault, match=r"run/pretrain: the disk is full .*last checkpoint in .* is whole: free some") as fault:
            run(in_view, data, out, intervals=replace(EVERY, checkpoint=4), caches=on("disk"))
    assert fault.value.kind == "disk" and "\n" not in str(fault.value)
    run(in_view, data, out, intervals=EVERY, caches=on("disk"))
    assert cloud(out) == whole


def test_auto_keeps_them_on_the_disk_when_memory_is_short(
    in_view, data, whole, tmp_path, storages, monkeypatch  # noqa: F811
):
    free = iter([10**6] * 3 + [10**12] * 100)
    monkeypatch.setattr(run_stage, "free_bytes", lambda: next(free))
    monkeypatch.setattr(run_stage, "WATCH_EVERY", 5)
    out = tmp_path / "run"
    run(in_view, data, out, intervals=EVERY)
    assert [isinstance(each, DiskStorage) for each in storages] == [False, True, True]
    assert [text for text in notes(out) if "--points-on disk" in text and "step 15: only 0 MiB" in text]
    assert cloud(out) == whole and record(out)["points_on"] == "auto"


def test_auto_keeps_them_on_the_host_when_the_gpu_is_full(
    gpu, in_view, data, tmp_path, storages, monkeypatch  # noqa: F811
):
    """The state after the last step is kept, and the run goes on from there."""
    next_home = run_stage.next_home

    def full():
        if not notes(out):
            gpu.limit = gpu.held + 20_000

    def more_room(*given):
        gpu.limit = None
        return next_home(*given)

    during(monkeypatch, "view_gradients", 14, full)
    monkeypatch.setattr(run_stage, "next_home", more_room)
    out = tmp_path / "run"
    run(in_view, data, out, intervals=EVERY, caches=replace(on("auto"), gpu="0"))
    assert [text for text in notes(out) if "step 14: the memory of the GPU gave out; points are kept in the mem" in text]
    assert storages[-1].device.type == "cpu" and not isinstance(storages[-1], DiskStorage)


def test_a_recipe_whose_steps_need_all_points_is_refused_before_anything_is_written(recipe, data, tmp_path):  # noqa: F811
    with pytest.raises(BadInput, match="^--points-on disk .* pretrain.update is all; set it to in-view"):
        run(recipe, data, tmp_path / "run", caches=on("disk"))
    assert not (tmp_path / "run").exists()
