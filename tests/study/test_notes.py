"""What rows of a table are warned of: depth maps that they lack, and the notes of their runs."""

import json
from dataclasses import replace

import numpy as np
import pytest

from surfkit.depth.patch_match import PatchMatch
from surfkit.io.datasets.data import Data
from surfkit.losses.depth import DepthRegression
from surfkit.losses.normal_prior import NormalPrior
from surfkit.mesh.stereo import Stereo
from surfkit.runs.folder import read_record
from surfkit.runs.methods.stereo_fusion import StereoFusion
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe
from surfkit.runs.stage_cache import StageCache
from surfkit.start.stereo_start import StereoStart
from surfkit.study.ablation_warnings import lines_on_depth, notes_of, row_numbers
from surfkit.study.rows import Trial
from surfkit.study.table_text import note_lines
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.stage import Stage

LABELS = "abcdefgh"
PLAIN = Recipe()


@pytest.fixture
def data(tmp_path):
    write_colmap(tmp_path / "scene", photograph(Flight(views=9, width=24, height=18, points=40)))
    return Data(tmp_path / "scene")


def with_loss(**losses):
    return replace(PLAIN, pretrain=replace(Stage(), losses=Stage().losses | losses))


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ("abcdefgh", "all rows"),
        ("c", "row 3"),
        ("ab", "rows 1 and 2"),
        ("bcd", "rows 2 to 4"),
        ("hacd", "rows 1, 3, 4 and 8"),
        ("abcegh", "rows 1 to 3, 5, 7 and 8"),
    ],
)
def test_rows_by_their_numbers(chosen, words):
    assert row_numbers(set(chosen), LABELS) == words


def test_rows_that_lack_depth_maps_are_named_before_they_run(data, tmp_path):
    recipes = {
        "a": PLAIN,
        "b": with_loss(depth=DepthRegression()),
        "c": replace(with_loss(depth=DepthRegression()), depth=PatchMatch()),
        "d": replace(PLAIN, mesh=Stereo()),
    }

    def lines(**more):
        every = recipes | more
        found = [Trial(label, seed, recipe, tmp_path, data) for seed in (0, 1) for label, recipe in every.items()]
        return lines_on_depth(found, LABELS)

    (line,) = lines()
    assert line.startswith(f"{data.path} has no depth priors, so everything")
    assert line.endswith(f", in rows 2 and 4; make them with `surfkit prepare depth {data.path}`")
    (line,) = lines(e=replace(PLAIN, start=StereoStart()), f=Recipe(method=StereoFusion()))
    assert "rows 2 and 4 to 6; rows 5 and 6 will fail" in line
    (line,) = lines(g=with_loss(normal=NormalPrior()))
    assert line.endswith(f"in rows 2, 4 and 7; make them with `surfkit prepare depth {data.path}`")
    assert lines(b=PLAIN, d=PLAIN) == []
    maps = data.path / "estimated_depths"
    maps.mkdir()
    for path in (data.path / "images").iterdir():
        np.save(maps / f"{path.name}.npy", np.ones((18, 24), np.float32))
    assert lines() == []


def test_each_note_is_stated_once_with_its_rows(data, tmp_path):
    notes = {"a": ["one", "two"], "b": ["two"], "c": []}
    trials = []
    for label, texts in notes.items():
        for seed in (0, 1):
            folder = tmp_path / f"{label}{seed}"
            folder.mkdir()
            (folder / "run.json").write_text(json.dumps({"notes": texts}))
            trials.append(Trial(label, seed, PLAIN, folder, data))
    trials.append(Trial("d", 0, PLAIN, tmp_path / "failed before it began", data))
    found = notes_of(trials)
    assert found == [{"text": "one", "rows": ["a"]}, {"text": "two", "rows": ["a", "b"]}]
    entry = {"data": {"path": "/x/farm"}, "rows": [{"label": label} for label in LABELS], "notes": found}
    assert note_lines({"data_sets": [entry]}) == ["row 1: one", "rows 1 and 2: two"]
    assert note_lines({"data_sets": [entry, entry]})[2:] == ["row 1, farm: one", "rows 1 and 2, farm: two"]


def test_rows_of_several_devices_are_told_apart(data, tmp_path):
    """A table that began on one machine and went on on another: its minutes cannot be compared."""
    trials = []
    for label, device in {"a": "cpu avx2", "b": "cpu avx2", "c": "NVIDIA H200"}.items():
        (tmp_path / label).mkdir()
        (tmp_path / label / "run.json").write_text(json.dumps({"notes": [], "device": device, "threads": 4}))
        trials.append(Trial(label, 0, PLAIN, tmp_path / label, data))
    assert notes_of(trials[:2]) == []
    first, second = notes_of(trials)
    assert first["text"].startswith("trained on cpu avx2, threads: 4: minutes") and first["rows"] == ["a", "b"]
    assert second["text"].startswith("trained on NVIDIA H200") and second["rows"] == ["c"]


def test_a_run_that_takes_a_stage_notes_what_was_switched_off_in_it(data, tmp_path):
    stage = Stage(steps=2, losses=Stage().losses | {"depth": DepthRegression()})
    store, recipe = StageCache(tmp_path / "stages"), Recipe(pretrain=stage)
    for name, about in (("made", ""), ("taken", "again")):
        run(replace(recipe, about=about), data, tmp_path / name, store=store)
    made, taken = (read_record(tmp_path / name)["notes"] for name in ("made", "taken"))
    assert json.loads((tmp_path / "taken" / "shared.json").read_text())["pretrain"]["taken"]
    assert any("no depth priors" in text for text in taken) and sorted(made) == sorted(taken)
