"""Folders of smaller photographs: used when they are asked for and whole, and never reduced twice."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.photos import read_photo, view_photo
from surfkit.testing.synthetic import Flight, photograph, write_colmap


@pytest.fixture
def farm(tmp_path):
    write_colmap(tmp_path / "farm", photograph(Flight(views=4, width=82, height=62, points=60)))
    return tmp_path / "farm"


def shrink(farm, by, end=".png"):
    """Copies that differ from what would be made of images/, by their brightness."""
    folder = farm / f"images_{by:g}"
    folder.mkdir()
    for path in (farm / "images").iterdir():
        size = (int(82 / by), int(62 / by))
        values = np.asarray(Image.open(path).resize(size, Image.Resampling.BOX)) // 2
        Image.fromarray(values).save(folder / f"{path.stem}{end}")
    return folder


def noticed(data):
    with collect_notes() as notes:
        scene = read(data)
    return scene, [text for text in notes.texts if "spelt" not in text]


@pytest.mark.parametrize(("by", "end"), [(4, ".png"), (2, ".jpg"), (3.4175, ".png")])
def test_the_folder_of_the_factor_is_used(farm, by, end):
    folder = shrink(farm, by, end)
    scene, notes = noticed(Data(farm, scale=by))
    assert notes == [f"the photographs in {folder} are used, already reduced by {by:g}"]
    size, view = (int(82 / by), int(62 / by)), scene.train[0]
    assert (view.camera.width, view.camera.height) == size and view.path == folder / f"view_001{end}"
    assert np.array_equal(view_photo(view), read_photo(view.path, size))
    plain = read(Data(farm)).train[0].camera
    assert view.camera.fx == pytest.approx(plain.fx * size[0] / 82) and view.name == "view_001.png"
    longest = read(Data(farm, scale=by, longest=10)).train[0].camera
    assert longest.width == 10, "and may be reduced further"


def test_another_factor_or_no_factor_leaves_the_folder_alone(farm):
    shrink(farm, 4)
    for data in (Data(farm), Data(farm, scale=1), Data(farm, scale=2), Data(farm, longest=20)):
        scene, notes = noticed(data)
        assert scene.train[0].path.parent == farm / "images" and not notes


def test_a_folder_that_is_not_whole_is_said_not_to_be_used(farm):
    folder = shrink(farm, 4)
    (folder / "view_002.png").unlink()
    scene, notes = noticed(Data(farm, scale=4))
    assert scene.train[0].path.parent == farm / "images" and scene.train[0].camera.width == 20
    assert len(notes) == 1 and "images_4 lacks 1 of 4 photographs, view_002.png for one" in notes[0]
    Image.new("RGB", (41, 31)).save(folder / "view_002.png")
    scene, notes = noticed(Data(farm, scale=4))
    assert scene.train[0].path.parent == farm / "images"
    assert len(notes) == 1 and "view_002.png has 41 x 31 px, not those of 82 x 62 divided by 4" in notes[0]


def test_a_folder_that_is_named_is_divided_once_more_and_said(farm):
    shrink(farm, 2)
    scene, notes = noticed(Data(farm, images=Path("images_2"), scale=2))
    assert scene.train[0].camera.width == 20 and "are divided by 2 once more; leave out --scale" in notes[0]
    assert noticed(Data(farm, images=Path("images_2")))[0].train[0].camera.width == 41


def test_without_images_the_message_names_the_folder_there_is(farm):
    shrink(farm, 2)
    (farm / "images").rename(farm / "photos")
    with pytest.raises(BadInput, match="such as --images images_2"):
        read(Data(farm))


def test_nerfstudio_too(farm):
    scene = read(Data(farm, test_every=0))
    frames = []
    for view in scene.train:
        pose = np.linalg.inv(scene.frame.input_pose(view.camera.world_to_camera)) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": pose.tolist()})
    c = scene.train[0].camera
    lens = {"w": 82, "h": 62, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy}
    (farm / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    folder = shrink(farm, 2)
    small, notes = noticed(Data(farm, scale=2, layout="nerfstudio"))
    assert small.train[0].path.parent == folder and small.train[0].camera.width == 41
