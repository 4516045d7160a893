"""Levels of detail of a run: made with the other results or by a command, kept, read again and measured."""

import json
import shutil
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from surfkit import hookimpl
from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.compress.levels import LevelsOfDetail, MergedLevels
from surfkit.compress.levels.splat_tree import SplatTree
from surfkit.core import registry
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.io.datasets.data import Data
from surfkit.primitives import Surfel2D
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.folder import discard_results
from surfkit.runs.make_levels import load_levels, make_levels
from surfkit.runs.pipeline import loaded, run
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.testing.synthetic import Flight, photograph, write_colmap

LOD = MergedLevels(tile_points=100, steps=4)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(width=48, height=40, points=300)))
    return Data(folder)


@pytest.fixture(scope="module")
def recipe():
    small = with_steps(recipes()["2dgs"], 6)
    pretrain = replace(small.pretrain, densify=None)
    return replace(small, primitive=Surfel2D(sh_degree=1), pretrain=pretrain, mesh=None, lod=LOD)


@pytest.fixture(scope="module")
def finished(data, recipe, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "run"
    run(recipe, data, out, Compute("cpu"))
    return out


@pytest.fixture
def copy(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "copy")


def test_a_run_makes_the_levels_of_its_recipe(finished, data, recipe, capsys):
    record = json.loads((finished / "lod" / "lod.json").read_text())
    assert record["points"] == [300, 150, 75] and record["blocks"] == 7 and record["steps"] == 6
    assert record["lod"] == {"use": "merge", "tile_points": 100, "steps": 4}
    there = sorted(path.name for path in (finished / "lod").iterdir())
    assert there == ["blocks.safetensors", "level1.safetensors", "level2.safetensors", "lod.json"]
    assert read_json(finished / "recipe.json", Recipe).lod == LOD
    before = (finished / "lod" / "lod.json").stat().st_mtime_ns
    run(recipe, data, finished, Compute("cpu"))
    assert (finished / "lod" / "lod.json").stat().st_mtime_ns == before, "they are there"
    with loaded(finished, "cpu") as (ctx, made):
        tree = load_levels(ctx.run, made.splats)
    assert [len(level) for level in tree.levels] == [300, 150, 75]
    assert torch.equal(tree.levels[0].params["means"], made.splats.params["means"][torch.from_numpy(tree.order)])


def test_evaluate_measures_them(copy, capsys):
    assert main(["evaluate", str(copy), "--lod", "--lod-pixels", "2", "--lpips-weights", "none"]) == 0
    out = capsys.readouterr().out
    assert "level of detail" in out and "selected, 2 px" in out
    found = json.loads((copy / "metrics.json").read_text())["lod"]
    assert [row["points"] for row in found["levels"]] == [300, 150, 75] and found["pixels"] == 2
    bytes_each = 4 * (3 + 4 + 2 + 1 + 12)
    assert [row["bytes"] for row in found["levels"]] == [bytes_each * count for count in (300, 150, 75)]
    metrics = json.loads((copy / "metrics.json").read_text())
    assert found["levels"][0]["psnr"] == pytest.approx(metrics["images"]["psnr"], abs=1e-4)
    assert all(row["psnr"] > 5 and 0 < row["ssim"] < 1 and row["fps"] > 0 for row in found["levels"])
    assert 0 < found["selected"]["points"] <= 300


def test_a_selection_of_no_error_is_the_model(copy):
    assert main(["evaluate", str(copy), "--lod", "--lod-pixels", "0", "--lpips-weights", "none"]) == 0
    found = json.loads((copy / "metrics.json").read_text())["lod"]
    assert found["selected"]["psnr"] == pytest.approx(found["levels"][0]["psnr"], abs=1e-3)


def test_the_command_makes_them_again(copy, capsys):
    assert main(["evaluate", str(copy), "--lod", "--lpips-weights", "none"]) == 0
    assert main(["lod", str(copy), "lod:prune", "--lod.keep", "0.4", "--lod.steps", "0"]) == 0
    assert str(copy / "lod" / "lod.json") in capsys.readouterr().out
    record = json.loads((copy / "lod" / "lod.json").read_text())
    assert record["lod"]["use"] == "prune" and record["points"] == [300, 120]
    assert not (copy / "lod" / "level2.safetensors").exists(), "of the levels before"
    assert "lod" not in json.loads((copy / "metrics.json").read_text()), "they were measured before"
    assert main(["evaluate", str(copy), "--lod", "--lpips-weights", "none"]) == 0


def test_without_a_choice_the_command_takes_that_of_the_recipe(copy):
    shutil.rmtree(copy / "lod")
    assert main(["lod", str(copy), "--lod.steps", "0"]) == 0
    assert json.loads((copy / "lod" / "lod.json").read_text())["points"] == [300, 150, 75]


def test_more_steps_or_another_recipe_make_them_again(copy, data, recipe):
    other = replace(recipe, lod=replace(LOD, tile_points=200))
    run(other, data, copy, Compute("cpu"))
    assert json.loads((copy / "lod" / "lod.json").read_text())["points"] == [300, 150]
    run(with_steps(other, 8), data, copy, Compute("cpu"))
    assert json.loads((copy / "lod" / "lod.json").read_text())["steps"] == 8
    with loaded(copy, "cpu") as (ctx, made):
        load_levels(ctx.run, made.splats)


def test_further_steps_discard_them(copy):
    with loaded(copy, "cpu") as (ctx, _):
        discard_results(ctx.run, ctx.run.pretrain)
    assert not (copy / "lod" / "lod.json").exists()


def test_interrupted_and_continued(copy, monkeypatch):
    """What is finished of the levels is kept; what is there of an earlier model stays until the new ones are whole."""
    from surfkit.compress.levels import refine_levels as refine

    whole = (copy / "lod" / "level1.safetensors").read_bytes(), (copy / "lod" / "level2.safetensors").read_bytes()
    once, made = refine._optimised, []

    def stop(*args):
        made.append(args[4])
        if made == [1, 2]:
            raise KeyboardInterrupt
        return once(*args)

    monkeypatch.setattr(refine, "_optimised", stop)
    assert main(["lod", str(copy)]) == 130
    assert (copy / "lod" / "lod.json").exists() and len(list((copy / "lod").glob("unfinished-*"))) == 1
    assert main(["lod", str(copy)]) == 0
    assert made == [1, 2, 2] and not list((copy / "lod").glob("unfinished-*"))
    again = (copy / "lod" / "level1.safetensors").read_bytes(), (copy / "lod" / "level2.safetensors").read_bytes()
    assert again == whole


def test_what_is_left_of_other_levels_is_deleted(copy):
    left = copy / "lod" / "unfinished-0123"
    left.mkdir()
    assert main(["lod", str(copy), "--lod.steps", "0"]) == 0
    assert not left.exists()


@pytest.mark.parametrize(
    "spoil, text",
    [
        (lambda lod: shutil.rmtree(lod), "there are no levels of detail; `surfkit lod"),
        (lambda lod: (lod / "blocks.safetensors").write_bytes(b"x" * 9), "damaged"),
        (lambda lod: (lod / "level2.safetensors").unlink(), "damaged"),
        (lambda lod: (lod / "level1.safetensors").rename(lod / "level2.safetensors"), "damaged"),
        (
            lambda lod: (lod / "level1.safetensors").write_bytes((lod / "level1.safetensors").read_bytes()[:-8]),
            "damaged",
        ),
        (lambda lod: (lod / "lod.json").write_text("{}"), "lod.json"),
    ],
)
def test_damaged_levels_are_one_line(copy, spoil, text, capsys):
    spoil(copy / "lod")
    assert main(["evaluate", str(copy), "--lod", "--lpips-weights", "none"]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("surfkit: ") and text in error


def test_wrong_options_are_one_line(copy, capsys):
    for words, text in (
        (["evaluate", str(copy), "--lod", "--lod-pixels", "-1"], "--lod-pixels -1: give 0 or more"),
        (["evaluate", str(copy), "--lod-pixels", "1"], "--lod-pixels 1 is for levels of detail; add --lod"),
        (["evaluate", str(copy), "--lod", "--gt", "x.ply"], "--lod is for photographs"),
        (["lod", str(copy), "--metres-per-unit", "0"], "--metres-per-unit 0: it must be more than 0"),
        (["lod", str(copy / "pictures")], "no run folder"),
        (["lod", str(copy), "lod:merge", "--lod.tile-points", "1"], "lod.tile_points is 1"),
    ):
        assert main(words) == 2
        assert text in capsys.readouterr().err


@dataclass(frozen=True)
class Half(LevelsOfDetail):
    """Returns levels of half the model."""

    def refuse_unfit(self, primitive):
        if primitive.sh_degree == 0:
            raise BadInput("colours of one degree or more are needed")

    def build(self, given):
        half = {name: value[::2] for name, value in given.model.params.items()}
        return MergedLevels(steps=0).build(replace(given, model=replace(given.model, params=half)))


@pytest.fixture
def stranger():
    class Package:
        @hookimpl
        def surfkit_components(self):
            return {"half": Half}

    registry.plugins().register(Package(), "stranger")
    yield
    registry.plugins().unregister(name="stranger")


def test_wrong_levels_of_a_stranger_are_one_line(copy, stranger, capsys):
    assert main(["lod", str(copy), "lod:half"]) == 2
    assert "lod:half returned levels that cannot be used: its first" in capsys.readouterr().err
    assert (copy / "lod" / "lod.json").exists(), "what was there is kept"


def test_levels_that_do_not_fit_are_refused_before_training(data, recipe, stranger, tmp_path):
    with pytest.raises(BadInput, match="^lod: .*one degree"):
        run(replace(recipe, lod=Half(), primitive=Surfel2D(sh_degree=0)), data, tmp_path / "run", Compute("cpu"))
    assert not (tmp_path / "run" / "pretrain").exists()


def test_levels_that_cannot_be_had_cost_no_measurements(data, recipe, stranger, tmp_path, capsys):
    metrics = run(replace(recipe, lod=Half()), data, tmp_path / "run", Compute("cpu"))
    assert metrics["images"]["psnr"] > 5
    notes = json.loads((tmp_path / "run" / "run.json").read_text())["notes"]
    assert any("no levels of detail: lod:half" in note for note in notes)


def test_the_same_levels_again(finished, tmp_path):
    again = shutil.copytree(finished, tmp_path / "again")
    with loaded(again, "cpu") as (ctx, made):
        make_levels(ctx.run, LOD, made, ctx.scene, ctx.rasterizer, 1 << 20)
    for name in ("blocks", "level1", "level2"):
        path = f"lod/{name}.safetensors"
        assert np.array_equal(*(np.fromfile(out / path, np.uint8) for out in (finished, again))), name


def test_a_tree_of_splats_is_read_as_one_and_drawn_along_a_path(copy, capsys, tmp_path):
    assert main(["lod", str(copy), "lod:hierarchy", "--lod.tile-points", "100", "--lod.steps", "3"]) == 0
    record = json.loads((copy / "lod" / "lod.json").read_text())
    assert record["points"] == [300, 256, 128, 64, 32, 16, 8, 4, 2, 1] and record["selects"] == "splats"
    with loaded(copy, "cpu") as (ctx, made):
        tree = load_levels(ctx.run, made.splats)
        camera = ctx.scene.train[0].camera
    assert isinstance(tree, SplatTree)
    assert 1 < len(tree.seen(camera, 20.0)) < len(tree.seen(camera, 0.0)) <= 300
    assert len(tree.seen(camera, 1e9)) < len(tree.seen(camera, 20.0)), "a camera within the scene"
    for pixels in ("0", "20"):
        out = tmp_path / pixels
        words = ["render", str(copy), "--lod", "--lod-pixels", pixels, "--seconds", "0.1", "--out", str(out)]
        assert main(words) == 0
        said = capsys.readouterr().out
        assert "of 300 in a mean frame" in said and "ms, the median" in said and len(list(out.glob("*.png"))) == 3
    assert main([*words[:-1], str(tmp_path / "0")]) == 2, "other frames are there"
    assert "frames of another model" in capsys.readouterr().err
    assert main(["evaluate", str(copy), "--lod", "--lod-pixels", "20", "--lpips-weights", "none"]) == 0


def test_levels_of_another_size_are_no_tree(copy, capsys):
    assert main(["lod", str(copy), "lod:hierarchy", "--lod.tile-points", "100", "--lod.steps", "0"]) == 0
    lod = copy / "lod"
    record = json.loads((lod / "lod.json").read_text())
    (lod / "level4.safetensors").write_bytes((lod / "level5.safetensors").read_bytes())
    assert main(["evaluate", str(copy), "--lod", "--lpips-weights", "none"]) == 2
    assert "damaged" in capsys.readouterr().err
    (lod / "lod.json").write_text(json.dumps(record | {"selects": "trees"}))
    assert main(["evaluate", str(copy), "--lod", "--lpips-weights", "none"]) == 2
    assert "selects is 'trees', not blocks or splats" in capsys.readouterr().err


def test_wrong_options_of_a_rendering_are_one_line(copy, capsys):
    for words, text in (
        (["--lod", "--lod-pixels", "-1"], "--lod-pixels -1: give 0 or more"),
        (["--lod-pixels", "1"], "--lod-pixels 1 is for levels of detail; add --lod"),
        (["--lod", "--compressed"], "two models of the run"),
    ):
        assert main(["render", str(copy), *words]) == 2
        assert text in capsys.readouterr().err
