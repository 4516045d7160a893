"""Training that goes on from splats: it begins at their pictures, improves them, resumes, and says what is lost."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from listening import listening
from models import data_set, like_3dgs, with_column

from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.events import Warned
from surfkit.core.schedule import LearningRate
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.io.splats.ply import read_splats, write_splats
from surfkit.partition import QuantileGrid
from surfkit.primitives import Gaussian3D
from surfkit.raster.select import select
from surfkit.runs.pipeline import Intervals, load_run, run
from surfkit.runs.recipe import with_steps
from surfkit.start.base import StartInput
from surfkit.start.splat_start import SplatStart
from surfkit.testing import check_start
from surfkit.testing.inputs import start_input
from surfkit.train.trainer import Trainer


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    return Data(data_set(tmp_path_factory.mktemp("data")))


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """A short run of discs."""
    out = tmp_path_factory.mktemp("trained")
    return out, run(replace(with_steps(recipes()["2dgs"], 40), mesh=None), data, out)


def going_on(file, name="2dgs", steps=30, **changes):
    recipe = evolve(evolve(recipes()[name], "pretrain.densify", None), "mesh", None)
    recipe = with_steps(evolve(recipe, "start", SplatStart(file)), steps)
    for path, value in changes.items():
        recipe = evolve(recipe, path.replace("__", "."), value)
    return recipe


def known(data):
    return StartInput(read(data), (), None, None, torch.Generator().manual_seed(0))


def notes(out):
    return " ".join(json.loads((out / "run.json").read_text())["notes"])


def test_it_begins_at_the_same_pictures_and_degree(data, trained):
    out, _ = trained
    state, scene = load_run(out)[1:]
    model = SplatStart(out).model(recipes()["2dgs"].primitive, known(data), torch.Generator())
    assert model.sh_degree == 3
    primitive, rasterizer = recipes()["2dgs"].primitive, select("cpu")[0]
    for view in scene.held_out:
        before, after = (
            rasterizer.render(primitive.activate(params, 3), view.camera, 0.005, geometry=False).maps.color
            for params in (state.points.all_params(), model.params)
        )
        assert (before - after).abs().max() < 1 / 255
    for name in ("quats", "opacities", "sh0", "sh_rest"):
        assert torch.equal(model.params[name], state.points.params[name]), name


def test_steps_at_rate_0_keep_the_metrics_and_others_improve_them(data, trained, tmp_path):
    out, metrics = trained
    still = going_on(out, steps=3)
    zero = {name: LearningRate(0.0) for name in still.primitive.columns()}
    begun = run(evolve(still, "pretrain.rates", zero), data, tmp_path / "still")
    assert begun["images"]["psnr"] == pytest.approx(metrics["images"]["psnr"], abs=0.01)
    assert begun["points"] == metrics["points"]
    further = run(going_on(out, steps=60), data, tmp_path / "further")
    losses = [
        json.loads(line)["losses"]
        for line in (tmp_path / "further" / "events.jsonl").read_text().splitlines()
        if json.loads(line)["event"] == "StepDone"
    ]
    totals = [sum(one.values()) for one in losses]
    assert sum(totals[-10:]) < 0.97 * sum(totals[:10])
    assert further["images"]["psnr"] > metrics["images"]["psnr"]
    assert load_run(tmp_path / "further")[1].sh_degree == 3


class Stop(Exception):
    """In the place of a power cut."""


def test_it_resumes_without_the_file_and_refuses_another(data, trained, tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes((trained[0] / "point_cloud.ply").read_bytes())
    recipe, often = going_on(path, steps=20), Intervals(checkpoint=10)
    whole = run(recipe, data, tmp_path / "whole", intervals=often)

    step = Trainer.step

    def interrupted(self, state):
        if state.index == 10:
            raise Stop
        return step(self, state)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        patch.setattr(Trainer, "step", interrupted)
        run(recipe, data, tmp_path / "cut", intervals=often)
    table = read_splats(path)
    write_splats(path, replace(table, opacity_logits=table.opacity_logits + 0.1))
    with pytest.raises(BadInput, match="a.ply has changed"):
        run(recipe, data, tmp_path / "cut", intervals=often)
    path.unlink()
    again = run(recipe, data, tmp_path / "cut", intervals=often)
    assert again["images"]["psnr"] == whole["images"]["psnr"]
    first, second = (load_run(tmp_path / name)[1].points.params for name in ("whole", "cut"))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_blocks_go_on_too(data, trained, tmp_path):
    changes = {"partition": QuantileGrid(blocks=(2, 1)), "min_views": 1, "tune__densify": None, "tune__steps": 5}
    metrics = run(going_on(trained[0], steps=5, **changes), data, tmp_path / "out")
    assert metrics["steps"] == 10 and metrics["images"]["psnr"] > trained[1]["images"]["psnr"] - 1


def test_discs_become_ellipsoids_and_back_with_a_note(data, trained, tmp_path):
    metrics = run(going_on(trained[0], "3dgs", steps=2), data, tmp_path / "balls")
    assert "surfels become gaussians" in notes(tmp_path / "balls")
    assert abs(metrics["images"]["psnr"] - trained[1]["images"]["psnr"]) < 2
    back = run(going_on(tmp_path / "balls", "2dgs", steps=2), data, tmp_path / "discs")
    assert "gaussians become surfels" in notes(tmp_path / "discs")
    assert abs(back["images"]["psnr"] - trained[1]["images"]["psnr"]) < 2


@pytest.mark.parametrize("thin", [False, True])
def test_ellipsoids_that_are_pressed_flat_are_told_unless_they_are_flat(data, tmp_path, thin):
    path = like_3dgs(tmp_path / "a.ply", read(data))
    if thin:
        table = read_splats(path)
        table.log_scales[:, 1] -= 8
        write_splats(path, table)
    run(going_on(path, "flat3dgs", steps=1), data, tmp_path / "out")
    assert ("gaussians become gaussians without their thinnest axis" in notes(tmp_path / "out")) != thin


def test_harmonics_that_are_cut_and_another_antialias_are_told(data, tmp_path):
    path = like_3dgs(tmp_path / "a.ply", read(data))
    run(going_on(path, "3dgs", steps=1, primitive=Gaussian3D(sh_degree=1, antialias=True)), data, tmp_path / "out")
    assert "cut to 1; --primitive.sh-degree 3" in notes(tmp_path / "out")
    assert "add --primitive.no-antialias" in notes(tmp_path / "out")
    assert load_run(tmp_path / "out")[1].sh_degree == 1


def test_a_filter_without_a_word_on_the_drawing_is_told(data, tmp_path):
    path = like_3dgs(tmp_path / "a.ply", read(data))
    with_column(path, "filter_3D", np.full(len(read_splats(path)), 0.01))
    scene = read(data)
    others = Gaussian3D(antialias=True), Gaussian3D(geometry="ray")
    for primitive, told in ((Gaussian3D(), True), *((each, False) for each in others)):
        with listening(Warned, lambda event: event.text) as heard:
            SplatStart(path).refuse_unfit(primitive, scene)
        assert any("filter_3D is applied" in text and "--primitive.geometry ray" in text for text in heard) == told
        assert not any("antialias; add" in text for text in heard), "nothing says with or without"


def test_files_of_lower_degrees_learn_the_others(data, tmp_path):
    path = like_3dgs(tmp_path / "a.ply", read(data), degree=1)
    known_model = SplatStart(path).model(Gaussian3D(), known(data), torch.Generator())
    assert known_model.sh_degree == 1 and known_model.params["sh_rest"].shape == (250, 15, 3)


def test_the_contract_of_a_start(tmp_path):
    scene = start_input().scene
    check_start(SplatStart(like_3dgs(tmp_path / "a.ply", scene)))


def test_what_it_cannot_begin_at(data, trained, tmp_path):
    with pytest.raises(BadInput, match="start.file .*--start.file FILE"):
        run(going_on(None), data, tmp_path / "out")
    with pytest.raises(BadInput, match="start.file .*none.ply: no such"):
        run(going_on(tmp_path / "none.ply"), data, tmp_path / "out")
    path = like_3dgs(tmp_path / "a.ply", read(data))
    table = read_splats(path)
    table.quats[3] = 0
    write_splats(path, table)
    with pytest.raises(BadInput, match="1 of 250 .*rotation .*splat 3 "):
        run(going_on(path), data, tmp_path / "out")
    assert not (tmp_path / "out" / "recipe.json").exists()


def test_splats_of_another_place_are_told(data, tmp_path):
    path = like_3dgs(tmp_path / "a.ply", read(data))
    write_splats(path, replace(read_splats(path), means=read_splats(path).means + 1e4))
    run(going_on(path, "3dgs", steps=1), data, tmp_path / "out")
    assert "no splat lies in any training view" in notes(tmp_path / "out")
