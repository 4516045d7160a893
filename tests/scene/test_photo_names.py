"""Photographs that a data set calls otherwise than their files."""

from pathlib import PurePath, PurePosixPath

import numpy as np
import pytest

from surfkit.core.codec import write_json
from surfkit.io.datasets.depth_files import map_path, write_map
from surfkit.io.datasets.depth_layout import DepthQuery
from surfkit.io.datasets.depth_layouts import HierarchicalDepths
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.photo_names import find_files, safe_path


def test_names_without_endings_are_found_in_time_that_grows_with_their_number(tmp_path, monkeypatch):
    count, compared = 300, []
    names = [f"IMG {at}" for at in range(count)]
    for name in names:
        (tmp_path / f"{name}.JPG").touch()
    plain = PurePath.__eq__
    monkeypatch.setattr(PurePath, "__eq__", lambda self, other: compared.append(0) or plain(self, other))
    with collect_notes() as kept:
        found = find_files(tmp_path, names)
    monkeypatch.undo()
    assert not kept.texts, "a name without its ending is not spelt otherwise"
    assert found == {name: tmp_path / f"{name}.JPG" for name in names}
    assert len(compared) < 20 * count


def test_other_spellings_are_told_once(tmp_path):
    for name in ("a.JPG", "b.jpg", "sub/c.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with collect_notes() as kept:
        found = find_files(tmp_path, ["A.jpg", "b.jpg", "c"])
    assert found == {"A.jpg": tmp_path / "a.JPG", "b.jpg": tmp_path / "b.jpg", "c": tmp_path / "sub/c.png"}
    assert len(kept.texts) == 1 and "2 photographs in" in kept.texts[0] and "spelt otherwise" in kept.texts[0]


@pytest.mark.parametrize(
    "name", ["../../beside/a.png", "/tmp/a.png", "C:\\a.png", "c:a.png", "..\\a.png", "b/./a.png", "", ".."]
)
def test_names_that_lead_elsewhere_are_paths_inside(tmp_path, name):
    path = safe_path(name)
    assert not path.is_absolute() and ".." not in path.parts and path.parts[0] == "_outside"
    assert map_path(tmp_path, name).resolve().is_relative_to(tmp_path.resolve() / "estimated_depths")


def test_no_two_names_share_a_path():
    names = ["a.png", "./a.png", "../a.png", "../../a.png", "/a.png", "b//a.png", "b/a.png", "b/../a.png"]
    assert len({safe_path(name) for name in names}) == len(names)


def test_usual_names_are_their_own_paths():
    assert safe_path("left/a b..c.jpg") == PurePosixPath("left/a b..c.jpg") == safe_path("left\\a b..c.jpg")


def test_a_depth_map_leaves_what_lies_beside_the_data_set(tmp_path):
    outside = tmp_path / "beside" / "a.png.npy"
    outside.parent.mkdir()
    outside.write_text("mine")
    write_map(tmp_path / "data", "../../beside/a.png", np.ones((2, 3)), np.ones((2, 3)))
    assert outside.read_text() == "mine" and list(outside.parent.iterdir()) == [outside]


def test_no_photograph_is_read_as_its_own_depth_map(tmp_path):
    (tmp_path / "depths").mkdir()
    write_json(tmp_path / "depth_params.json", {"../images/a": {"scale": 1.0, "offset": 0.0}})
    query = DepthQuery(tmp_path, ["../images/a.png"], tmp_path)
    found = HierarchicalDepths().find(query)
    assert all(file.path.resolve().is_relative_to(tmp_path / "depths") for file in (found or {}).values())
