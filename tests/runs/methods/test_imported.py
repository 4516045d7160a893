"""Splats from files as runs: the pictures and figures of where they came from, and what is wrong in one line."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from listening import listening
from models import ORIGIN, data_set, like_3dgs, with_column
from PIL import Image

from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.events import Warned
from surfkit.core.registry import components
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.fingerprint import changed_file, fingerprint
from surfkit.io.datasets.read import read
from surfkit.io.splats.base import Format
from surfkit.io.splats.ply import read_splats, write_splats
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.model import FORMS
from surfkit.runs.methods.imported import SplatImport
from surfkit.runs.pipeline import loaded, run
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.testing import check_method


def reads(form):
    return form.read is not Format.read


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    return Data(data_set(tmp_path_factory.mktemp("data")))


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """A short run of discs."""
    out = tmp_path_factory.mktemp("trained")
    return out, run(replace(with_steps(recipes()["2dgs"], 40), mesh=None), data, out)


def imported(file, data, out, **changes):
    return run(Recipe(method=SplatImport(file), **changes), data, out)


def pictures(out, view):
    return np.asarray(Image.open(out / "pictures" / f"{view}.png")).astype(int)


def test_a_run_that_is_written_and_read_again_draws_the_same(data, trained, tmp_path):
    out, metrics = trained
    again = imported(out / "point_cloud.ply", data, tmp_path / "again")
    assert again["images"]["psnr"] == pytest.approx(metrics["images"]["psnr"], abs=0.01)
    assert again["points"] == metrics["points"] and again["steps"] == 0
    for view in metrics["images"]["per_image"]:
        assert np.abs(pictures(tmp_path / "again", view) - pictures(out, view))[:, :96].max() <= 1
    first, second = read_splats(out / "point_cloud.ply"), read_splats(tmp_path / "again" / "point_cloud.ply")
    torch.testing.assert_close(first.means, second.means, rtol=0, atol=1e-5)
    with loaded(tmp_path / "again", "cpu") as (_, made):
        assert made.splats.primitive == Surfel2D(sh_degree=3)
        assert made.facts == {"file": str(out / "point_cloud.ply"), "kind": "surfel", "sh_degree": 3, "axes": "rdf"}


def test_the_folder_of_a_run_is_its_points(data, trained, tmp_path):
    out, metrics = trained
    assert imported(out, data, tmp_path / "again")["points"] == metrics["points"]


def test_the_contract_of_a_method(data, trained, tmp_path):
    check_method(SplatImport(trained[0] / "point_cloud.ply"), data, tmp_path)


LOSS = {"ply": 0.01, "compressed-ply": 0.5, "spz": 0.5, "sog": 0.5, "splat": 3.0}
"""Of PSNR, dB, that the rounding of a format may cost; .splat has no harmonics."""


@pytest.mark.parametrize("far", [False, True], ids=["near", "far"])
@pytest.mark.parametrize("kind", ["discs", "ellipsoids"])
@pytest.mark.parametrize("name", [name for name, cls in sorted(components(Format).items()) if reads(cls)])
def test_every_format(data, trained, tmp_path, name, kind, far):
    out = trained[0]
    scene = read(data)
    path = out / "point_cloud.ply" if kind == "discs" else like_3dgs(tmp_path / "a.ply", scene)
    table, form = read_splats(path), components(Format)[name]()
    before = imported(path, data, tmp_path / "before")["images"]["psnr"]
    if far:
        data = Data(data_set(tmp_path / "far", far=True))
        scene = read(data)
        table = replace(table, means=table.means.double() + torch.tensor(ORIGIN, dtype=torch.float64))
    file = tmp_path / f"b{form.suffix}"
    form.write(file, table, scene.frame)
    after = imported(file, data, tmp_path / "out")
    with loaded(tmp_path / "out", "cpu") as (_, made):
        assert made.facts["kind"] == {"discs": "surfel", "ellipsoids": "gaussian"}[kind]
    assert after["points"] == len(table)
    assert after["images"]["psnr"] == pytest.approx(before, abs=LOSS.get(name, 0.5))


@pytest.mark.parametrize("degree", [0, 3])
def test_files_of_3dgs_are_ellipsoids(data, tmp_path, degree):
    scene = read(data)
    path = like_3dgs(tmp_path / "a.ply", scene, degree)
    assert b"surfkit" not in path.read_bytes()
    metrics = imported(path, data, tmp_path / "out")
    with loaded(tmp_path / "out", "cpu") as (_, made):
        assert made.splats.primitive == Gaussian3D(sh_degree=degree) and made.splats.sh_degree == degree
        torch.testing.assert_close(made.splats.params["means"], scene.cloud.xyz, rtol=0, atol=1e-5)
        scales = made.splats.params["scales"].mean().item()
    assert scales == pytest.approx(-3, abs=0.1), "lengths are local"
    assert metrics["images"]["psnr"] > 8 and metrics["points"] == len(scene.cloud.xyz)


def test_antialias_is_kept(data, tmp_path):
    path = like_3dgs(tmp_path / "a.ply", read(data))
    write_splats(path, replace(read_splats(path), antialias=True))
    imported(path, data, tmp_path / "out")
    with loaded(tmp_path / "out", "cpu") as (_, made):
        assert made.splats.primitive.antialias


@pytest.mark.parametrize("drawn_as", FORMS)
def test_ellipsoids_are_drawn_as_the_program_that_trained_them(data, tmp_path, drawn_as):
    """A run that draws so, written to a file that does not say how, has the figures of that run again."""
    source = replace(with_steps(recipes()["3dgs"], 20), mesh=None, primitive=Gaussian3D(**FORMS[drawn_as]))
    metrics = run(source, data, tmp_path / "source")
    path = tmp_path / "a.ply"
    write_splats(path, replace(read_splats(tmp_path / "source" / "point_cloud.ply"), antialias=False))
    found = {
        name: run(Recipe(method=SplatImport(path, drawn_as=name)), data, tmp_path / name)["images"]["psnr"]
        for name in (drawn_as, "auto")
    }
    assert found[drawn_as] == pytest.approx(metrics["images"]["psnr"], abs=0.01)
    assert (found["auto"] == found[drawn_as]) == (drawn_as == "3dgs")


def test_a_filter_without_a_word_on_the_drawing_is_told(data, tmp_path):
    """As Mip-Splatting and Gaussian Opacity Fields write."""
    path = like_3dgs(tmp_path / "a.ply", read(data))
    with_column(path, "filter_3D", np.full(len(read_splats(path)), 0.01))
    for drawn_as, count in (("auto", 1), ("gof", 0)):
        with listening(Warned, lambda event: event.text) as notes:
            run(Recipe(method=SplatImport(path, drawn_as=drawn_as)), data, tmp_path / drawn_as)
        assert sum("filter_3D" in note for note in notes) == count


def test_discs_are_drawn_as_discs(data, trained, tmp_path):
    with pytest.raises(BadInput, match="are discs, and drawn-as gof"):
        run(Recipe(method=SplatImport(trained[0] / "point_cloud.ply", drawn_as="gof")), data, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("named", [True, False])
def test_survey_coordinates_lose_no_digits(tmp_path, named):
    data = Data(data_set(tmp_path / "data", far=True))
    scene = read(data)
    assert np.linalg.norm(np.subtract(scene.frame.shift, ORIGIN)[:2]) < 100
    path = like_3dgs(tmp_path / "a.ply", scene)
    if named:
        write_splats(path, replace(read_splats(path), means=far(scene)), frame=scene.frame)
        assert b"comment offset: 49" in path.read_bytes()
    else:  # as in formats that have no place for the offset
        write_splats(path, replace(read_splats(path), means=far(scene) - torch.tensor(scene.frame.shift)))
        assert b"offset" not in path.read_bytes()
    metrics = imported(path, data, tmp_path / "out")
    with loaded(tmp_path / "out", "cpu") as (_, made):
        torch.testing.assert_close(made.splats.params["means"], scene.cloud.xyz, rtol=0, atol=2e-5)
    assert metrics["images"]["psnr"] > 8
    assert "no splat" not in " ".join(json.loads((tmp_path / "out" / "run.json").read_text())["notes"])


def far(scene):
    """The sparse points in the frame of the data set, float64."""
    return torch.from_numpy(scene.frame.to_input(scene.cloud.xyz.numpy()))


def test_splats_of_another_place_are_told(data, tmp_path):
    scene = read(data)
    path = like_3dgs(tmp_path / "a.ply", scene)
    write_splats(path, replace(read_splats(path), means=read_splats(path).means + 1e4))
    imported(path, data, tmp_path / "out")
    notes = json.loads((tmp_path / "out" / "run.json").read_text())["notes"]
    assert len(notes) == 1 and "no splat lies in any training view" in notes[0] and "other coordinates" in notes[0]


@pytest.mark.parametrize(
    ("column", "value", "text"),
    [
        ("means", torch.nan, "means of splat 7 of 250 has NaN"),
        ("sh_rest", -torch.inf, "sh_rest of splat 7 of 250 has NaN"),
        ("quats", 0.0, "1 of 250 splats have a rotation of length 0, splat 7 is the first"),
        ("log_scales", -200.0, "a scale of 0 or beyond float32, splat 7"),
        ("log_scales", 100.0, "a scale of 0 or beyond float32, splat 7"),
    ],
)
def test_values_that_cannot_be_drawn(data, tmp_path, column, value, text):
    path = like_3dgs(tmp_path / "a.ply", read(data))
    table = read_splats(path)
    getattr(table, column)[7] = value
    write_splats(path, table)
    with pytest.raises(BadInput) as error:
        imported(path, data, tmp_path / "out")
    assert str(path) in str(error.value) and text in str(error.value)
    assert not (tmp_path / "out" / "recipe.json").exists(), "nothing is begun"


def test_files_that_are_none(data, trained, tmp_path):
    source = trained[0] / "point_cloud.ply"
    write_splats(tmp_path / "empty.ply", read_splats(source).take(slice(0, 0)))
    (tmp_path / "text.ply").write_text("no splats here")
    (tmp_path / "cut.ply").write_bytes(source.read_bytes()[:-500])
    (tmp_path / "folder").mkdir()
    wrong = {
        "empty.ply": "there are no splats in it",
        "text.ply": "no file of splats of a known format",
        "cut.ply": "cut off after",
        "folder": "a folder without point_cloud.ply",
        "none.ply": "no such file",
    }
    for name, text in wrong.items():
        with pytest.raises(BadInput, match=text):
            imported(tmp_path / name, data, tmp_path / "out")
    with pytest.raises(BadInput, match="method.file .*--method.file FILE"):
        run(recipes()["import"], data, tmp_path / "out")
    assert not (tmp_path / "out" / "recipe.json").exists()


def test_a_file_that_has_changed_is_refused_and_one_that_is_gone_is_not_needed(data, tmp_path):
    path = like_3dgs(tmp_path / "a.ply", read(data))
    before = imported(path, data, tmp_path / "out")
    assert imported(path, data, tmp_path / "out") == before
    table = read_splats(path)
    table.opacity_logits[100] += 1
    write_splats(path, table)
    with pytest.raises(BadInput, match="a.ply has changed"):
        imported(path, data, tmp_path / "out")
    path.unlink()
    (tmp_path / "out" / "metrics.json").unlink()
    again = imported(path, data, tmp_path / "out")
    assert again["images"] == before["images"]
    assert imported(path, data, tmp_path / "out") == again
    like_3dgs(path, read(data), degree=1)
    with pytest.raises(BadInput, match="has changed since the run began"):
        imported(path, data, tmp_path / "out")


def test_every_byte_of_a_file_counts(data, tmp_path):
    path, scene = tmp_path / "large.bin", read(data)
    path.write_bytes(bytes(300_000))
    before = fingerprint(scene, files=[path])
    with path.open("rb+") as file:
        file.seek(100_000)
        file.write(b"1")
    os.utime(path, ns=(0, 0))
    assert changed_file(before, fingerprint(scene, before, files=[path])) == str(path)


def test_it_is_meshed_by_the_mesher_of_the_recipe(data, trained, tmp_path):
    recipe = evolve(recipes()["import"], "method.file", trained[0])
    run(recipe, data, tmp_path / "out")
    assert (tmp_path / "out" / "mesh.ply").exists()
    assert json.loads((tmp_path / "out" / "mesh.json").read_text())["cleaning"]["triangles"] > 100
