"""`surfkit import`: a file becomes a run folder on which the other commands work."""

import json
import re
import shutil

import pytest
import torch
from models import data_set, like_3dgs

from surfkit.cli import main
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.io.splats.ply import read_splats, write_splats
from surfkit.io.splats.spz import SPZ
from surfkit.runs.pipeline import loaded


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """A data set and a file of its splats."""
    folder = tmp_path_factory.mktemp("given")
    data = data_set(folder / "farm")
    return data, like_3dgs(folder / "splats.ply", read(Data(data)), degree=1)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def one_line(words, capsys):
    assert main([str(word) for word in words]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("surfkit: ")]
    assert len(lines) == 1
    return lines[0]


def test_a_file_becomes_a_run_folder(given, here, capsys):
    data, path = given
    shutil.copy(path, here / "splats.ply")
    assert main(["import", "splats.ply", "--data", str(data)]) == 0
    shown = capsys.readouterr().out
    out = here / "runs" / "farm-splats"
    assert "PSNR" in shown and "250" in shown and "triangles" in shown
    assert {"point_cloud.ply", "cameras.json", "metrics.json", "mesh.ply", "recipe.json"} <= {
        one.name for one in out.iterdir()
    }
    assert json.loads((out / "recipe.json").read_text())["method"] == {
        "use": "import",
        "file": str(here / "splats.ply"),
        "axes": "auto",
        "drawn_as": "auto",
    }
    (here / "splats.ply").unlink()
    for words in (
        ["evaluate", out],
        ["export", out, "--out", "again.ply"],
        ["mesh", out, "mesh:tsdf", "--mesh.voxel", "1", "--metres-per-unit", "1"],
        ["status", out],
    ):
        assert main([str(word) for word in words]) == 0, words
    torch.testing.assert_close(read_splats(here / "again.ply").means, read_splats(path).means, rtol=1e-5, atol=1e-4)
    assert main(["export", str(out), "--out", "page.html"]) == 0
    facts = re.search(r'id="facts">(.*?)</script>', (here / "page.html").read_text()).group(1)
    with loaded(out, "cpu") as (ctx, _):
        assert [view["name"] for view in json.loads(facts)["views"]] == [view.name for view in ctx.scene.train]
    assert main(["compress", str(out), "compress:packed"]) == 0
    (compressed,) = out.rglob("*.surfkit")
    words = ["train", "recipe:3dgs", "start:splats", "--start.file", compressed, "--data", data, "--steps", 2]
    words += ["pretrain.densify:none", "--out", "more"]
    assert main([str(word) for word in words]) == 0
    assert json.loads((here / "more" / "metrics.json").read_text())["points"] == 250


def test_axes_that_are_given(given, here, capsys):
    data, path = given
    SPZ(axes="same").write(here / "a.spz", read_splats(path))
    for axes, means in (("rdf", read_splats(path).means), ("rub", read_splats(path).means * torch.tensor([1, -1, -1]))):
        words = ["import", "a.spz", "--data", str(data), "--axes", axes, "mesh:none", "--out", axes]
        assert main(words) == 0
        found = read_splats(here / axes / "point_cloud.ply").means
        assert torch.cdist(means, found).min(1).values.max() < 0.05
        assert "axes" not in capsys.readouterr().err
        assert json.loads((here / axes / "metrics.json").read_text())["method"]["axes"] == axes


def test_the_recipe_is_the_same(given, here):
    data, path = given
    assert main(["train", "recipe:import", "--method.file", str(path), "--data", str(data), "--out", "out"]) == 0
    assert main(["import", str(path), "--data", str(data), "--out", "out"]) == 0


def test_mistakes_are_one_line(given, here, capsys):
    data, path = given
    assert "FILE none.ply: no such file; name a file of splats" in one_line(
        ["import", "none.ply", "--data", data], capsys
    )
    assert "--data PATH missing" in one_line(["import", path], capsys)
    assert "FILE" in one_line(["import", "--data", data], capsys)
    assert "a folder without point_cloud.ply" in one_line(["import", data, "--data", data], capsys)
    line = one_line(["import", data / "sparse/0/cameras.txt", "--data", data], capsys)
    assert "no file of splats of a known format; known: " in line
    table = read_splats(path)
    table.quats[2] = 0
    write_splats(here / "zero.ply", table)
    line = one_line(["import", "zero.ply", "--data", data], capsys)
    assert "rotation of length 0, splat 2" in line
    line = one_line(["train", "recipe:import", "--method.file", path, "--data", data, "--steps", "5"], capsys)
    assert "method:import makes no optimisation steps" in line
    line = one_line(["train", "recipe:2dgs", "start:splats", "--data", data], capsys)
    assert "--start.file FILE" in line
    assert not (here / "runs").exists()


def test_help(capsys):
    assert main(["import", "--help"]) == 0
    text = capsys.readouterr().out
    assert "Take splats from a file of any program" in text and "mesh:none" in text and "--data" in text
