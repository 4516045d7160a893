"""Splats whose file does not name its axes stand where the photographs, or else the sparse points, see them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from models import ORIGIN, data_set, like_3dgs

from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.io.splats.file_axes import turn_between
from surfkit.io.splats.rotate_splats import turned
from surfkit.io.splats.splat_files import read_splat_file
from surfkit.io.splats.spz import SPZ
from surfkit.runs.run_notes import collect_notes
from surfkit.start.base import StartInput
from surfkit.start.guess_axes import read_in_scene
from surfkit.start.splat_start import SplatStart


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return read(Data(data_set(tmp_path_factory.mktemp("data"))))


def stored(path, scene, axes, **changes):
    """An SPZ file without a record of axes, along these, of splats at the sparse points."""
    splats = read_splat_file(like_3dgs(path.with_suffix(".ply"), scene, log_scales=torch.full((250, 3), -2.8)))
    splats = replace(splats, **({"opacity_logits": torch.full((250,), 4.0)} | changes))
    SPZ(axes="same").write(path, turned(splats, turn_between(axes).T), scene.frame)
    return path


def apart(table, scene):
    return float(torch.cdist(scene.cloud.xyz.double(), table.means.double()).min(1).values.max())


@pytest.mark.parametrize("axes", ["rdf", "rub", "luf", "ldb", "rfu"])
def test_the_photographs_decide(tmp_path, scene, axes):
    with collect_notes() as notes:
        table = read_in_scene(stored(tmp_path / "a.spz", scene, axes), scene, "auto")
    assert table.axes.name == axes and apart(table, scene) < 2e-3
    (note,) = notes.texts
    assert f": {axes} (" in note and "fits the photographs best, PSNR " in note and "--axes NAME says otherwise" in note


def test_without_colours_the_sparse_points_decide(tmp_path, scene):
    dim = {"opacity_logits": torch.full((250,), -5.0)}  # nothing to be seen in any axes
    with collect_notes() as notes:
        table = read_in_scene(stored(tmp_path / "a.spz", scene, "luf", **dim), scene, "auto")
    assert table.axes.name == "luf" and apart(table, scene) < 2e-3
    assert "luf (left-up-forward) fits" in notes.texts[0]


def test_where_nothing_tells_the_axes_of_the_format_are_assumed(tmp_path, scene):
    dim = {"opacity_logits": torch.full((250,), -5.0)}
    bare = replace(scene, cloud=replace(scene.cloud, xyz=scene.cloud.xyz[:0], rgb=scene.cloud.rgb[:0]))
    with collect_notes() as notes:
        table = read_in_scene(stored(tmp_path / "a.spz", scene, "rdf", **dim), bare, "auto")
    assert table.axes.name == "rub"
    assert "rub (right-up-back) is assumed" in notes.texts[0]


def test_axes_that_are_given_or_named_are_taken_without_a_word(tmp_path, scene):
    path = stored(tmp_path / "a.spz", scene, "luf")
    splats = read_splat_file(path.with_suffix(".ply"))
    SPZ(version=4, axes="same").write(tmp_path / "b.spz", splats, scene.frame)
    with collect_notes() as notes:
        assert apart(read_in_scene(path, scene, "luf"), scene) < 2e-3
        assert apart(read_in_scene(path, scene, "rub"), scene) > 0.1
        assert apart(read_in_scene(tmp_path / "b.spz", scene, "auto"), scene) < 2e-3
        assert apart(read_in_scene(path.with_suffix(".ply"), scene, "auto"), scene) < 1e-5
    assert notes.texts == []


def test_survey_coordinates_are_turned_before_their_offset_is_added(tmp_path):
    scene = read(Data(data_set(tmp_path / "data", far=True)))
    assert np.linalg.norm(np.subtract(scene.frame.shift, ORIGIN)[:2]) < 100
    path = tmp_path / "a.spz"
    splats = read_splat_file(like_3dgs(tmp_path / "a.ply", scene, log_scales=torch.full((250, 3), -2.8)))
    means = torch.from_numpy(scene.frame.to_file(scene.cloud.xyz.numpy()))
    splats = replace(splats, means=means, opacity_logits=torch.full((250,), 4.0))
    SPZ(axes="same").write(path, turned(splats, turn_between("luf").T))
    with collect_notes():
        table = read_in_scene(path, scene, "auto")
    assert table.axes.name == "luf" and apart(table, scene) < 2e-3


def test_the_note_of_a_start_names_its_own_flag(tmp_path, scene):
    path = stored(tmp_path / "a.spz", scene, "luf")
    with collect_notes() as notes:
        cloud = SplatStart(path).cloud(StartInput(scene, (), None, None, torch.Generator()))
    assert "luf" in notes.texts[0] and "; --start.axes NAME says otherwise" in notes.texts[0]
    assert float(torch.cdist(scene.cloud.xyz, cloud.xyz).min(1).values.max()) < 2e-3
    with collect_notes() as notes:
        SplatStart(path, "luf").cloud(StartInput(scene, (), None, None, torch.Generator()))
    assert notes.texts == []
