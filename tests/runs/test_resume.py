"""Runs that are interrupted, made longer, damaged, or met by what gives out."""

import errno
import json
import os
import resource
import shutil
import signal
import statistics
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.core import lock
from surfkit.core.check import BadInput, Fault
from surfkit.core.lock import locked
from surfkit.core.tree import evolve
from surfkit.densify.base import Prune
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import confidence_path, map_path, normal_path, write_map, write_record
from surfkit.losses.depth import DepthRegression
from surfkit.runs import journal, pipeline
from surfkit.runs.pipeline import Intervals, load_run, run
from surfkit.runs.recipe import complete, with_steps
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import adam, checkpoint
from surfkit.train.progress import TrainingDisplay
from surfkit.train.trainer import Trainer

STEPS = 24


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source")
    write_colmap(folder, photograph(Flight(width=40, height=30, points=150)))
    return folder


@pytest.fixture
def data(source, tmp_path) -> Data:
    """A data set of one's own, that may be spoilt."""
    shutil.copytree(source, tmp_path / "data")
    return Data(tmp_path / "data")


@pytest.fixture(scope="module")
def whole_recipe():
    return evolve(recipes()["2dgs"], "primitive.sh_degree", 1)


@pytest.fixture(scope="module")
def recipe(whole_recipe):
    return with_steps(whole_recipe, STEPS)


@pytest.fixture(scope="module")
def finished(source, recipe, tmp_path_factory):
    """A data set that stays as it is, and a run of it: to be copied by whoever changes it."""
    out = tmp_path_factory.mktemp("finished") / "run"
    run(recipe, Data(source), out)
    return Data(source), out


@pytest.fixture
def done(finished, tmp_path):
    """A finished run of one's own, and its data, which are others' too."""
    return finished[0], Path(shutil.copytree(finished[1], tmp_path / "run"))


def notes(out):
    return json.loads((out / "run.json").read_text())["notes"]


def steps(out):
    return [line["index"] for line in journal.read(out / "events.jsonl") if line["event"] == "StepDone"]


def interrupted(recipe, data, out, at, monkeypatch, **settings):
    """A run that is asked to stop after a step."""

    class Interrupting(TrainingDisplay):
        def show(self, done):
            if done.index == at:
                os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr("surfkit.runs.run_stage.TrainingDisplay", Interrupting)
        with pytest.raises(KeyboardInterrupt):
            run(recipe, data, out, **settings)


def test_a_damaged_checkpoint_falls_back_to_the_one_before(finished, recipe, tmp_path, monkeypatch, capsys):
    (data, whole), out = finished, tmp_path / "run"
    interrupted(recipe, data, out, 17, monkeypatch, intervals=Intervals(8))
    path = out / "pretrain" / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:-40])
    run(recipe, data, out)
    assert "going on after step 16 of 24" in capsys.readouterr().err
    assert len(notes(out)) == 1 and "the one before it, of step 16, is used" in notes(out)[0]
    assert (out / "point_cloud.ply").read_bytes() == (whole / "point_cloud.ply").read_bytes()
    assert steps(out) == list(range(1, STEPS + 1))


def test_a_damaged_checkpoint_does_not_push_out_the_good_one(data, recipe, tmp_path, monkeypatch):
    interrupted(recipe, data, tmp_path / "run", 17, monkeypatch, intervals=Intervals(8))
    path = tmp_path / "run" / "pretrain" / "checkpoint.safetensors"
    path.write_bytes(b"")
    interrupted(recipe, data, tmp_path / "run", 18, monkeypatch)
    assert [checkpoint.load(p).index for p in (checkpoint.before(path), path)] == [16, 18]


@pytest.mark.parametrize("stopped", [None, 13])
def test_a_run_is_made_longer(finished, recipe, whole_recipe, tmp_path, monkeypatch, stopped):
    (data, whole), out, long = finished, tmp_path / "run", with_steps(whole_recipe, 40)
    if stopped:
        interrupted(recipe, data, out, stopped, monkeypatch)
    else:
        shutil.copytree(whole, out)
    metrics = run(long, data, out)
    assert metrics["steps"] == 40 and load_run(out)[0].recipe == complete(long) and steps(out) == list(range(1, 41))
    assert len(notes(out)) == 1 and notes(out)[0].startswith("the run is made longer, from 24 steps to 40")
    assert run(long, data, out) == metrics and len(notes(out)) == 1
    with pytest.raises(BadInput, match="pretrain.steps 40, .*24"):
        run(recipe, data, out)


@pytest.mark.parametrize("length", [13, 20])
def test_a_stopped_run_is_made_shorter(data, recipe, whole_recipe, tmp_path, monkeypatch, length):
    out, short = tmp_path / "run", with_steps(whole_recipe, length)
    interrupted(recipe, data, out, 13, monkeypatch)
    with pytest.raises(BadInput, match="pretrain.steps 24, .*12"):
        run(with_steps(whole_recipe, 12), data, out)  # 13 are made
    metrics = run(short, data, out)
    assert metrics["steps"] == length and load_run(out)[0].recipe == complete(short)
    assert steps(out) == list(range(1, length + 1)) and (out / "point_cloud.ply").exists()
    assert notes(out)[0].startswith(f"the run is made shorter, from 24 steps to {length}")


def test_a_run_is_made_longer_under_its_old_schedule(done, recipe):
    assert run(evolve(recipe, "pretrain.steps", 30), *done)["steps"] == 30


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("pretrain.losses.l1.weight", 0.7, r"l1.weight 0.8, and this one has 0.7"),
        ("pretrain.densify.every", 9, r"densify.every \d+, and this one has 9"),
        ("seed", 3, "seed 0, and this one has 3"),
    ],
)
def test_a_longer_run_of_another_recipe_is_refused(done, whole_recipe, path, value, message):
    with pytest.raises(BadInput, match=message):
        run(evolve(with_steps(whole_recipe, 40), path, value), *done)


def test_a_folder_in_use_is_refused(data, recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "LOCK_TIMEOUT_S", 0.0)
    with locked(tmp_path / "run"), pytest.raises(BadInput, match=rf"run: process {os.getpid()} on"):
        run(recipe, data, tmp_path / "run")


def touched(path, change):
    state = path.stat()
    content = bytearray(path.read_bytes())
    change(content)
    path.write_bytes(content)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns + 1))


def flip(content):
    content[len(content) // 2] ^= 1


def test_data_that_changed_are_named(data, recipe, tmp_path, monkeypatch):
    out, images = tmp_path / "run", data.path / "images"
    interrupted(recipe, data, out, 5, monkeypatch)
    for path in images.iterdir():
        path.touch()  # copied, say; the content is the same
    interrupted(recipe, data, out, 6, monkeypatch)
    photo = images / "view_003.png"
    before = photo.read_bytes()
    touched(photo, flip)
    with pytest.raises(BadInput, match="photograph view_003.png has"):
        run(recipe, data, out)
    photo.write_bytes(before)
    model = data.path / "sparse" / "0"
    for name, change, message in [
        ("images.txt", moved, r"began with: the camera of view_000.png has changed; put"),
        ("points3D.txt", shortened, "began with: the sparse points have changed; put"),
    ]:
        text = (model / name).read_text()
        (model / name).write_text(change(text))
        with pytest.raises(BadInput, match=message):
            run(recipe, data, out)
        (model / name).write_text(text)
    run(recipe, data, out)


def test_masks_and_depth_maps_that_changed_are_named(data, recipe, tmp_path, monkeypatch):
    out, masks, scene = tmp_path / "run", data.path / "masks", photograph(Flight(width=40, height=30, points=150))
    recipe = evolve(recipe, "pretrain.losses.depth", DepthRegression())
    masks.mkdir()
    for name, exact in scene.exact.items():
        Image.fromarray(np.full((30, 40), 255, np.uint8)).save(masks / name)
        inverse = scene.scene.frame.scale / exact.depth.numpy()
        write_map(data.path, name, inverse, np.ones_like(inverse), exact.normal.numpy())
    write_record(data.path, {"aligned": True})
    interrupted(recipe, data, out, 5, monkeypatch)
    depth = map_path(data.path, "view_005.png")
    for path, message in [
        (masks / "view_003.png", "the mask of view_003.png has changed, come or gone; put"),
        (depth, "the depth map of view_005.png has changed, come or gone; put"),
        (confidence_path(depth), "the confidence of depth of view_005.png has changed, come or gone; put"),
        (normal_path(depth), "the normal map of view_005.png has changed, come or gone; put"),
    ]:
        before = path.read_bytes()
        touched(path, flip if path != masks / "view_003.png" else lambda content: content.extend(b"more"))
        with pytest.raises(BadInput, match=f"began with: {message}"):
            run(recipe, data, out)
        path.unlink()
        with pytest.raises(BadInput, match=f"began with: {message}"):
            run(recipe, data, out)
        path.write_bytes(before)
    write_record(data.path, {"aligned": False})
    with pytest.raises(BadInput, match="depth map of view_001.png .* 9 more"):
        run(recipe, data, out)
    write_record(data.path, {"aligned": True})
    run(recipe, data, out)


def test_a_run_whose_fingerprint_knew_no_masks_goes_on(data, recipe, tmp_path, monkeypatch):
    out = tmp_path / "run"
    interrupted(recipe, data, out, 5, monkeypatch)
    inputs = json.loads((out / "inputs.json").read_text())
    del inputs["beside"]
    for photo in inputs["photographs"].values():
        del photo["beside"]
    (out / "inputs.json").write_text(json.dumps(inputs))
    run(recipe, data, out)


def shortened(text):
    """The text of points3D.txt without the last point."""
    return "".join(text.splitlines(keepends=True)[:-1])


def moved(text):
    """The text of images.txt with the first camera elsewhere."""
    lines = text.splitlines()
    at = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    words = lines[at].split()
    words[5] = repr(float(words[5]) + 0.5)
    lines[at] = " ".join(words)
    return "\n".join(lines) + "\n"


def test_damaged_photographs_are_passed_over(data, recipe, tmp_path, monkeypatch, capsys):
    out = tmp_path / "run"
    for name in ("view_003.png", "view_008.png"):  # one to train with, one held out
        path = data.path / "images" / name
        path.write_bytes(path.read_bytes()[:-300])
    interrupted(recipe, data, out, 15, monkeypatch)
    metrics = run(recipe, data, out)
    record = json.loads((out / "run.json").read_text())
    assert sorted(record["skipped"]) == ["view_003.png", "view_008.png"] and record["notes"] == []
    said = capsys.readouterr().err
    for name in ("view_003.png", "view_008.png"):
        assert said.count(f"{name}: not a whole picture") == 1
    assert list(metrics["images"]["per_image"]) == ["view_000.png"]


def test_a_photograph_that_broke_meanwhile_may_stay_so_if_it_is_skipped(data, recipe, tmp_path, monkeypatch):
    path, out = data.path / "images" / "view_003.png", tmp_path / "run"
    fingerprint = pipeline.refuse_changed

    def breaking(*args):
        prints = fingerprint(*args)
        path.write_bytes(path.read_bytes()[:-300])
        return prints

    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "refuse_changed", breaking)
        interrupted(recipe, data, out, 15, monkeypatch)
    assert run(recipe, data, out)["steps"] == STEPS


@dataclass(frozen=True)
class Spoiling(Prune):
    """Spoils a point at a step, while the rates are above something."""

    at: int = 0
    above: float = 0.0

    def edit(self, points, step):
        if step.index == self.at and step.rates["scales"] > self.above:
            points.params["scales"].data[0] = float("nan")  # as a fault of numbers would: a part may not


def spoilt(recipe, at, above, monkeypatch):
    monkeypatch.setattr("surfkit.core.codec.name_of", lambda part: type(part).__name__.lower())
    monkeypatch.setattr(pipeline, "refuse_unsaved", lambda recipe: None)  # a prune that no plugin registers
    return evolve(recipe, "pretrain.prune", (Spoiling(at, above),))


def test_numbers_that_are_not_finite_take_the_run_back_with_half_the_rates(data, recipe, tmp_path, monkeypatch):
    out = tmp_path / "run"
    rate = complete(recipe).pretrain.rates["scales"].start
    metrics = run(spoilt(recipe, 13, 0.3 * rate, monkeypatch), data, out, intervals=Intervals(10))
    assert metrics["steps"] == STEPS and checkpoint.load(out / "pretrain" / "checkpoint.safetensors").halvings == 2
    assert [("(1 of 2" in text, "(2 of 2" in text) for text in notes(out)] == [(True, False), (False, True)]
    for text in notes(out):
        assert "step 13, view view_0" in text and "the scales are not finite; back to step 10" in text
    assert steps(out) == list(range(1, STEPS + 1))


@pytest.mark.parametrize("at", [3, 13])
def test_a_third_time_is_the_last(data, recipe, tmp_path, monkeypatch, at):
    bad, out = spoilt(recipe, at, 0.0, monkeypatch), tmp_path / "run"
    for _ in range(2):  # the same command again knows that the rates were halved
        with pytest.raises(Fault, match=rf"step {at}, view view_0\d\d.png: .*scales .* 2 t"):
            run(bad, data, out, intervals=Intervals(10))
    state = checkpoint.load(out / "pretrain" / "checkpoint.safetensors")
    assert state.halvings == 2 and state.index == (10 if at == 13 else 0) and len(notes(out)) == 2
    assert all(torch.isfinite(value).all() for value in state.points.params.values())


def test_a_full_disk_stops_the_run_with_its_checkpoint_whole(data, recipe, tmp_path, monkeypatch):
    out = tmp_path / "run"
    interrupted(recipe, data, out, 9, monkeypatch)
    path = out / "pretrain" / "checkpoint.safetensors"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size // 2, limits[1]))
    try:
        with pytest.raises(Fault, match="the disk is full .*last checkpoint"):
            run(recipe, data, out, intervals=Intervals(5))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert checkpoint.load(path).index == 9 and not list(out.rglob(".*"))
    assert run(recipe, data, out)["steps"] == STEPS and steps(out) == list(range(1, STEPS + 1))


def test_a_disk_that_fills_before_the_first_checkpoint_claims_none(data, recipe, tmp_path):
    out = tmp_path / "run"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(Fault, match="checkpoint.safetensors: the disk is full") as found:
            run(recipe, data, out, intervals=Intervals(5))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "is whole" not in str(found.value) and str(found.value).endswith("give the same command again")
    assert not list(out.rglob("*.safetensors")) and run(recipe, data, out)["steps"] == STEPS


def test_out_of_memory_is_one_line_and_the_checkpoint_stays(data, recipe, tmp_path, monkeypatch):
    step = Trainer.step

    def short(self, state):
        if state.index == 12:
            torch.empty(2**60, dtype=torch.uint8)
        return step(self, state)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", short)
        with pytest.raises(Fault, match="out of memory.*no longer kept.*--longest"):
            run(recipe, data, tmp_path / "run", intervals=Intervals(10))
    assert checkpoint.load(tmp_path / "run" / "pretrain" / "checkpoint.safetensors").index == 10
    run(recipe, data, tmp_path / "run")


@pytest.mark.parametrize("photographs", [3, 1])
def test_out_of_memory_lowers_the_cache_first(finished, recipe, tmp_path, monkeypatch, photographs):
    """As long as more photographs than some are kept, memory is short, in the middle of a step; nothing is lost."""
    (data, whole), out, update = finished, tmp_path / "run", adam.adam_step
    kept = []

    def short(points, grads, rates, index, rows=None):
        update(points, grads, rates, index, rows)
        kept.append(given[0].photos.bytes)
        if index == 13 and kept[-1] > photographs * 40 * 30 * 3:
            raise MemoryError

    given, read_ahead = [], pipeline.read_ahead
    monkeypatch.setattr(pipeline, "read_ahead", lambda *args: given.append(read_ahead(*args)) or given[-1])
    monkeypatch.setattr(adam, "adam_step", short)
    run(recipe, data, out, intervals=Intervals(10))
    times = {3: 1, 1: 2}[photographs]
    assert len(notes(out)) == times and kept[-1] <= photographs * 40 * 30 * 3 < kept[11]
    assert all(text.startswith("step 13: out of memory; photographs") for text in notes(out))
    assert (out / "point_cloud.ply").read_bytes() == (whole / "point_cloud.ply").read_bytes()
    assert steps(out) == list(range(1, STEPS + 1))


def test_a_cache_is_lowered_before_memory_is_gone(data, recipe, tmp_path, monkeypatch):
    free = iter([1 << 30, 100 << 20])  # looked at every ten steps
    monkeypatch.setattr("surfkit.runs.run_stage.free_bytes", lambda: next(free))
    assert run(recipe, data, tmp_path / "run")["steps"] == STEPS
    assert len(notes(tmp_path / "run")) == 1
    assert notes(tmp_path / "run")[0].startswith("step 20: only 100 MiB of memory are free")


@pytest.mark.parametrize("name", ["point_cloud.ply", "metrics.json", "view_000.png.png", "run.json"])
def test_a_disk_that_is_full_at_the_end(done, recipe, monkeypatch, name):
    (data, out), replace = done, os.replace
    wanted = {path.name: path.read_bytes() for path in out.rglob("*.p*") if path.is_file()}
    (out / "metrics.json").unlink()
    (out / "point_cloud.ply").unlink()

    def full(old, new):
        if os.path.basename(new) == name:
            raise OSError(errno.ENOSPC, "No space left on device", str(new))
        replace(old, new)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(Fault, match=rf"{name}: the disk is full .*last checkpoint"):
            run(recipe, data, out)
    assert not list(out.rglob(".*")) and not (out / "metrics.json").exists()
    assert checkpoint.load(out / "pretrain" / "checkpoint.safetensors").index == STEPS
    run(recipe, data, out)
    assert {path.name: path.read_bytes() for path in out.rglob("*.p*") if path.is_file()} == wanted


def test_commands_on_a_run_folder_take_its_lock(done, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(lock, "LOCK_TIMEOUT_S", 0.0)
    _, out = done
    with locked(out):
        for words in (["evaluate", str(out)], ["export", str(out)]):
            assert main(words) == 2 and f"process {os.getpid()} on" in capsys.readouterr().err
        assert main(["export", str(out), "--out", str(tmp_path / "a.ply")]) == 0
    assert main(["evaluate", str(out)]) == main(["export", str(out)]) == 0
    assert main(["evaluate", str(tmp_path / "nowhere")]) == 2 and not (tmp_path / "nowhere").exists()


def test_a_folder_that_cannot_be_made_is_one_line(data, tmp_path, capsys):
    (tmp_path / "file").touch()
    words = ["train", "recipe:2dgs", "--data", str(data.path), "--out", str(tmp_path / "file" / "run")]
    told = f"surfkit: {tmp_path / 'file' / 'run'}: a file is in the place of a folder; name another\n"
    assert main(words) == 2 and capsys.readouterr().err == told


def test_checkpoints_can_be_read_by_whom_the_umask_lets(data, recipe, tmp_path):
    for mask, mode in ((0o022, 0o644), (0o027, 0o640)):
        before = os.umask(mask)
        try:
            run(with_steps(recipe, 1), data, tmp_path / f"run-{mode}")
            assert os.umask(mask) == mask
        finally:
            os.umask(before)
        path = tmp_path / f"run-{mode}" / "pretrain" / "checkpoint.safetensors"
        assert path.stat().st_mode & 0o777 == mode


def test_pictures_along_the_way_change_nothing_else(data, recipe, tmp_path):
    a = run(recipe, data, tmp_path / "a", intervals=Intervals(pictures=0))
    b = run(recipe, data, tmp_path / "b", intervals=Intervals(pictures=10))
    assert a["images"] == b["images"] and not (tmp_path / "a" / "progress").exists()
    found = sorted(p.relative_to(tmp_path / "b" / "progress").as_posix() for p in (tmp_path / "b").rglob("0000*/*.png"))
    assert found == [f"0000{step}/view_00{view}.png.png" for step in (10, 20) for view in (0, 8)]
    seen = [line for line in journal.read(tmp_path / "b" / "events.jsonl") if line["event"] == "Measured"]
    assert [line["index"] for line in seen] == [10, 20] and set(seen[0]["psnr"]) == {"view_000.png", "view_008.png"}
    assert all(5 < value < 40 for line in seen for value in line["psnr"].values())


def test_the_psnr_along_the_way_is_that_of_the_end(data, recipe, tmp_path):
    metrics = run(recipe, data, tmp_path / "run", intervals=Intervals(pictures=STEPS - 1))
    line = next(line for line in journal.read(tmp_path / "run" / "events.jsonl") if line["event"] == "Measured")
    assert statistics.fmean(line["psnr"].values()) == pytest.approx(metrics["images"]["psnr"], abs=1.0)
