"""`surfkit maps`."""

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
from surfkit.mesh.base import Mesh
from surfkit.mesh.files import write_mesh
from surfkit.readers.data import Data
from surfkit.readers.read import read
from surfkit.testing.synthetic import Flight, photograph, write_colmap

rasterio = needs("rasterio")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run whose mesh is a slope, and one whose mesh is a level square 1 unit higher in its middle."""
    folder = tmp_path_factory.mktemp("maps")
    write_colmap(folder / "data", photograph(Flight(views=4, width=32, height=24, points=60)))
    words = ["recipe:2dgs", "mesh:none", "--steps", "2", "--pictures-every", "0", "--primitive.sh-degree", "0"]
    frame = read(Data(folder / "data")).frame
    for name, slope, height in (("run", 0.5, 2.0), ("other", 0.0, 1.0)):
        assert main(["train", *words, "--data", str(folder / "data"), "--out", str(folder / name)]) == 0
        corners = np.array([[x, y, height + slope * x] for x, y in ((-4, -4), (4, -4), (4, 4), (-4, 4))], float)
        mesh = Mesh(frame.to_local(corners), np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 99, np.uint8))
        write_mesh(folder / name / "mesh.ply", mesh, frame)
        (folder / name / "mesh.json").write_text("{}")
    return folder / "run"


def test_maps_of_a_run_and_their_difference(run, tmp_path, capsys):
    words = ["maps", str(run), "--gsd", "0.1", "--up", "z", "--products", "orthophoto", "hillshade"]
    assert main([*words, "--against", str(run.parent / "other"), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr()
    record = json.loads((tmp_path / "maps.json").read_text())
    assert record["size"] == [80, 80] and record["covered"] == 1 and "not georeferenced" in record["coordinates"]
    assert record["difference"]["fill"] - record["difference"]["cut"] == pytest.approx(64)
    assert "neither run is georeferenced" in said.err and "above (fill)" in said.out
    assert all(str(tmp_path / name) in said.out for name in record["files"])
    with rasterio.open(tmp_path / "dsm.tif") as file:
        heights = file.read(1)
        assert file.bounds == pytest.approx((-4, -4, 4, 4)) and np.allclose(heights, heights[0])
        assert heights[0, 0] == pytest.approx(2 - 0.5 * 3.95)


def test_cells_are_as_large_as_pixels_and_the_cameras_say_what_is_up(run, capsys):
    assert main(["maps", str(run), "--products", "hillshade"]) == 0
    record = json.loads((run / "maps" / "maps.json").read_text())
    assert record["up"] == "cameras" and record["axes"] == np.eye(3).tolist() and 0.01 < record["gsd"] < 2
    assert (run / "maps" / "hillshade.tif").exists()
    (run / "maps" / "notes.txt").write_text("of a user")
    assert main(["maps", str(run), "--products", "orthophoto", "--gsd", "1"]) == 0
    names = sorted(path.name for path in (run / "maps").iterdir())
    assert names == ["dsm.tif", "maps.json", "notes.txt", "orthophoto.tif"], "no map of before beside new ones"


@needs_native
def test_maps_go_on_after_the_process_was_killed(run, tmp_path):
    words = ["maps", str(run), "--gsd", "0.05", "--tile", "64", "--products", "orthophoto", "hillshade", "--out"]
    assert main([*words, str(tmp_path / "whole")]) == 0
    for what, done in (("drawing dsm", 3), ("shading", 2)):
        process = started([*words, str(tmp_path / "out")], tmp_path / "log", before=partial(kill_at, what, done))
        process.join(240)
        assert process.exitcode == -signal.SIGKILL, (tmp_path / "log").read_text()
        assert not (tmp_path / "out" / "maps.json").exists()
    assert main([*words, str(tmp_path / "out")]) == 0
    assert digests(tmp_path / "out") == digests(tmp_path / "whole")


@pytest.mark.parametrize(
    "words, line",
    [
        (["--gsd", "0"], "--gsd 0: it is a length"),
        (["--gsd", "1", "--bounds", "100", "100", "120", "120"], "none of its triangles covers"),
        (["--gsd", "1e-9"], "too many for one map"),
        (["--against", "nowhere.ply"], "nowhere.ply: no such file"),
        (["--metres-per-unit", "-1"], "--metres-per-unit"),
        (["--colors", "photographs"], "--colors photographs: --products leaves the orthophoto out"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_one_line(run, tmp_path, capsys, words, line):
    assert main(["maps", str(run), "--products", "hillshade", "--out", str(tmp_path / "out"), *words]) == 2
    said = capsys.readouterr().err.splitlines()
    assert line in said[-1] and said[-1].startswith("surfkit: ")
    assert not (tmp_path / "out").exists()


def test_no_run_and_no_mesh(tmp_path, run, capsys):
    assert main(["maps", str(tmp_path)]) == 2
    assert "no run folder" in capsys.readouterr().err
    assert main(["maps", str(run), "--against", str(run / "point_cloud.ply"), "--gsd", "1"]) == 2
    assert "a cloud of points; name a mesh" in capsys.readouterr().err


def test_without_the_package_of_textures_nothing_is_read(run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    monkeypatch.setattr("surfkit.cli.maps.read", lambda data: pytest.fail("the data set is read"))
    assert main(["maps", str(run), "--colors", "photographs"]) == 2
    assert "needs the package fast_simplification" in capsys.readouterr().err


def test_without_rasterio_one_line_says_what_to_install(run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    assert main(["maps", str(run)]) == 2
    said = capsys.readouterr().err
    assert "surfkit maps needs the package rasterio" in said and "surfkit[maps]" in said and said.count("\n") == 1
