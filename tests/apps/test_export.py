"""`surfkit export` from one format to another; runs are exported in tests/test_pipeline.py."""

import json
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch
from models import like_3dgs, with_column

from surfkit.apps.export import ExportCommand, one_tile
from surfkit.cli import main
from surfkit.io.splats.ply import PLY, read_splats
from surfkit.io.splats.splat_files import format_of, read_splat_file
from surfkit.io.splats.spz import SPZ
from surfkit.scene.scene import Frame
from surfkit.testing.format_checks import splat_table
from surfkit.testing.inputs import start_input


@pytest.fixture
def ply(tmp_path):
    PLY().write(tmp_path / "scene.ply", splat_table("surfel", 40, 2))
    return tmp_path / "scene.ply"


def said(capsys, *words):
    status = main(["export", *map(str, words)])
    captured = capsys.readouterr()
    return status, captured.out.splitlines(), captured.err.splitlines()


@pytest.mark.parametrize("suffix", [".compressed.ply", ".sog", ".splat", ".spz"])
def test_the_suffix_chooses_the_format(ply, tmp_path, capsys, suffix):
    out = tmp_path / "new" / f"scene{suffix}"
    status, lines, _ = said(capsys, ply, "--out", out)
    name = suffix[1:].replace(".", "-")
    assert status == 0 and lines[0].startswith(f"wrote 40 splats to {out} ({name}, 0.0") and len(lines) == 1
    assert "rounded to" in lines[0] and ("degrees 1 to 2 are left out" in lines[0]) == (name == "splat")
    found = read_splat_file(out)
    assert found.kind == "surfel" and found.sh_degree == (0 if name == "splat" else 2)
    status, lines, _ = said(capsys, out, "--format", "ply", "--out", tmp_path / "back.ply")
    assert status == 0 and len(read_splats(tmp_path / "back.ply")) == 40


def test_a_format_lands_beside_the_file(ply, capsys):
    assert said(capsys, ply, "format:spz", "--format.version", "4")[0] == 0
    assert ply.with_suffix(".spz").read_bytes()[:8] == b"NGSP\4\0\0\0"
    assert said(capsys, ply, "--format", "compressed-ply")[0] == 0
    assert said(capsys, ply.with_suffix(".compressed.ply"), "--format", "sog")[0] == 0
    assert type(format_of(ply.with_name("scene.sog"))).__name__ == "SOG"


def test_axes_that_are_given(ply, tmp_path, capsys):
    SPZ(axes="same").write(tmp_path / "a.spz", read_splat_file(ply))
    status, _, errors = said(capsys, tmp_path / "a.spz", "--out", tmp_path / "turned.ply")
    assert status == 0 and len(errors) == 1 and "rub (right-up-back) is assumed; --axes rdf" in errors[0]
    status, _, errors = said(capsys, tmp_path / "a.spz", "--axes", "rdf", "--out", tmp_path / "same.ply")
    assert (status, errors) == (0, [])
    same, turned = read_splats(tmp_path / "same.ply").means, read_splats(tmp_path / "turned.ply").means
    assert torch.equal(same, turned * torch.tensor([1, -1, -1]))
    assert torch.cdist(read_splats(ply).means, same).min(1).values.max() < 2e-3


def test_a_page_of_a_file(ply, tmp_path, capsys):
    out = tmp_path / "page.html"
    status, lines, errors = said(capsys, ply, "--out", out, "--format.max-splats", "30")
    assert status == 0 and lines[0].startswith(f"wrote 30 splats to {out} (page, 0.0") and len(lines) == 1
    assert len(errors) == 1 and "the 30 of 40 splats are kept of which most is seen" in errors[0]


def test_two_scales_are_for_ply_alone(ply, tmp_path, capsys):
    assert said(capsys, ply, "--strict-2dgs", "--out", tmp_path / "two.ply")[0] == 0
    assert b"scale_2" not in (tmp_path / "two.ply").read_bytes()
    status, _, errors = said(capsys, ply, "--strict-2dgs", "--out", tmp_path / "two.spz")
    assert (status, errors) == (2, ["surfkit: --strict-2dgs: files of the format spz have three scales; leave it out"])


def test_survey_coordinates_keep_their_digits(tmp_path, capsys):
    """From a file of its offset to one that has a place for it, and to one that has none."""
    near = splat_table("gaussian", 30, 0)
    frame = Frame(np.zeros(3), 1.0, shift=(500_000.0, 5_600_000.0, 0.0))
    moved = near.means.double() + torch.tensor(frame.shift, dtype=torch.float64)
    PLY().write(tmp_path / "a.ply", replace(near, means=moved), frame)
    status, lines, _ = said(capsys, tmp_path / "a.ply", "--out", tmp_path / "b.compressed.ply")
    assert status == 0 and lines[1].startswith("coordinates leave out the offset 5")
    found = read_splat_file(tmp_path / "b.compressed.ply").means
    assert float((found.sort(0).values - moved.sort(0).values).abs().max()) < 0.01
    assert said(capsys, tmp_path / "b.compressed.ply", "--out", tmp_path / "c.spz")[0] == 0
    assert float(SPZ().read(tmp_path / "c.spz").means.abs().max()) < 10


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("{here}/scene.ply", "this is the file that is read; name another"),
        ("{here}/scene.ply --out {here}/page.htm", "no format of splats has this suffix; did you mean .html? known:"),
        ("{here}/scene.ply --out {here}/scene.xyz", "no format of splats has this suffix; known: compressed-ply"),
        ("{here}/scene.ply --format sog --out {here}/a.spz", "files of the format sog end in .sog; name it so"),
        ("{here}/scene.ply --format sogs", "no format named 'sogs'; did you mean 'sog'?"),
        (
            "{here}/scene.ply --format spz --format.version 5",
            "--format.version: expected one of '2', '3', '4'",
        ),
        ("{here}/scene.ply --format spz --format.sh1-bits 9", "sh1_bits is 9"),
        ("{here}/nowhere.ply --format spz", "cannot be read: No such file or directory"),
        ("{here}/text.txt --format spz", "no file of splats of a known format; known: compressed-ply"),
        ("{here} --format spz", "no run folder"),
        ("{here}/scene.ply --out {here}/folder.spz", "a folder; name a file"),
        ("{here}/scene.ply --format spz --geoid 40", "--geoid: files of the format spz keep heights as they are"),
        ("{here}/scene.ply --format tiles3d --geoid 40", "--geoid 40: the data set has no coordinate reference system"),
        ("{here} --axes rub --out {here}/a.spz", "is a run, whose axes are known; leave it out"),
        ("{here}/scene.ply --axes rux --out {here}/a.spz", "--axes"),
        ("{here}/scene.ply --out {here}/a.html --format.max-splats 0", "max_splats is 0"),
    ],
)
def test_mistakes_are_one_line(ply, tmp_path, capsys, words, message):
    (tmp_path / "text.txt").write_text("no splats")
    (tmp_path / "folder.spz").mkdir()
    before = sorted(tmp_path.rglob("*"))
    status, lines, errors = said(capsys, *words.format(here=tmp_path).split())
    assert status == 2 and not lines and len(errors) == 1 and message in errors[0], errors
    assert sorted(tmp_path.rglob("*")) == before


def test_tiles_on_earth_leave_out_nothing(ply, tmp_path, capsys, monkeypatch):
    """Their transform places them, so no line tells to add an offset."""
    table = splat_table("gaussian", 30, 0)
    frame = Frame(np.array([512_000.0, 5_800_000.0, 0.0]), 1.0, 1.0, "EPSG:32633", (512_000.0, 5_800_000.0, 0.0))
    near = replace(table, means=table.means.double() + torch.tensor(frame.origin))

    @contextmanager
    def opened(self):
        yield near, frame, one_tile(near), None

    monkeypatch.setattr(ExportCommand, "_opened", opened)
    status, lines, _ = said(capsys, ply, "format:tiles3d", "--out", tmp_path / "tiles")
    assert status == 0 and not any("offset" in line for line in lines)
    assert said(capsys, ply, "format:tiles3d", "--out", tmp_path / "high", "--geoid", "40")[0] == 0
    low, high = (json.loads((tmp_path / name / "tileset.json").read_text()) for name in ("tiles", "high"))
    move = np.subtract(high["root"]["transform"], low["root"]["transform"])[12:15]
    assert np.linalg.norm(move) == pytest.approx(40, abs=1e-3)
    status, lines, _ = said(capsys, ply, "format:tiles3d", "--format.no-georeference", "--out", tmp_path / "other")
    assert status == 0 and lines[1].startswith("coordinates leave out the offset 512000 5800000")


def test_a_filter_without_a_word_on_the_drawing_is_told(tmp_path, capsys):
    path = like_3dgs(tmp_path / "a.ply", start_input().scene)
    with_column(path, "filter_3D", np.full(len(read_splats(path)), 0.01))
    for at, axes in enumerate(("auto", "rdf")):
        status, _, told = said(capsys, path, "--axes", axes, "--out", tmp_path / f"{at}.spz")
        assert status == 0 and sum("taken as those of 3DGS" in line for line in told) == 1
