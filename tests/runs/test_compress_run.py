"""The compressed model of a run: made with other results or by a command, measured, read wherever a model is."""

import json
import re
import shutil
from dataclasses import replace

import pytest
import torch

from surfkit.apps.run_summary import compressed_rows
from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.compress.base import Compressor
from surfkit.compress.container import read_model
from surfkit.compress.packed import Packed
from surfkit.compress.vectree import Vectree
from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.splats.splat_files import read_splat_file
from surfkit.mesh.tsdf import TSDF
from surfkit.primitives import Surfel2D
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.compress_model import CompressionTarget, fitted, importance_of
from surfkit.runs.folder import discard_results
from surfkit.runs.pipeline import loaded, run
from surfkit.runs.recipe import with_steps
from surfkit.testing.synthetic import Flight, photograph, write_colmap

COMPRESS = Vectree(ratio=0.5, codes=16)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(width=48, height=40, points=300)))
    return Data(folder)


@pytest.fixture(scope="module")
def recipe():
    small = with_steps(recipes()["2dgs"], 6)
    pretrain = replace(small.pretrain, densify=None)
    return replace(small, primitive=Surfel2D(sh_degree=1), pretrain=pretrain, mesh=None, compress=COMPRESS)


@pytest.fixture(scope="module")
def finished(data, recipe, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "run"
    run(recipe, data, out, Compute("cpu"))
    return out


@pytest.fixture
def copy(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "copy")


def record_of(out):
    return json.loads((out / "compressed" / "compressed.json").read_text())


def metrics_of(out):
    return json.loads((out / "metrics.json").read_text())


def test_a_run_ends_in_the_model_of_its_recipe(finished, data, recipe):
    path = finished / "compressed" / "model.surfkit"
    record, found = record_of(finished), metrics_of(finished)["compressed"]
    assert record["compressor"]["use"] == "vectree" and record["steps"] == 6 and record["points"] == 300
    assert record["bytes"] == path.stat().st_size == found["bytes"]
    assert record["ply_bytes"] == (finished / "point_cloud.ply").stat().st_size == found["ply_bytes"]
    assert found["images"]["psnr"] == pytest.approx(metrics_of(finished)["images"]["psnr"], abs=1)
    assert all(speed > 0 for speed in found["fps_before_and_after"])
    assert len(list((finished / "compressed" / "pictures").rglob("*.png"))) > 0
    before = path.stat().st_mtime_ns
    run(recipe, data, finished, Compute("cpu"))
    assert path.stat().st_mtime_ns == before, "it is there"


def test_the_points_that_contribute_least_get_codes(finished):
    with loaded(finished, "cpu") as (ctx, made):
        importance = importance_of(made.splats, ctx.scene.train, ctx.rasterizer)
        own = made.splats.params
    model, frame = read_model(finished / "compressed" / "model.surfkit")
    assert frame.scale == ctx.scene.frame.scale
    nearest = torch.cdist(own["means"], model.params["means"]).argmin(1)
    assert len(set(nearest.tolist())) == 300
    vectors = torch.cat([model.params["sh0"], model.params["sh_rest"]], 1)[nearest].flatten(1)
    exact = torch.cat([own["sh0"], own["sh_rest"]], 1).flatten(1).half().float()
    kept = (vectors == exact).all(1)
    most = importance.argsort()[150:]
    assert kept[most].all() and len(torch.unique(vectors[~kept], dim=0)) <= 16 < (~kept).sum()


def test_evaluate_mesh_and_export_read_it(copy, tmp_path, capsys):
    own = (copy / "metrics.json").read_text()
    assert main(["evaluate", str(copy), "--compressed", "--lpips-weights", "none"]) == 0
    there = json.loads((copy / "compressed" / "metrics.json").read_text())
    assert there["images"]["psnr"] == metrics_of(copy)["compressed"]["images"]["psnr"]
    assert metrics_of(copy)["images"] == json.loads(own)["images"], "those of the run are as they were"
    model = copy / "compressed" / "model.surfkit"
    assert main(["export", str(model), "--out", str(tmp_path / "a.ply")]) == 0
    assert len(read_splat_file(tmp_path / "a.ply")) == 300 == len(read_splat_file(model))
    assert main(["evaluate", str(copy), "--compressed", "--gt", str(tmp_path / "a.ply")]) == 2
    assert "no mesh.ply in it" in capsys.readouterr().err


def test_a_mesh_of_it_lies_in_its_folder_and_is_measured(data, recipe, tmp_path, quick_comparison):
    out = tmp_path / "run"
    run(replace(recipe, mesh=TSDF(least_views=1)), data, out, Compute("cpu"))
    words = ["--mesh.least-views", "1", "--clusters", "1", "--least-triangles", "1"]
    assert main(["mesh", str(out), "mesh:tsdf", *words]) == 0
    before = (out / "mesh.ply").read_bytes()
    assert main(["mesh", str(out), "mesh:tsdf", *words, "--compressed"]) == 0
    assert (out / "mesh.ply").read_bytes() == before != (out / "compressed" / "mesh.ply").read_bytes()
    truth = str(out / "mesh.ply")
    assert main(["evaluate", str(out), "--compressed", "--gt", truth, "--tau", "0.5", "--samples", "2000"]) == 0
    assert 0 < metrics_of(out)["compressed"]["geometry"]["f1"] <= 1
    assert main(["compress", str(out), "compress:lossless"]) == 0
    assert "geometry" not in metrics_of(out)["compressed"] and not (out / "compressed" / "mesh.json").exists()


def test_it_is_imported_and_trained_further(copy, data, tmp_path):
    model = str(copy / "compressed" / "model.surfkit")
    assert main(["import", model, "--data", str(data.path), "--out", str(tmp_path / "in"), "mesh:none"]) == 0
    assert metrics_of(tmp_path / "in")["images"]["psnr"] == pytest.approx(
        metrics_of(copy)["compressed"]["images"]["psnr"], abs=0.01
    )
    words = ["train", "recipe:2dgs", "start:splats", "--start.file", model, "mesh:none", "--steps", "2"]
    assert main([*words, "--data", str(data.path), "--out", str(tmp_path / "on")]) == 0


def test_the_command_makes_it_again(copy, capsys):
    assert main(["compress", str(copy), "compress:packed"]) == 0
    assert record_of(copy)["compressor"] == {"use": "packed"} | vars(Packed())
    assert "times smaller" in capsys.readouterr().out
    assert main(["compress", str(copy)]) == 0
    assert record_of(copy)["compressor"]["use"] == "vectree", "that of the recipe"


def told_size(text):
    """Compressor and MB of the line about the other one."""
    (found,) = re.findall(r"With compress:(\w+) it would be about ([\d.]+) MB, ([\d.]+) times (smaller|larger)\.", text)
    return found


def test_without_a_recipe_that_names_one_it_is_packed_and_the_other_is_told(copy, capsys):
    recipe = json.loads((copy / "recipe.json").read_text())
    (copy / "recipe.json").write_text(json.dumps(recipe | {"compress": None}))
    assert main(["compress", str(copy)]) == 0
    packed, told = record_of(copy), told_size(capsys.readouterr().out)
    assert packed["compressor"] == {"use": "packed"} | vars(Packed())
    assert main(["compress", str(copy), "compress:vectree"]) == 0
    vectree, text = record_of(copy), capsys.readouterr().out
    assert "it would be" not in text, "who names one knows"
    assert told[0] == "vectree" and float(told[1]) == pytest.approx(vectree["bytes"] / 1e6, rel=0.1, abs=0.005)
    assert told[3] == "larger" and float(told[2]) == pytest.approx(vectree["bytes"] / packed["bytes"], rel=0.1)
    (copy / "recipe.json").write_text(json.dumps(recipe))
    assert main(["compress", str(copy)]) == 0
    name, megabytes, _, change = told_size(capsys.readouterr().out)
    assert (name, change) == ("packed", "smaller")
    assert float(megabytes) == pytest.approx(packed["bytes"] / 1e6, abs=0.005), "by the same encoding"


def test_a_size_and_a_loss_can_be_wished_for(copy):
    assert main(["compress", str(copy), "compress:packed", "--target-size", "9500"]) == 0
    small = record_of(copy)["bytes"]
    assert 9_000 < small <= 9_500
    assert main(["compress", str(copy), "compress:packed", "--target-loss", "0.01dB"]) == 0
    fine = record_of(copy)
    assert fine["compressor"]["color"] < Packed().color * 32
    assert main(["compress", str(copy), "compress:packed", "--target-loss", "3dB"]) == 0
    assert record_of(copy)["bytes"] < fine["bytes"]


def test_what_cannot_be_reached_is_one_line(copy, capsys):
    before, metrics = record_of(copy), metrics_of(copy)
    for words, text in (
        (["--target-size", "100"], "does not come to 100 bytes with any setting"),
        (["--target-size", "1MB", "--target-loss", "1"], "give one of the two"),
        (["--target-loss", "x"], "--target-loss x: give a loss of PSNR above 0"),
        (["--target-size", "auto"], "give a size such as 50MB"),
        (["compress:lossless", "--target-size", "1KB"], "compress:lossless has no setting for size against loss"),
        (["--out", "a.surfkit"], "keeps its compressed model in its folder"),
        (["compress:vectree", "--compress.ratio", "2"], "compress.ratio is 2"),
    ):
        more = [] if any("compress:" in word for word in words) else ["compress:packed"]
        assert main(["compress", str(copy), *more, *words]) == 2
        assert text in capsys.readouterr().err
    assert (record_of(copy), metrics_of(copy)) == (before, metrics), "what was there stays"


def test_without_the_file_it_cannot_be_read(copy, capsys):
    model = copy / "compressed" / "model.surfkit"
    model.write_bytes(model.read_bytes()[:-1])
    assert main(["evaluate", str(copy), "--compressed"]) == 2
    assert str(model) in capsys.readouterr().err
    with loaded(copy, "cpu") as (ctx, _):
        discard_results(ctx.run, ctx.run.pretrain)
    assert main(["evaluate", str(copy), "--compressed"]) == 2
    assert "there is no compressed model; `surfkit compress" in capsys.readouterr().err


def test_a_file_becomes_one_without_photographs(copy, tmp_path, capsys):
    cloud = tmp_path / "a.ply"
    shutil.copy(copy / "point_cloud.ply", cloud)
    assert main(["compress", str(cloud), "compress:packed"]) == 0
    assert "times fewer" in capsys.readouterr().out
    before, after = read_splat_file(cloud), read_splat_file(tmp_path / "a.surfkit")
    assert (
        torch.cdist(before.means.double(), after.means.double()).amin(1).max() < 0.05 * before.log_scales.exp().median()
    )
    assert main(["compress", str(cloud), "compress:vectree"]) == 2
    assert "needs the contributions to training views" in capsys.readouterr().err
    assert main(["compress", str(tmp_path / "a.surfkit"), "compress:packed"]) == 2
    assert "the file itself would be replaced" in capsys.readouterr().err


def test_a_compressor_that_fails_costs_no_measurements(data, recipe, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Vectree, "plan", lambda *_: (_ for _ in ()).throw(BadInput("not today")))
    run(recipe, data, tmp_path / "run", Compute("cpu"))
    assert "no compressed model: not today" in capsys.readouterr().err
    assert "images" in metrics_of(tmp_path / "run") and "compressed" not in metrics_of(tmp_path / "run")


def test_bisection_finds_the_largest_errors_that_fit():
    """Against a compressor whose files are known: 1000 bytes over the factor."""

    class Known(Compressor):
        def __init__(self, factor=1.0):
            self.factor = factor

        def plan(self, model, importance, seed, device):
            return self

        def coarser(self, factor):
            return Known(factor)

    found = fitted(Known(), CompressionTarget(bytes=300), lambda path, tried: 1000 / tried.factor)
    assert 3.333 <= found.factor < 3.6


def test_f1_of_other_thresholds_stand_not_side_by_side():
    """Nor are there figures that only another protocol has: that of DTU has no F1."""
    record = {"ply_bytes": 100, "bytes": 10, "points": 1}
    whole = {"images": {}, "geometry": {"f1": 0.9, "truth": "scan.ply", "tau": 0.5}}

    def told(**others):
        rows = compressed_rows(record, whole | {"compressed": {"images": {}, "geometry": whole["geometry"] | others}})
        return [row[1:] for row in rows if row[0] == "F1"]

    assert told(f1=0.8) == [("0.9000", "0.8000 (-0.1000)")]
    assert told(f1=0.8, tau=0.25) == told(f1=0.8, truth="mesh.ply") == told(f1=None) == []
