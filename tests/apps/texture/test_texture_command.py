"""`surfkit texture`."""

import json
import signal
import sys
from functools import partial

import numpy as np
import pytest
from forks import started
from interrupted import digests, kill_at
from needs import needs, needs_native

from surfkit.cli import main
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.mesh.base import Mesh
from surfkit.mesh.mesh_export import write_mesh
from surfkit.testing.synthetic import Flight, photograph, write_colmap

needs("fast_simplification")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose mesh is a level square on the ground."""
    folder = tmp_path_factory.mktemp("texture")
    write_colmap(folder / "data", photograph(Flight(views=4, width=32, height=24, points=60)))
    words = ["recipe:2dgs", "mesh:none", "--steps", "2", "--pictures-every", "0", "--primitive.sh-degree", "0"]
    frame = read(Data(folder / "data")).frame
    assert main(["train", *words, "--data", str(folder / "data"), "--out", str(folder / "run")]) == 0
    corners = np.array([[-2, -6, 0], [2, -6, 0], [2, -3, 0], [-2, -3, 0]], float)
    mesh = Mesh(frame.to_local(corners), np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 99, np.uint8))
    write_mesh(folder / "run" / "mesh.ply", mesh, frame)
    (folder / "run" / "mesh.json").write_text("{}")
    return folder / "run"


def test_a_run_gets_a_textured_mesh(run, capsys):
    assert main(["texture", str(run)]) == 0
    said = capsys.readouterr()
    record = json.loads((run / "texture" / "texture.json").read_text())
    assert record["photographs"] >= 1 and record["seen"] > 0.5
    for name in record["files"]:
        assert (run / "texture" / name).stat().st_size > 0 and name in said.out
    assert "no coordinate reference system" in said.err
    assert main(["texture", str(run), "--formats", "glb", "--pictures", "png"]) == 0
    names = sorted(path.name for path in (run / "texture").iterdir())
    assert names == ["texture.json", "textured.glb"], "no file of before beside new ones"


def test_a_file_is_no_folder(run, tmp_path, capsys):
    assert main(["texture", str(run), "--out", str(tmp_path / "mine.GLB")]) == 2
    assert capsys.readouterr().err.endswith("mine.GLB: give a folder, and --formats glb\n") and not any(
        tmp_path.iterdir()
    )


@needs_native
def test_a_texture_goes_on_after_the_process_was_killed(run, tmp_path):
    words = ["texture", str(run), "--size", "128", "--out"]
    assert main([*words, str(tmp_path / "whole")]) == 0
    for what in ("looking at photographs", "painting pages"):
        process = started([*words, str(tmp_path / "out")], tmp_path / "log", before=partial(kill_at, what, 1))
        process.join(240)
        assert process.exitcode == -signal.SIGKILL, (tmp_path / "log").read_text()
        assert not (tmp_path / "out").exists() and (tmp_path / "out.unfinished").is_dir()
    assert main([*words, str(tmp_path / "out")]) == 0
    assert not (tmp_path / "out.unfinished").exists()
    found, expected = (digests(tmp_path / name) for name in ("out", "whole"))
    assert found.pop("texture.json") and expected.pop("texture.json") and found == expected


@pytest.mark.parametrize(
    "words, line",
    [
        (["--size", "1000"], "--size 1000: give a power of two"),
        (["--texel", "0"], "--texel 0: it is a length"),
        (["--triangles", "2"], "--triangles 2: give 4 to"),
        (["--memory", "much"], "--memory much: give a size"),
        (["--metres-per-unit", "-1"], "--metres-per-unit"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(run, tmp_path, capsys, words, line):
    assert main(["texture", str(run), "--out", str(tmp_path / "out"), *words]) == 2
    said = capsys.readouterr().err.splitlines()
    assert line in said[-1] and said[-1].startswith("surfkit: ")
    assert not (tmp_path / "out").exists()


def test_other_folders_are_left_alone(run, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("of a user")
    assert main(["texture", str(run), "--out", str(tmp_path)]) == 2
    assert "name another" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    assert main(["texture", str(tmp_path)]) == 2
    assert "no run folder" in capsys.readouterr().err


def test_without_the_package_one_line_says_what_to_install(run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    monkeypatch.setattr("surfkit.apps.texture.command.read_unchanged", lambda run: pytest.fail("the data set is read"))
    assert main(["texture", str(run)]) == 2
    said = capsys.readouterr().err
    assert "needs the package fast_simplification" in said and "surfkit[texture]" in said and said.count("\n") == 1
