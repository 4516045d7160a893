"""`surfkit train --prepare` on a folder of photographs: first their cameras, then the training, resumed in either."""

import builtins
import json
import sys

import pytest
from needs import needs_native

from surfkit.apps.sfm import feature_cache as features
from surfkit.apps.sfm import mapping
from surfkit.cli import main

from .pictures import arc, picture, save

QUICK = ("recipe:2dgs", "mesh:none", "--steps", "2", "--device", "cpu", "--longest", "60", "--pictures-every", "0")


@pytest.fixture
def photos(tmp_path):
    """Five photographs that overlap."""
    for at, pose in enumerate(arc(5)):
        save(tmp_path / "flight" / "day 1" / f"{at}.jpg", picture(pose))
    return tmp_path / "flight"


def train(photos, *words):
    return main(["train", *QUICK, "--data", str(photos), "--out", str(photos.parent / "run"), *words])


def calls(monkeypatch):
    """Names of the stages that work."""
    seen = []
    for module, name in ((features, "_keep"), (mapping, "_incremental")):
        plain = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given, plain=plain, name=name: seen.append(name) or plain(*given))
    return seen


@needs_native
def test_cameras_are_found_first_and_the_same_command_goes_on(photos, monkeypatch, capsys):
    assert train(photos) == 2
    said = capsys.readouterr().err
    assert f"`surfkit prepare photos {photos}`" in said and "`surfkit train --prepare`" in said
    assert said.count("\n") == 1 and not (photos.parent / "run").exists()
    with monkeypatch.context() as patch:
        patch.setattr(mapping, "_incremental", lambda *given: (_ for _ in ()).throw(KeyboardInterrupt))
        assert train(photos, "--prepare") == 130
    assert not (photos.parent / "run").exists()
    seen = calls(monkeypatch)
    assert train(photos, "--prepare") == 0
    scene = photos.parent / "flight-scene"
    assert seen == ["_incremental"], "features are those from before"
    assert "5 of 5 have a camera" in capsys.readouterr().out
    run = json.loads((photos.parent / "run/run.json").read_text())
    assert (
        run["data"]["path"] == str(scene) and json.loads((photos.parent / "run/metrics.json").read_text())["steps"] == 2
    )
    before = (photos.parent / "run/metrics.json").read_bytes()
    assert train(photos, "--prepare") == 0 and seen == ["_incremental"], "neither stage is done again"
    assert train(scene, "--prepare") == 0, "of a data set with cameras, nothing is to be prepared"
    assert (photos.parent / "run/metrics.json").read_bytes() == before


@needs_native
def test_a_scene_prepared_otherwise_stays_as_it_is(photos, monkeypatch):
    assert main(["prepare", "photos", str(photos), "--max-features", "1500", "--lens", "RADIAL", "--no-gps"]) == 0
    seen = calls(monkeypatch)
    assert train(photos, "--prepare") == 0 and seen == []
    report = json.loads((photos.parent / "flight-scene/report.json").read_text())
    assert (report["settings"]["max_features"], report["settings"]["lens"]) == (1500, "RADIAL")


@needs_native
def test_depth_maps_of_the_scene_are_taken_and_not_made_again(photos, monkeypatch, tmp_path):
    """They are also brought up to date, as the rest of the scene."""
    monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path / "cache"))
    words = ("depth:plane-sweep", "--depth.longest", "48", "--device", "cpu")
    assert main(["prepare", "photos", str(photos), "--max-features", "1500", *words]) == 0
    folder = photos.parent / "flight-scene/estimated_depths"
    before = {path.name: path.stat().st_mtime_ns for path in folder.rglob("*.npy")}
    assert len(before) == 2 * 5, "a surface is made of all photographs"
    run = ["train", "recipe:surface", *QUICK[1:], "--data", str(photos), "--prepare", "--out"]
    assert main([*run, str(tmp_path / "run")]) == 0
    assert {path.name: path.stat().st_mtime_ns for path in folder.rglob("*.npy")} == before
    assert not list((tmp_path / "cache").rglob("*.npy")), "the recipe uses depth maps, and takes those"
    save(photos / "day 1" / "5.jpg", picture(arc(6)[5]))
    assert main([*run, str(tmp_path / "second")]) == 0
    assert len(list(folder.rglob("*.npy"))) == 2 * 6


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("--prepare", "--no-prepare"),
            "--prepare makes what is missing, and --no-prepare makes no depth maps; give one",
        ),
        (
            ("--prepare", "--images", "day 1"),
            "--images day 1 with --prepare: name the folder of photographs with --data",
        ),
    ],
)
def test_what_is_refused(photos, capsys, words, said):
    assert train(photos, *words) == 2
    assert said in capsys.readouterr().err and not (photos.parent / "flight-scene").exists()


def test_a_damaged_report_is_named(photos, capsys):
    (photos.parent / "flight-scene/prepare").mkdir(parents=True)
    (photos.parent / "flight-scene/report.json").write_text("{}")
    assert train(photos, "--prepare") == 2
    assert "report.json: damaged" in capsys.readouterr().err


def test_without_pycolmap_one_line_says_so(photos, monkeypatch, capsys):
    real = builtins.__import__

    def without(name, *given, **named):
        if name == "pycolmap":
            raise ImportError("No module named 'pycolmap'")
        return real(name, *given, **named)

    monkeypatch.delitem(sys.modules, "pycolmap", raising=False)
    monkeypatch.setattr(builtins, "__import__", without)
    assert train(photos, "--prepare") == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "pycolmap cannot be loaded: No module named 'pycolmap'; is it installed" in said[0]
