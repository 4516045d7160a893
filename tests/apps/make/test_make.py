"""`surfkit make`: the whole way, interrupted after each step, with packages missing, refused."""

import json
import os
import shutil
import sys
from dataclasses import replace

import pytest
from needs import needs, needs_native

from surfkit.apps.doctor.estimate import MachineLimits, ResourceEstimate
from surfkit.apps.make import plan, way
from surfkit.apps.make.record import Delivery
from surfkit.apps.maps import command as maps
from surfkit.apps.texture import command as texture
from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.runs import pipeline
from surfkit.testing.synthetic import Flight, photograph, write_colmap

QUICK = ("--quality", "draft", "--steps", "4", "--device", "cpu")
STEPS = ("surface", "texture", "maps", "report", "quality")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Depth maps of no other test."""
    monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def farm(tmp_path):
    """A data set that stereo can work with."""
    write_colmap(
        tmp_path / "farm", photograph(Flight(kind="grid", views=8, width=64, height=48, points=300)), tracks=True
    )
    return tmp_path / "farm"


@pytest.fixture
def unmeasured(monkeypatch):
    """No probe: it takes seconds, in a process of its own."""
    monkeypatch.setattr(plan, "forecast", lambda *args: (estimated(), []))


def estimated(**changes):
    values = dict(points=1_000_000, points_known=False, seconds=60.0, step_seconds=(0.1,), memory_bytes=4 * 10**9)
    values |= dict(cache_bytes=10**9, point_bytes=2e3, run_bytes=10**8, data_bytes=0)
    values |= dict(room=MachineLimits(10**10, 10**11, 10**11))
    return ResourceEstimate(**(values | changes))


def make(source, *words):
    return main(["make", str(source), "--out", str(source.parent / "delivery"), *QUICK, *words])


def record(source):
    return json.loads((source.parent / "delivery/make.json").read_text())


def calls(monkeypatch):
    """Names of the steps that work, in a list that grows."""
    seen = []
    places = {"surface": (pipeline, "optimise"), "texture": (texture, "make_texture")}
    places |= {"maps": (maps, "make_maps"), "report": (way, "write_report"), "quality": (way, "write_quality")}
    for step, (module, name) in places.items():
        plain = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, plain=plain, step=step, **k: seen.append(step) or plain(*a, **k))
    return seen


@needs_native
def test_interrupted_after_each_step_it_goes_on_and_repeats_none(farm, unmeasured, monkeypatch, capsys):
    needs("fast_simplification"), needs("rasterio"), needs("pyogrio"), needs("laspy")
    seen, plain = calls(monkeypatch), Delivery.run
    for at, last in enumerate(STEPS):

        def stopped(self, name, *rest, last=last):
            plain(self, name, *rest)
            if name == last:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(Delivery, "run", stopped)
            assert make(farm) == 130
        assert "the same command goes on" in capsys.readouterr().err
        assert seen == list(STEPS[: at + 1])
        assert [name for name, step in record(farm)["steps"].items() if step["complete"]] == seen
    assert make(farm) == 0
    said = capsys.readouterr()
    assert seen == list(STEPS) and "maps: finished" in said.err and "delivered" in said.out
    told, out = record(farm), farm.parent / "delivery"
    assert told["decisions"]["photographs"] == 8 and told["decisions"]["recipe"] == "surface-short"
    opened = {"textured mesh (GLB)", "mesh", "surface model", "contour lines", "point cloud", "splats"}
    opened |= {"quality report", "report"}
    assert opened <= set(told["files"]) and all((out / path).exists() for path in told["files"].values())
    assert told["left_out"] == {} and json.loads((out / "run/metrics.json").read_text())["steps"] == 4
    notes = told["steps"]["texture"]["notes"]
    assert [note for note in notes if "no place on Earth" in note], "of the tiles; told when the step was interrupted"
    page = (out / "quality_report.html").read_text()
    assert f"texture: {notes[0][:30]}" in page

    (out / "texture/textured.glb").unlink()
    assert make(farm) == 0 and seen == [*STEPS, "texture"], "only what is gone"
    assert make(farm, "--steps", "3") == 2 and "cannot be made shorter" in capsys.readouterr().err
    assert make(farm, "--quality", "high") == 2 and "--quality draft" in capsys.readouterr().err
    assert make(farm, "--longest", "30") == 2 and "--longest 800" in capsys.readouterr().err
    assert make(farm, "--steps", "6") == 0 and record(farm)["decisions"]["steps"] == 6
    assert seen == [*STEPS, "texture", *STEPS], "a longer run has another mesh"

    photo = farm / "images/view_003.png"
    photo.write_bytes(photo.read_bytes() + b"0")
    os.utime(photo, (1, 1))
    before = (out / "texture/textured.glb").read_bytes()
    assert make(farm, "--steps", "6") == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "step surface: " in line and "view_003.png" in line and f"`surfkit make {farm} --out {out}" in line
    assert (out / "texture/textured.glb").read_bytes() == before


@needs_native
def test_what_is_not_installed_is_told_first_and_added_later(farm, monkeypatch, capsys):
    """With the forecast of the doctor."""
    needs("fast_simplification"), needs("rasterio")
    with monkeypatch.context() as patch:
        for name in ("fast_simplification", "laspy"):
            patch.setitem(sys.modules, name, None)
        assert make(farm) == 0
    said = capsys.readouterr()
    lines = said.err.splitlines()
    begun = next(at for at, line in enumerate(lines) if line.startswith("looking at the data set"))
    told = [line for line in lines[:begun] if line.startswith("left out: ")]
    assert len(told) == 2 and "texture: " in told[0] and "'surfkit[texture]'" in told[0]
    assert "points: " in told[1] and "'surfkit[maps]'" in told[1]
    assert "for the steps of optimisation" in said.out and said.out.count("left out: ") == 2
    assert set(record(farm)["left_out"]) == {"texture", "points"}
    assert record(farm)["decisions"]["forecast"]["memory_bytes"] > 1e6, "steps were measured"
    out = farm.parent / "delivery"
    assert (out / "maps/dsm.tif").exists() and not (out / "maps/points.copc.laz").exists()
    seen = calls(monkeypatch)
    assert make(farm) == 0 and seen == ["texture", "maps", "quality"] and record(farm)["left_out"] == {}


@needs_native
def test_without_depth_maps_the_precision_is_left_out(farm, unmeasured, monkeypatch, capsys):
    needs("fast_simplification"), needs("rasterio"), needs("cv2")
    plain = way.opened
    monkeypatch.setattr(way, "opened", lambda out: replace(plain(out), data=replace(plain(out).data, priors=None)))
    monkeypatch.setattr(way, "prior_files", lambda data, scene: {})
    assert make(farm) == 0
    assert "left out: precision: no depth maps" in capsys.readouterr().err
    assert set(record(farm)["left_out"]) == {"precision"}
    drawn = farm.parent / "delivery/maps"
    assert (drawn / "dsm.tif").exists() and not (drawn / "precision.tif").exists()


@needs_native
def test_a_delivery_that_has_moved_with_its_data_goes_on(farm, unmeasured, monkeypatch, capsys):
    needs("fast_simplification"), needs("rasterio")
    assert make(farm) == 0
    there = farm.parent / "there"
    there.mkdir()
    for each in (farm, farm.parent / "delivery"):
        shutil.move(each, there / each.name)
    seen = calls(monkeypatch)
    assert make(there / "farm") == 0 and seen == []
    assert record(there / "farm")["input"] == str(there / "farm")
    shutil.copytree(there / "farm", there / "farm2")
    assert make(there / "farm2") == 2 and "was made of" in capsys.readouterr().err


@needs_native
def test_a_step_that_fails_leaves_the_others_and_says_how_to_go_on(farm, unmeasured, monkeypatch, capsys):
    needs("fast_simplification"), needs("rasterio")

    def fails(*args):
        raise BadInput("the disk of the maps is odd")

    with monkeypatch.context() as patch:
        patch.setattr(maps, "make_maps", fails)
        assert make(farm) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("surfkit: step maps: the disk of the maps is odd; ")
    assert f"`surfkit make {farm} --out {farm.parent / 'delivery'}" in line and line.endswith("goes on")
    steps = record(farm)["steps"]
    assert steps["texture"]["complete"] and not steps["maps"]["complete"] and "report" not in steps
    seen = calls(monkeypatch)
    assert make(farm) == 0 and seen == ["maps", "report", "quality"]


def test_bad_input_is_one_line_and_leaves_nothing(farm, unmeasured, capsys):
    out = farm.parent / "delivery"
    assert make(farm.parent / "nothing") == 2 and "not there; name a data set" in capsys.readouterr().err
    assert make(farm, "--steps", "0") == 2 and "give 1 or more" in capsys.readouterr().err
    (farm / "images/view_002.png").unlink()
    assert make(farm) == 2
    assert "view_002.png" in capsys.readouterr().err.splitlines()[-1] and not out.exists()
    out.write_text("")
    assert make(farm) == 2 and "is a file; name a folder" in capsys.readouterr().err
    out.unlink()
    out.mkdir()
    (out / "thesis.tex").touch()
    assert make(farm) == 2 and "thesis.tex and no make.json" in capsys.readouterr().err
    (out / "make.json").write_text("{")
    assert make(farm) == 2 and "make.json: not JSON" in capsys.readouterr().err
    assert sorted(path.name for path in out.iterdir()) == ["make.json", "thesis.tex"]
