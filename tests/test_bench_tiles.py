"""`bench/readers/tiles.py`: where it puts cameras, and which pictures of viewers it calls wrong."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from needs import needs
from pages import ROOT
from PIL import Image

from surfkit.io.splats.tileset import ground_of
from surfkit.scene.scene import Frame

needs("pyproj")
FRAME = Frame(np.array([576_700.0, 5_188_200.0, 200.0]), 0.01, 1.0, "EPSG:32615", (576_000.0, 5_188_000.0, 0.0))


@pytest.fixture(scope="module")
def tiles():
    kept = list(sys.path)
    spec = importlib.util.spec_from_file_location("bench_tiles", ROOT / "bench" / "readers" / "tiles.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look for it
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]
    sys.path[:] = kept


def test_a_camera_on_earth_sees_a_point_of_a_tileset_where_it_sees_it_on_the_map(tiles):
    turn = np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, FRAME.origin
    points = FRAME.origin + np.array([[30.0, -20, -100], [-10, 40, -90], [0, 0, -110]])
    ground = ground_of(Path("x"), FRAME, np.eye(3))  # the formulas of UTM in surfkit; pyproj in the bench
    there = ground.metres(points) @ ground.matrix[:3, :3].T + ground.matrix[:3, 3]
    earth = tiles.pose_in(Path("tileset.json"), pose, FRAME)
    seen, wanted = (
        (xyz - of[:3, 3]) @ of[:3, :3] for xyz, of in ((there, earth), (points, pose))
    )  # the scale of the map is 0.9997 there
    assert np.abs(seen[:, :2] / seen[:, 2:] - wanted[:, :2] / wanted[:, 2:]).max() < 5e-4


def test_a_camera_that_is_moved_looks_at_the_same_place_from_farther_away(tiles):
    class Scene:
        frame = Frame(np.zeros(3), 1.0)

        class cloud:
            import torch

            xyz = torch.tensor([[0.0, 0, -40], [3, 1, -40], [0, 2, -40]])

    shot = tiles.Shot("photograph", np.eye(4), 50.0, (60, 40), np.zeros((40, 60, 3)))
    moved = tiles._moved("oblique", shot, Scene, np.radians(50), 2.0)
    target = np.array([0, 0, -40.0])
    to = target - moved.pose[:3, 3]
    assert np.linalg.norm(to) == pytest.approx(80)
    assert -moved.pose[:3, 2] == pytest.approx(to / 80)
    assert moved.photo is None and moved.pose[1, 3] < -1  # from the lower side of the picture


def test_mirrored_holed_shifted_and_failing_pictures_are_wrong(tiles, tmp_path):
    rng = np.random.default_rng(0)
    small = rng.uniform(30, 220, (10, 15, 3))
    photo = np.kron(small, np.ones((4, 4, 1)))
    shot = tiles.Shot("photograph", np.eye(4), 50.0, (60, 40), photo)
    index = tmp_path / "tileset.json"
    index.write_text('{"root": {"children": [{"content": {"uri": "tiles/0.glb"}}]}}')
    target = tiles.Target("t", "cesium", index)

    def is_right(picture, said=(), **more):
        path = tmp_path / "x.png"
        Image.fromarray(picture.round().astype(np.uint8)).save(path)
        answer = {"out": str(path), "drawn": ["tiles/0.glb"], "faults": [], "said": list(said)} | more
        return tiles.judged(target, shot, answer, photo).is_right

    assert is_right(photo) is True
    assert is_right(photo + 2, ["warn: limited support"]) is True
    assert is_right(photo[:, ::-1]) is False
    assert is_right(np.roll(photo, 4, 1)) is False
    holed = photo.copy()
    holed[10:12, 10:12] = 0
    assert is_right(holed) is False
    assert is_right(photo, ["error: 404"]) is False
    assert is_right(photo, faults=["tiles/1.glb: no such file"]) is False
    assert is_right(photo, drawn=[]) is False
