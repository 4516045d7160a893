import pytest
from surfkit.plugin import BadInput, Data
from surfkit.testing import check
from surfkit.testing.synthetic import Flight, photograph, write_colmap

from new_plugin.new_part import POINTS, TABLE, NewPart


@pytest.fixture
def truth():
    return photograph(Flight(views=6, width=32, height=24, points=60))


@pytest.fixture
def folder(tmp_path, truth):
    """The scene in this layout; its photographs are those of a COLMAP folder."""
    write_colmap(tmp_path, truth)
    frame, views = truth.scene.frame, [*truth.scene.train, *truth.scene.held_out]
    lines = []
    for view in views:
        c, pose = view.camera, frame.input_pose(view.camera.world_to_camera)
        numbers = [c.width, c.height, c.fx, c.fy, c.cx, c.cy, *pose[:3].reshape(-1).tolist()]
        lines.append(",".join([view.name, *map(repr, numbers)]))
    (tmp_path / TABLE).write_text("\n".join(lines))
    places = frame.to_input(truth.scene.cloud.xyz.numpy()).tolist()
    rows = [[*place, *color] for place, color in zip(places, truth.scene.cloud.rgb.tolist(), strict=True)]
    (tmp_path / POINTS).write_text("\n".join(",".join(map(repr, row)) for row in rows))
    return tmp_path


def test_it_keeps_the_contract_of_its_kind(folder, truth):
    check(NewPart(), folder, truth)


def test_it_reads_all_that_is_there(folder):
    capture = NewPart().read(Data(folder))
    assert len(capture.shots) == 6
    assert capture.xyz.shape == capture.rgb.shape and len(capture.xyz) > 10


def test_it_says_what_is_wrong_with_a_line(folder):
    text = (folder / TABLE).read_text()
    (folder / TABLE).write_text(text.replace(",32,", ",wide,", 1))
    with pytest.raises(BadInput, match="line 1: could not convert"):
        NewPart().read(Data(folder))
