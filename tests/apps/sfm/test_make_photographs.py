"""`surfkit make` on a folder of photographs, to the plan; `tests/apps/make` has the rest of the way."""

import json

import pytest
from needs import needs_native

from surfkit.apps.make import plan, way
from surfkit.apps.sfm import mapping
from surfkit.cli import main

from .pictures import arc, picture, save


@pytest.fixture
def photos(tmp_path):
    """Five photographs that overlap."""
    for at, pose in enumerate(arc(5)):
        save(tmp_path / "flight" / f"{at}.jpg", picture(pose))
    return tmp_path / "flight"


def make(photos, *words):
    return main(["make", str(photos), "--out", str(photos.parent / "delivery"), "--quality", "draft", *words])


@needs_native
def test_of_photographs_the_cameras_are_found_first(photos, monkeypatch, capsys):
    monkeypatch.setattr(plan, "forecast", lambda *args: (None, []))  # it takes seconds, in a process of its own
    seen, plain = [], mapping._incremental
    monkeypatch.setattr(mapping, "_incremental", lambda *given: seen.append(1) or plain(*given))

    def stop(*args, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(way, "run", stop)
    for _ in range(2):
        assert make(photos) == 130
    told = json.loads((photos.parent / "delivery/make.json").read_text())
    assert seen == [1], "cameras are found once"
    assert told["steps"]["cameras"]["complete"] and not told["steps"]["surface"]["complete"]
    assert told["decisions"]["photographs"] == 5 and "could not be forecast" in told["decisions"]["why"]
    assert (photos.parent / "delivery/scene/sparse/0").is_dir()
    said = capsys.readouterr()
    assert "step 1 of 6: cameras" in said.err and "not known: nothing could be measured" in said.out
    assert make(photos, "--images", "pictures") == 2 and "leave it out" in capsys.readouterr().err
    words = ["make", str(photos), "--out", str(photos / "delivery")]
    assert main(words) == 2 and "name one outside" in capsys.readouterr().err and not (photos / "delivery").exists()
