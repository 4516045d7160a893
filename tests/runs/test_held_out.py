"""Which photographs training leaves out, and who is told."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from surfkit.apps import train as train_command
from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, write_json
from surfkit.io.datasets.data import Data, ReadSettings
from surfkit.io.datasets.read import read
from surfkit.runs import warn
from surfkit.runs.folder import Run, read_data
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.study.ablation import Row, Table, with_changes
from surfkit.study.study import fingerprint
from surfkit.testing.synthetic import Flight, photograph, write_colmap

QUICK = "recipe:2dgs --steps 2 --pictures-every 0 --primitive.sh-degree 0".split()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("held") / "data"
    write_colmap(path, photograph(Flight(views=9, width=32, height=24, points=60)))
    return path


@pytest.fixture(scope="module")
def without(folder):
    """A run that was trained on all photographs."""
    words = [*QUICK, "mesh:none", "--test-every", "0", "--data", str(folder), "--out", str(folder.parent / "all")]
    assert main(["train", *words]) == 0
    return folder.parent / "all"


@pytest.fixture
def trained(monkeypatch):
    """What `surfkit train` would train on, the last first."""
    seen = []
    monkeypatch.setattr(train_command, "run", lambda recipe, data, *rest: seen.insert(0, data))
    monkeypatch.setattr(train_command, "show", lambda *rest: None)
    return seen


@pytest.mark.parametrize(
    ("recipe", "every"),
    [("surface", 0), ("surface-short", 0), ("surface-blocks", 0), ("stereo", 0), ("2dgs", 8), ("citygs2", 8)],
)
def test_a_surface_is_made_of_all_photographs(folder, tmp_path, trained, recipe, every):
    words = ["train", f"recipe:{recipe}", "--data", str(folder), "--out", str(tmp_path / "run")]
    for more, expected in (([], every), (["--test-every", "5"], 5), (["--test-every", "0"], 0)):
        assert main([*words, *more]) == 0 and trained[0].test_every == expected
    assert len(read(replace(trained[1], test_every=every)).held_out) == (2 if every else 0)


def test_a_recipe_in_a_file_keeps_it(folder, tmp_path, trained):
    write_json(tmp_path / "mine.json", recipes()["stereo"])
    words = ["train", f"recipe:{tmp_path / 'mine.json'}", "--data", str(folder), "--out", str(tmp_path / "run")]
    assert main(words) == 0 and trained[0].test_every == 0
    old = dump(recipes()["stereo"])
    del old["test_every"]  # of an older version
    write_json(tmp_path / "mine.json", old)
    assert main(words) == 0 and trained[0].test_every == 8


def test_a_run_goes_on_with_what_it_has_begun_without(folder, tmp_path, monkeypatch):
    """As an older version began it: every 8th held out, and no word of it in the recipe."""
    recipe, out = replace(with_steps(recipes()["2dgs"], 2), mesh=None), tmp_path / "run"
    run(recipe, Data(folder), out)
    before = json.loads((out / "recipe.json").read_text())
    del before["test_every"]
    (out / "recipe.json").write_text(json.dumps(before))
    write_json(tmp_path / "now.json", replace(recipe, test_every=0))
    words = ["train", f"recipe:{tmp_path / 'now.json'}", "--data", str(folder), "--out", str(out), "--steps", "4"]
    assert main(words) == 0 and read_data(out).test_every == 8
    assert json.loads((out / "metrics.json").read_text())["steps"] == 4


@pytest.mark.parametrize(
    ("settings", "how"),
    [
        ({}, "2 of 9 .*; a run trained with --test-every 0 uses all"),
        ({"test_every": 3}, "3 of 9 .*; a run trained with --test-every 0 uses all"),
        ({"test_list": Path("list.txt")}, "1 of 9 .*; --test-list names them"),
        ({"test_every": 0}, None),
    ],
)
def test_what_is_made_of_a_run_says_what_it_is_without(folder, tmp_path, monkeypatch, settings, how):
    said = []
    monkeypatch.setattr(warn, "emit", lambda event: said.append(event.text))
    monkeypatch.chdir(tmp_path)
    Path("list.txt").write_text("view_004.png\n")
    data = Data(folder, **settings)
    warn.note_held_out(Run(tmp_path, Recipe(), data), read(data))
    assert len(said) == (how is not None)
    if how is not None:
        assert re.fullmatch(how, said[0]), said


def test_a_data_set_with_tests_of_its_own_is_told_apart(folder, tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(warn, "emit", lambda event: said.append(event.text))
    scene = read(Data(folder, test_every=0))
    scene = replace(scene, train=scene.train[:-2], held_out=scene.train[-2:])
    warn.note_held_out(Run(tmp_path, Recipe(), Data(folder)), scene)
    assert said[0].startswith("2 of 9 ") and said[0].endswith("the data set itself names them for tests")


@pytest.mark.parametrize("all_photographs", [False, True])
def test_commands_say_it(folder, without, tmp_path, capsys, all_photographs):
    out = tmp_path / "run"
    if all_photographs:
        shutil.copytree(without, out)
    else:
        assert main(["train", *QUICK, "mesh:none", "--data", str(folder), "--out", str(out)]) == 0
    capsys.readouterr()
    assert main(["mesh", str(out)]) == 0
    assert ("of 9 photographs were held out" in capsys.readouterr().err) == (not all_photographs)


def test_without_held_out_photographs_the_way_to_some_is_told(without, tmp_path, capsys):
    assert main(["evaluate", str(without), "--lpips-weights", "none"]) == 0
    done = capsys.readouterr()
    told = "no photograph is held out (kept from training), so PSNR, SSIM and LPIPS cannot be measured; a run trained"
    assert done.err.count(told) == 1 and "--test-every 8" in done.err
    (line,) = done.out.splitlines()
    assert "and no photographs, as none" in line and str(without) in line
    assert main(["report", str(without), "--out", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    assert not re.search(r"\b(NaN|nan|None)\b", page) and "--test-every 8" in page, "its note"
    assert main(["status", str(without)]) == 0
    assert json.loads((without / "metrics.json").read_text())["images"]["psnr"] is None


def test_rows_of_a_table_hold_out_the_same(folder):
    table = Table("t", "about", recipes()["surface"], (Row("a"),))
    assert with_changes(table, table.rows[0], table.base).pretrain.steps
    row = Row("b", {"test_every": 3})
    with pytest.raises(BadInput, match="row 'b': test_every: .*--test-every"):
        with_changes(table, row, table.base)
    data = ReadSettings().of(folder)
    assert data.test_every == 8, "also where the recipe of a row is for a surface"
    assert fingerprint(replace(table.base, test_every=8), data, {}) == fingerprint(table.base, data, {})
