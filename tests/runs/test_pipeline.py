import gc
import json
import os
import shutil
import signal
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.io.splats.ply import read_splats
from surfkit.mesh.tsdf import TSDF
from surfkit.partition import QuantileGrid
from surfkit.primitives import Flat3D, Surfel2D
from surfkit.runs import pipeline, warn
from surfkit.runs import run_stage as stage
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.execute import Pool
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import Intervals, load_run, run
from surfkit.runs.recipe import complete, with_steps
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.data_cache import CacheSettings

STEPS = 60


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    torch.set_num_threads(2)
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(width=64, height=48, points=300)))
    return Data(folder)


@pytest.fixture(scope="module")
def recipe():
    small = evolve(with_steps(recipes()["2dgs"], STEPS), "primitive.sh_degree", 1)
    return evolve(evolve(small, "pretrain.densify.every", 5), "pretrain.densify.start", 10)


@pytest.fixture(scope="module")
def finished(data, recipe, tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    return out, run(recipe, data, out)


def test_lengths_in_metres_are_refused_before_training_where_the_unit_is_not_known(data, recipe, tmp_path):
    with pytest.raises(BadInput, match="mesh.voxel: .*1 m .*--metres-per-unit"):
        run(replace(recipe, mesh=TSDF(voxel=1.0)), data, tmp_path / "run")
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_run_leaves_everything_behind(finished, data, recipe):
    out, metrics = finished
    assert json.loads((out / "metrics.json").read_text()) == metrics
    assert metrics["images"]["psnr"] > 13 and 0 < metrics["images"]["ssim"] < 1
    assert set(metrics["images"]["per_image"]) == {"view_000.png", "view_008.png"}
    for name in ("points", "seconds", "cpu_seconds", "peak_memory_bytes", "fps"):
        assert metrics[name] > 0, name
    record = json.loads((out / "run.json").read_text())
    assert record["versions"]["torch"] == torch.__version__ and record["device"].startswith("cpu")
    assert record["data"]["path"] == str(data.path) and record["seed"] == 0 and record["notes"] == []
    assert sorted(p.name for p in (out / "pictures").iterdir()) == ["view_000.png.png", "view_008.png.png"]
    with Image.open(out / "pictures" / "view_000.png.png") as picture:
        assert picture.size == (4 * 64, 48)
    assert not list(out.rglob(".*")), "nothing half-written stays"


def test_memory_is_told_by_part(finished):
    out, metrics = finished
    parts = dict(metrics["memory_bytes"])
    assert json.loads((out / "run.json").read_text())["memory_bytes"] == parts
    peak = parts.pop("peak")
    assert peak <= metrics["peak_memory_bytes"] and sum(parts.values()) == peak and min(parts.values()) >= 0
    assert parts["photographs"] == 10 * 64 * 48 * 3
    state = load_run(out)[1]
    end = state.points.nbytes
    assert end / 2 <= parts["points"] <= 2 * end and parts["program"] > 50e6


def test_points_are_in_the_frame_of_the_input(finished, data):
    out, metrics = finished
    table, scene = read_splats(out / "point_cloud.ply"), read(data)
    assert table.kind == "surfel" and len(table) == metrics["points"] > 300
    truth = scene.frame.to_input(scene.cloud.xyz.numpy())
    for share in (10, 50, 90):
        there, wanted = (np.percentile(xyz[:, :2], share, axis=0) for xyz in (table.means.numpy(), truth))
        assert np.allclose(there, wanted, atol=2.5), "metres; the scene is 20 m wide"
    assert np.ptp(np.percentile(truth, [10, 90], axis=0)[:, 0]) > 8


def test_the_seed_decides_the_draws(data, recipe, tmp_path):
    for name, seed in {"a": 0, "b": 0, "c": 1}.items():
        run(with_steps(replace(recipe, seed=seed), 1), data, tmp_path / name)
    a, b, c = ((tmp_path / name / "point_cloud.ply").read_bytes() for name in "abc")
    assert a == b != c


def test_training_beats_the_sparse_points(finished, data, recipe, tmp_path):
    start = run(with_steps(recipe, 1), data, tmp_path)
    assert finished[1]["images"]["psnr"] > start["images"]["psnr"] + 4


def test_photographs_of_training_are_let_go_of_before_the_results_are_made(data, recipe, tmp_path, monkeypatch):
    read_ahead, results, given, left = pipeline.read_ahead, pipeline.results, [], []

    def watched(*args):
        found = read_ahead(*args)
        given.append(weakref.ref(found.photos))
        return found

    def looked(*args):
        gc.collect()
        left.extend(ref for ref in given if ref() is not None)
        return results(*args)

    monkeypatch.setattr(pipeline, "read_ahead", watched)
    monkeypatch.setattr(pipeline, "results", looked)
    run(with_steps(recipe, 2), data, tmp_path)
    assert given and not left


def test_a_finished_run_says_so_and_makes_only_what_is_missing(finished, data, recipe, monkeypatch, capsys):
    out, metrics = finished
    monkeypatch.setattr(pipeline, "optimise", None)  # training again would fail
    assert run(replace(recipe, about="in other words"), data, out) == metrics
    assert "is finished" in capsys.readouterr().err
    cloud = (out / "point_cloud.ply").read_bytes()
    (out / "point_cloud.ply").unlink()
    (out / "metrics.json").unlink()
    again = run(recipe, data, out)
    assert again["images"] == metrics["images"] and again["seconds"] == metrics["seconds"]
    assert (out / "point_cloud.ply").read_bytes() == cloud


def test_results_of_a_model_that_is_gone_are_made_anew(finished, data, recipe, tmp_path):
    shutil.copytree(finished[0], tmp_path / "run")
    (tmp_path / "run" / "pretrain" / "checkpoint.safetensors").unlink()
    (tmp_path / "run" / "point_cloud.ply").write_text("old")
    run(recipe, data, tmp_path / "run")
    assert (tmp_path / "run" / "point_cloud.ply").read_bytes() == (finished[0] / "point_cloud.ply").read_bytes()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("pretrain.losses.l1.weight", 0.7, "pretrain.losses.l1.weight 0.8, and this one has 0.7"),
        ("pretrain.densify", None, 'pretrain.densify {"use": "adc"'),
        ("seed", 3, "seed 0, and this one has 3"),
    ],
)
def test_another_recipe_is_refused(finished, data, recipe, path, value, message):
    with pytest.raises(BadInput) as error:
        run(evolve(recipe, path, value), data, finished[0])
    assert message in str(error.value) and "name another folder" in str(error.value)


def test_a_run_from_before_there_was_a_setting_goes_on(finished, data, recipe, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(finished[0], out)
    written = json.loads((out / "recipe.json").read_text())
    del written["refine"], written["pretrain"]["near"]
    (out / "recipe.json").write_text(json.dumps(written))
    assert run(recipe, data, out) == json.loads((out / "metrics.json").read_text())
    (out / "recipe.json").write_text(json.dumps(written | {"seed": 3}))
    with pytest.raises(BadInput, match="seed 3, and this one has 0"):
        run(recipe, data, out)


def test_other_data_is_refused(finished, data, recipe):
    with pytest.raises(BadInput, match="data.test_every 8, .*4"):
        run(recipe, replace(data, test_every=4), finished[0])


def test_a_file_in_the_place_of_the_folder_is_refused(data, recipe, tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(BadInput, match="a file, not a folder"):
        run(recipe, data, tmp_path / "run")


@pytest.mark.parametrize(("number", "at"), [(signal.SIGINT, 1), (signal.SIGTERM, 15), (signal.SIGINT, 59)])
def test_an_interrupted_run_goes_on_to_the_same_points(
    finished, data, recipe, tmp_path, monkeypatch, capsys, number, at
):
    class Interrupting(stage.TrainingDisplay):
        def show(self, done):
            if done.index == at:
                os.kill(os.getpid(), number)

    with monkeypatch.context() as patch:
        patch.setattr(stage, "TrainingDisplay", Interrupting)
        with pytest.raises(KeyboardInterrupt):
            run(recipe, data, tmp_path)
    assert f"stopped after step {at} of 60" in capsys.readouterr().err
    assert not (tmp_path / "metrics.json").exists()
    with pytest.raises(BadInput, match=f"stopped after step {at} of 60"):
        load_run(tmp_path)
    metrics = run(recipe, data, tmp_path)
    assert f"going on after step {at} of 60" in capsys.readouterr().err
    assert (tmp_path / "point_cloud.ply").read_bytes() == (finished[0] / "point_cloud.ply").read_bytes()
    assert metrics["images"] == finished[1]["images"]


def test_checkpoints_are_written_every_so_often(data, recipe, tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(stage.checkpoint, "save", lambda path, state: written.append(state.index))
    run(with_steps(recipe, 10), data, tmp_path, intervals=Intervals(4))
    assert written == [4, 8, 10]


def test_without_held_out_photographs_the_metrics_say_so(data, recipe, tmp_path, capsys):
    fixed = evolve(with_steps(recipe, 2), "pretrain.densify", None)
    metrics = run(fixed, replace(data, test_every=0), tmp_path)
    names = ("psnr", "ssim", "psnr_aligned", "ssim_aligned")
    assert metrics["images"] == {**dict.fromkeys(names), "per_image": {}} and metrics["fps"] > 0
    notes = json.loads((tmp_path / "run.json").read_text())["notes"]
    assert len(notes) == 1 and "cannot be measured" in notes[0] and notes[0] in capsys.readouterr().err


def test_a_stage_that_can_add_no_point_is_told_before_it_begins(data, recipe, tmp_path, capsys):
    whole = recipes()["2dgs"].pretrain
    run(replace(recipe, pretrain=replace(whole, steps=2), mesh=None), data, tmp_path / "run")
    told = "note: pretrain: no point will be added, as no edit of densify falls within 2 steps; more steps"
    assert told in capsys.readouterr().err
    run(replace(recipe, pretrain=replace(whole, steps=2, densify=None), mesh=None), data, tmp_path / "fixed")
    assert "no point" not in capsys.readouterr().err, "none is to be added"


@pytest.mark.parametrize(("cut", "told"), [(None, []), (QuantileGrid((1, 1)), ["tune"])])
def test_blocks_that_can_add_no_point_are_told_where_there_are_any(recipe, data, tmp_path, monkeypatch, cut, told):
    texts, whole = [], recipes()["2dgs"].pretrain
    monkeypatch.setattr(warn, "emit", lambda event: texts.append(event.text))
    tune = replace(whole, steps=600, densify=replace(whole.densify, start=600))
    warn.warn_of_no_edits(Run(tmp_path, replace(recipe, partition=cut, tune=tune), data), read(data))
    assert [text.partition(":")[0] for text in texts] == told


def test_blocks_that_nobody_said_how_to_tune_are_told(recipe, data, tmp_path, monkeypatch):
    cut, whole = QuantileGrid((1, 1)), recipes()["2dgs"]
    for each in (whole, replace(whole, partition=cut, tune=whole.pretrain), replace(recipes()["3dgs"], partition=cut)):
        assert warn.plain_blocks(each) is None
    texts = []
    monkeypatch.setattr(warn, "emit", lambda event: texts.append(event.text))
    warn.warn_before(Run(tmp_path, replace(whole, partition=cut), data), read(data), None)
    assert (
        "blocks are tuned as 3DGS is, without some parts of pretrain; to keep these, add "
        "tune.losses.normal:normal tune.losses.distortion:distortion, and their settings"
    ) in texts


def test_a_prune_that_is_never_due_is_told_before_the_run(recipe, data, tmp_path, monkeypatch):
    """In 1,000 steps, trims end before the first; in 9,999 with epochs of 8,000, the second epoch ends too late."""
    texts, scene = [], read(data)
    monkeypatch.setattr(warn, "emit", lambda event: texts.append(event.text))

    def told(recipe, views=scene.train):
        texts.clear()
        warn.warn_of_no_edits(Run(tmp_path, recipe, data), replace(scene, train=views))
        return texts

    city = recipes()["citygs2"]
    assert len(told(with_steps(city, 1_000))) == 1 and texts[0].startswith("tune.prune.0: trim is never due within its")
    assert told(with_steps(city, 4_000)) == [] and told(city) == []
    trimmed = evolve(with_steps(recipes()["trim2dgs"], 10_000), "pretrain.prune.0.start", 8_001)
    assert told(trimmed) == [] and told(trimmed, [None] * 8_000) == [
        "pretrain.prune.0: trim is never due within its 10,000 steps of 8,000 photographs to an epoch; more steps, or "
        "another schedule of it, change that"
    ]


@pytest.mark.parametrize(("name", "primitive"), [("2dgs", Surfel2D()), ("citygs2-coarse", Flat3D())])
def test_points_multiply_in_a_short_run(data, tmp_path, name, primitive):
    recipe = replace(with_steps(recipes()[name], 120), primitive=primitive, mesh=None)
    run(recipe, data, tmp_path, intervals=Intervals(pictures=0))
    lines = map(json.loads, (tmp_path / "events.jsonl").read_text().splitlines())
    edits = [line for line in lines if line["event"] == "PointsEdited"]
    assert sum(line["cloned"] + line["split"] > 0 for line in edits) >= 2


def test_an_executor_without_blocks_is_told(data, recipe, tmp_path, capsys):
    run(with_steps(recipe, 2), data, tmp_path, Compute(workers=Pool()))
    assert "no blocks, so the executor has nothing to do" in capsys.readouterr().err


def test_warnings_of_a_run_become_notes_once(data, recipe, tmp_path, monkeypatch):
    original = pipeline.read

    def warning(given):
        emit(Warned("the scene is odd"))
        return original(given)

    monkeypatch.setattr(pipeline, "read", warning)
    for _ in range(2):
        run(evolve(with_steps(recipe, 1), "pretrain.densify", None), data, tmp_path)
        assert json.loads((tmp_path / "run.json").read_text())["notes"] == ["the scene is odd"]


def test_photographs_that_are_no_longer_there_are_noticed(data, recipe, tmp_path, monkeypatch):
    run(with_steps(recipe, 2), data, tmp_path)
    scene = read(data)
    monkeypatch.setattr(pipeline, "read", lambda given: replace(scene, train=scene.train[1:]))
    with pytest.raises(BadInput, match="10 photographs .*now gives 9"):
        run(with_steps(recipe, 2), data, tmp_path)


def test_bad_data_leaves_nothing_behind(recipe, tmp_path):
    with pytest.raises(BadInput, match="no such folder"):
        run(recipe, Data(tmp_path / "nowhere"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_load_run_gives_back_what_was_run(finished, data, recipe, tmp_path):
    loaded, state, scene = load_run(finished[0])
    assert loaded.recipe == complete(recipe) and loaded.data == data and state.index == STEPS and len(scene.train) == 10
    with pytest.raises(BadInput, match="no run folder"):
        load_run(tmp_path)


@pytest.mark.parametrize("copies", [False, True])
def test_the_budget_of_the_cache_changes_nothing(finished, data, recipe, tmp_path, copies):
    metrics = run(recipe, data, tmp_path, caches=CacheSettings("20KB", copies))  # two photographs of 64 x 48
    assert (data.path / "resized").exists() == copies
    assert (tmp_path / "point_cloud.ply").read_bytes() == (finished[0] / "point_cloud.ply").read_bytes()
    assert metrics["images"] == finished[1]["images"]
    with pytest.raises(BadInput, match="--cache lots: .*4GB"):
        run(recipe, data, tmp_path, caches=CacheSettings("lots"))


def test_masks_train_end_to_end(data, recipe, tmp_path):
    """What is under the masks makes no difference, in training or in the metrics."""
    clouds, metrics = [], []
    for value in (0, 255):
        folder = tmp_path / str(value)
        shutil.copytree(data.path, folder)
        for path in (folder / "images").iterdir():
            pixels = np.array(Image.open(path))
            pixels[10:30, 20:40] = value
            Image.fromarray(pixels).save(path)
            mask = np.full((48, 64), 255, np.uint8)
            mask[10:30, 20:40] = 0
            (folder / "masks").mkdir(exist_ok=True)
            Image.fromarray(mask).save(folder / "masks" / path.name)
        metrics.append(run(with_steps(recipe, 20), Data(folder), tmp_path / f"run-{value}")["images"])
        clouds.append((tmp_path / f"run-{value}" / "point_cloud.ply").read_bytes())
    assert clouds[0] == clouds[1] and metrics[0] == metrics[1]
