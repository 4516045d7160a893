"""A whole run on a simulated GPU: what it tells of the memory there, and how it ends where that gives out."""

import json
from dataclasses import replace

import pytest
import torch

from surfkit.apps.report.run_files import read_source
from surfkit.apps.report.sections.resources_section import resources
from surfkit.apps.run_summary import result_rows
from surfkit.apps.status import rows
from surfkit.cli.recipes import recipes
from surfkit.core.check import Fault
from surfkit.core.tree import evolve
from surfkit.evaluate.images.measure_images import evaluate_views
from surfkit.io.datasets.data import Data
from surfkit.raster.select import select
from surfkit.runs import measure_run as measure
from surfkit.runs import pipeline, run_stage
from surfkit.runs.pipeline import Intervals, run
from surfkit.runs.recipe import with_steps
from surfkit.runs.run_status import status
from surfkit.testing.simulated_gpu import OnSimulatedGpu, is_there, simulated_gpu
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint, trainer
from surfkit.train.adam import AdamInView
from surfkit.train.data_cache import CacheSettings

STEPS = 20
EVERY = Intervals(checkpoint=8, pictures=0)


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


@pytest.fixture
def gpu(monkeypatch):
    rasterizer = OnSimulatedGpu(select("cpu")[0])
    monkeypatch.setattr(pipeline, "select_rasterizer", lambda device: (rasterizer, "simulated GPU"))
    with simulated_gpu() as found:
        yield found


def cloud(out):
    return (out / "point_cloud.ply").read_bytes()


def during(monkeypatch, name, at, act):
    """Let `act` be called when a part of step `at` is, before it; each time it comes there."""
    part = getattr(trainer, name)

    def called(setup, state, *given):
        if state.index + 1 == at:
            act()
        return part(setup, state, *given)

    monkeypatch.setattr(trainer, name, called)


def test_its_memory_is_told_beside_that_of_the_cpu(gpu, data, recipe, tmp_path):
    metrics = run(recipe, data, tmp_path / "run", intervals=EVERY)
    parts = dict(metrics["gpu_memory_bytes"])
    peak = parts.pop("peak")
    assert peak == metrics["peak_gpu_bytes"] > 0 and sum(parts.values()) == peak
    assert parts["photographs"] == 10 * 3 * 48 * 36 and parts["points"] > 0 and parts["steps"] > 0
    assert json.loads((tmp_path / "run" / "run.json").read_text())["gpu_memory_bytes"] == metrics["gpu_memory_bytes"]
    words = f"{peak / 1e6:.0f} MB"
    assert dict(result_rows(metrics))["peak GPU memory"] == words
    found = status(tmp_path / "run")
    assert 0 < found.peak_gpu_bytes <= peak and "peak GPU memory" in dict(rows(found))
    text = str(resources([read_source(tmp_path / "run", "run", 1)]))
    assert "peak GPU memory" in text and "The most memory of the GPU" in text


def test_held_out_photographs_are_measured_there(gpu, data, recipe, tmp_path, monkeypatch):
    drawn = []

    def measured(views, photos, draw, **given):
        drawn.extend(is_there(each(views[0]).color) for each in (draw, given["timed"]))
        return evaluate_views(views, photos, draw, **given)

    monkeypatch.setattr(measure, "evaluate_views", measured)
    metrics = run(with_steps(recipe, 2), data, tmp_path / "run", intervals=EVERY)
    assert drawn == [True, True] and metrics["images"]["psnr"] > 5 and metrics["fps"] > 0


def test_nothing_is_told_of_a_gpu_without_one(data, recipe, tmp_path):
    metrics = run(recipe, data, tmp_path / "run", intervals=EVERY)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    told = [*metrics, *record, *dict(result_rows(metrics)), *dict(rows(status(tmp_path / "run")))]
    assert not [name for name in told if "gpu" in name.lower()]
    assert "GPU" not in str(resources([read_source(tmp_path / "run", "run", 1)]))


def test_where_it_gives_out_for_good_the_last_step_is_kept_and_the_same_command_goes_on(
    gpu, data, recipe, tmp_path, monkeypatch
):
    run(recipe, data, tmp_path / "whole", intervals=EVERY)
    with monkeypatch.context() as patch:
        during(patch, "view_gradients", 14, lambda: setattr(gpu, "limit", gpu.held + 50_000))
        with pytest.raises(Fault, match="run: out of GPU memory .*--device cpu") as fault:
            run(recipe, data, tmp_path / "run", intervals=EVERY)
    assert fault.value.status == 1 and fault.value.kind == "oom" and "\n" not in str(fault.value)
    found = status(tmp_path / "run")
    assert (found.step, found.saved_step) == (13, 13), "checkpoints are made every 8 steps"
    assert any("no longer kept" in text for text in found.notes)
    gpu.limit = None
    run(recipe, data, tmp_path / "run", intervals=EVERY)
    assert cloud(tmp_path / "run") == cloud(tmp_path / "whole")


def test_where_it_gives_out_half_way_through_a_step_the_run_returns_to_its_checkpoint(
    gpu, data, recipe, tmp_path, monkeypatch
):
    run(recipe, data, tmp_path / "whole", intervals=EVERY)
    times = []

    def fail():
        times.append(gpu.allocations)
        gpu.refused = {gpu.allocations + 3} if len(times) == 1 else set()

    during(monkeypatch, "update", 14, fail)
    run(recipe, data, tmp_path / "run", intervals=EVERY)
    assert len(times) == 2, "the step is made again, from the last checkpoint"
    assert any("step 14: the memory of the GPU gave out; 0 MB of photo" in text for text in notes(tmp_path / "run"))
    assert cloud(tmp_path / "run") == cloud(tmp_path / "whole")


def test_a_budget_of_the_gpu(gpu, data, recipe, tmp_path):
    whole = run(recipe, data, tmp_path / "a", intervals=EVERY)["gpu_memory_bytes"]
    none = run(recipe, data, tmp_path / "b", intervals=EVERY, caches=CacheSettings(gpu="0"))["gpu_memory_bytes"]
    two = run(recipe, data, tmp_path / "c", intervals=EVERY, caches=CacheSettings(gpu="11KB"))["gpu_memory_bytes"]
    view = 3 * 48 * 36
    assert [each["photographs"] for each in (whole, none, two)] == [10 * view, 0, 2 * view]
    assert cloud(tmp_path / "a") == cloud(tmp_path / "b") == cloud(tmp_path / "c")


def test_where_it_gives_out_for_good_points_are_kept_on_the_host_if_steps_need_those_in_view_alone(
    gpu, data, recipe, tmp_path, monkeypatch
):
    """The state after the last step is kept, and the run goes on from there."""
    out, next_home, save, places = tmp_path / "run", run_stage.next_home, checkpoint.save, {}

    def full():
        if not notes(out):
            gpu.limit = gpu.held + 20_000

    def more_room(*given):
        gpu.limit = None
        return next_home(*given)

    def saved(path, state):
        places[state.index] = state.points.device.type
        save(path, state)

    during(monkeypatch, "view_gradients", 14, full)
    monkeypatch.setattr(run_stage, "next_home", more_room)
    monkeypatch.setattr(checkpoint, "save", saved)
    run(evolve(recipe, "pretrain.optimizer", AdamInView()), data, out, intervals=EVERY, caches=CacheSettings(gpu="0"))
    assert places == {8: "cuda", 13: "cuda", 16: "cpu", 20: "cpu"}
    told = "step 14: the memory of the GPU gave out; points are kept in the memory of the CPU"
    assert any(told in text for text in notes(out))


def notes(out):
    return json.loads((out / "run.json").read_text())["notes"]
