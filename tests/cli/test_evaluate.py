"""`surfkit evaluate`: what it prints, writes and refuses."""

import json
import shutil

import numpy as np
import pytest
import torch

from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.pipeline import run, with_steps
from surfkit.scene.data import Data
from surfkit.scene.ply import write_points
from surfkit.scene.synthetic import Flight, photograph, write_colmap


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set, the ground that it shows, and a finished run whose mesh is that ground, 1 cm too high."""
    torch.set_num_threads(2)
    path = tmp_path_factory.mktemp("evaluate")
    write_colmap(path / "data", photograph(Flight(width=64, height=48, points=300)))
    run(with_steps(recipes()["2dgs"], 2), Data(path / "data"), path / "run")
    x, y = np.meshgrid(np.arange(-9, 9, 0.2), np.arange(-9, 9, 0.2))
    ground = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    write_points(path / "truth.ply", ground, np.zeros((len(ground), 3), np.uint8))
    write_points(path / "run" / "mesh.ply", ground + [0, 0, 0.01], np.zeros((len(ground), 3), np.uint8))
    return path


def spoken(capsys, *words):
    status = main(["evaluate", *map(str, words)])
    return status, *capsys.readouterr()


def test_geometry_goes_beside_the_other_figures(folder, capsys):
    before = json.loads((folder / "run" / "metrics.json").read_text())
    status, said, _ = spoken(capsys, folder / "run", "--gt", folder / "truth.ply", "--draws", 1, "--visible", 0.4)
    metrics = json.loads((folder / "run" / "metrics.json").read_text())
    geometry = metrics.pop("geometry")
    assert status == 0 and metrics == before and geometry["f1"] == 1 and geometry["crop"]["from"] == "auto"
    assert "F1" in said and "similarity" in said and str(folder / "run" / "geometry" / "plan.png") in said
    assert spoken(capsys, folder / "run", "--lpips-weights", "none")[0] == 0  # the pictures once more
    after = json.loads((folder / "run" / "metrics.json").read_text())
    assert after["geometry"] == geometry and after["images"]["psnr"] == pytest.approx(before["images"]["psnr"])
    assert after["images"]["lpips_not_measured"] == "left out, by --lpips-weights none"


@pytest.mark.parametrize("views", ["run", "data"])
def test_a_file_needs_no_run(folder, capsys, tmp_path, views):
    options = (
        "--gt",
        folder / "truth.ply",
        "--views",
        folder / views,
        "--draws",
        1,
        "--out",
        tmp_path,
        "--visible",
        0.4,
    )
    assert spoken(capsys, folder / "run" / "mesh.ply", *options)[0] == 0
    assert json.loads((tmp_path / "metrics.json").read_text())["geometry"]["f1"] == 1
    crop = tmp_path / "geometry" / "crop.json"
    status, said, _ = spoken(capsys, folder / "truth.ply", *options[:2], "--crop", crop, *options[4:8])
    assert status == 0 and "+-" not in said and "area" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{f}/truth.ply"], "name the truth with --gt"),
        (["{f}/truth.ply", "--gt", "{f}/truth.ply"], "--crop auto needs the photographs"),
        (["{f}/truth.ply", "--gt", "{f}/nothing.ply", "--crop", "none"], "no such file"),
        (["{f}/run", "--views", "{f}/data"], "give --gt, too"),
        (["{f}/run", "--tau", "0.3"], "give --gt, too"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--device", "cpu"], "are for photographs"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--views", "{f}/data"], "a run has views of its own"),
        (["{f}/data", "--gt", "{f}/truth.ply"], "no run folder"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--tau", "0"], "--tau 0: it is a length"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--crop", "{f}/data"], "cannot be read"),
        (["{f}/run", "--lpips-weights", "{f}"], "neither vgg16.ckpt"),
    ],
)
def test_mistakes_are_one_line(folder, capsys, words, message):
    status, said, error = spoken(capsys, *(word.format(f=folder) for word in words))
    lines = [line for line in error.splitlines() if not line.startswith("note:")]
    assert status == 2 and not said and len(lines) == 1 and message in lines[0], error


def test_a_run_without_a_mesh(folder, capsys, tmp_path):
    for name in ("recipe.json", "run.json"):
        (tmp_path / name).write_bytes((folder / "run" / name).read_bytes())
    status, _, error = spoken(capsys, tmp_path, "--gt", folder / "truth.ply")
    assert status == 2 and "no mesh.ply in it; make it with surfkit mesh" in error


def test_a_mesh_of_an_earlier_model_is_not_measured(folder, capsys, tmp_path):
    shutil.copytree(folder / "run", tmp_path / "run")
    (tmp_path / "run" / "mesh.json").unlink()
    status, said, error = spoken(capsys, tmp_path / "run", "--gt", folder / "truth.ply")
    assert status == 2 and not said and "mesh.ply: without mesh.json it is of an earlier model" in error
    assert spoken(capsys, folder / "run", "--lpips-weights", "none")[1].count("mesh.ply") == 1
    assert "mesh.ply" not in spoken(capsys, tmp_path / "run", "--lpips-weights", "none")[1]


def test_another_unit_is_told(folder, capsys, tmp_path):
    y, x = np.meshgrid(np.arange(-9, 9, 0.2), np.arange(-9, 9, 0.2))
    small = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) / 1000
    write_points(tmp_path / "small.ply", small, np.zeros((len(small), 3), np.uint8))
    words = (tmp_path / "small.ply", "--gt", folder / "truth.ply", "--views", folder / "run", "--visible", 0.4)
    status, _, error = spoken(capsys, *words)
    assert status == 2 and "another unit?" in error and "--transform" in error
    assert not list(tmp_path.glob("small-geometry/*"))
