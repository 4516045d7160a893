"""The benchmarks of city scenes in the layouts in which they are handed out: MatrixCity and GauU-Scene."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from data_set_folders import DEPTHS, FLIGHT, city, nerfstudio, renumbered, squarely, with_tests_apart

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import read_priors
from surfkit.io.datasets.read import read
from surfkit.io.datasets.sparse_points import RANDOM_POINTS
from surfkit.io.datasets.split import GauUScene
from surfkit.runs.run_notes import collect_notes
from surfkit.testing.synthetic import SURFACES, Flight, look, photograph, write_colmap


@pytest.fixture(scope="module")
def truth():
    return photograph(FLIGHT)


@pytest.mark.parametrize("kind", DEPTHS)
def test_matrixcity_with_depth(tmp_path, truth, kind):
    data = Data(city(tmp_path, truth, kind))
    scene = read(data)
    assert (len(scene.train), len(scene.held_out), scene.frame.metres) == (4, 2, 1.0)
    assert all(view.name.startswith("test/block_1_test/") for view in scene.held_out)
    xyz = scene.frame.to_input(scene.cloud.xyz.numpy())
    assert len(xyz) == 4 * (40 * 30 - 5 * 7), "every pixel that is not sky"
    away = np.min([surface.distance(xyz) for surface in SURFACES], axis=0)
    assert away.max() < (0.02 if kind == "street" else 1e-4), "metres; half floats keep centimetres"
    again = read(data).cloud
    assert torch.equal(again.xyz, scene.cloud.xyz) and torch.equal(again.rgb, scene.cloud.rgb)
    pose = scene.frame.input_pose(scene.train[0].camera.world_to_camera)  # the points of the first come first
    _, colors = look(FLIGHT, pose, xyz[:1165] @ pose[:3, :3].T + pose[:3, 3])
    assert np.abs(scene.cloud.rgb[:1165].numpy() - colors * 255).mean() < 1
    with collect_notes() as notes:
        priors = read_priors(data, scene)
    assert priors is not None and not notes.texts
    for at, view in enumerate(truth.scene.train):
        wanted = torch.from_numpy(squarely(truth, view)[1]) * truth.scene.frame.scale
        there = torch.ones(30, 40, dtype=torch.bool)
        there[:5, :7] = False
        assert torch.equal(priors[at].inverse > 0, there), "the sky has no depth"
        torch.testing.assert_close(1 / priors[at].inverse[there].double(), wanted[there], rtol=1e-3, atol=0)


def test_poses_in_hundreds_of_metres(tmp_path, truth):
    """pose/BLOCK: whole rotations, another unit, photographs named from there, depth of the folder they lie in."""
    root = city(tmp_path, truth, "aerial")
    pose = root / "pose" / "block_all"
    pose.mkdir(parents=True)
    for part, block in (("train", "block_1"), ("test", "block_1_test")):
        contents = json.loads((root / part / block / "transforms.json").read_text())
        frames = []
        for frame in contents["frames"]:
            matrix = np.array(frame["rot_mat"]) * 100
            matrix[:3, 3] /= 100 * 100
            path = f"../../{part}/{block}/{frame['frame_index']:04d}.png"
            frames.append({"file_path": path, "transform_matrix": matrix.tolist()})
        (pose / f"transforms_{part}.json").write_text(json.dumps(contents | {"frames": frames}))
    data = Data(pose)
    scene = read(data)
    assert scene.frame.metres == 100 and scene.train[0].name == "train/block_1/0000.png"
    priors = read_priors(data, scene)
    wanted = torch.from_numpy(squarely(truth, truth.scene.train[1])[1]) * truth.scene.frame.scale
    torch.testing.assert_close(1 / priors[1].inverse[5:].double(), wanted[5:], rtol=1e-3, atol=0)
    assert read(Data(root)).frame.scale * 100 == pytest.approx(scene.frame.scale), "the same extent in other units"


def test_depth_without_its_package_or_of_another_kind_is_said(tmp_path, truth, monkeypatch):
    data = Data(city(tmp_path, truth, "aerial"))
    scene = read(data)
    path = tmp_path / "city_depth_float32/aerial/train/block_1_depth/0002.exr"
    path.write_bytes(path.read_bytes()[:200])
    with collect_notes() as notes:
        assert read_priors(data, scene)[2] is None and len(read(data).cloud.xyz) == 3 * 1165
    assert "1 of 4 photographs train without" in notes.texts[0]
    assert "1 of 4 depth maps" in notes.texts[1] and f"first {path}: cannot be read" in notes.texts[1]
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with collect_notes() as notes:
        assert read_priors(data, scene) is None
    assert "pip install 'surfkit[exr]'" in notes.texts[0]
    assert len(read(data).cloud.xyz) == RANDOM_POINTS


def test_the_split_of_gauu_scene(tmp_path):
    """24 images: step 24 // 3 = 8, in the order of COLMAP's numbers, not of the names."""
    write_colmap(tmp_path, photograph(Flight(views=24, width=16, height=12, points=30, test_every=0)))
    renumbered(tmp_path / "sparse/0")
    held = [view.name for view in read(Data(tmp_path, split=GauUScene())).held_out]
    assert held == ["view_007.png", "view_015.png", "view_023.png"]
    assert [view.name for view in read(Data(tmp_path)).held_out] == ["view_000.png", "view_008.png", "view_016.png"]
    with pytest.raises(BadInput, match="--split, --test-list and --test-data"):
        Data(tmp_path, split=GauUScene(), test_list=Path("a.txt"))


def test_the_split_of_gauu_scene_needs_the_numbers_of_colmap(tmp_path, truth):
    data = nerfstudio(tmp_path, truth)
    with pytest.raises(BadInput, match="^--split gauu-scene: .*COLMAP"):
        read(Data(data, split=GauUScene()))


def test_a_test_folder_with_a_model_of_its_own(tmp_path, truth):
    """MatrixCity as CityGaussian prepares it: two COLMAP folders in the same coordinates."""
    train, test = with_tests_apart(tmp_path, truth)
    held = {view.name for view in truth.scene.held_out}
    scene = read(Data(train, test_data=test))
    assert [view.name for view in scene.held_out] == [f"block_all_test/{name}" for name in sorted(held)]
    for view, wanted in zip(scene.held_out, truth.scene.held_out, strict=True):
        assert view.path == test / "images" / wanted.name
        pose = truth.scene.frame.input_pose(wanted.camera.world_to_camera)
        np.testing.assert_allclose(scene.frame.input_pose(view.camera.world_to_camera), pose, atol=1e-6)
    with pytest.raises(BadInput, match="--test-data .*gone: no such folder"):
        read(Data(train, test_data=tmp_path / "gone"))
