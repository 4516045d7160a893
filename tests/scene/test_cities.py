"""The benchmarks of city scenes in the layouts in which they are handed out: MatrixCity and GauU-Scene."""

import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.folder import noted
from surfkit.scene.data import Data
from surfkit.scene.depth_prior import read_priors
from surfkit.scene.read import read
from surfkit.scene.synthetic import Flight, photograph, write_colmap

FLIGHT = Flight(views=6, width=40, height=30, points=60, test_every=3)
GL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def truth():
    return photograph(FLIGHT)


def square(truth):
    """The views with square pixels and a centred principal point, as MatrixCity's, in order."""
    from dataclasses import replace

    views = sorted([*truth.scene.train, *truth.scene.held_out], key=lambda view: view.name)
    return [replace(v, camera=replace(v.camera, fy=v.camera.fx, cx=20.0, cy=15.0)) for v in views]


def write_exr(path, depth):
    import OpenEXR

    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.stack([depth] * 3, -1)}).write(str(path))


DEPTHS = {
    "aerial": ("city_depth_float32/aerial/{part}/{block}_depth/{number:04d}.exr", np.float32),
    "street": ("city_depth/street/{part}/{block}_depth/{block}_depth/{number:04d}.exr", np.float16),
    "beside": ("city/beside/{part}/{block}/depth/{number:04d}.exr", np.float32),
}


def city(folder, truth, kind):
    """small_city as MatrixCity hands it out: metres and shrunken rotations, archives unpacked in three ways."""
    pytest.importorskip("OpenEXR")
    pattern, dtype = DEPTHS[kind]
    root, held = folder / "city" / kind, {view.name for view in truth.scene.held_out}
    inside = {"aerial": "", "street": "{block}/", "beside": "rgb/"}[kind]
    for part, block in (("train", "block_1"), ("test", "block_1_test")):
        frames = []
        for number, view in enumerate(v for v in square(truth) if (v.name in held) == (part == "test")):
            exact = truth.exact[view.name]
            path = root / part / block / inside.format(block=block) / f"{number:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            pixels = (exact.color.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
            Image.fromarray(pixels).save(path)
            matrix = np.linalg.inv(truth.scene.frame.input_pose(view.camera.world_to_camera)) @ GL
            matrix[:3, :3] /= 100
            matrix[3, 3] /= 100
            frames.append({"frame_index": number, "rot_mat": matrix.tolist()})
            centimetres = exact.depth.numpy() / truth.scene.frame.scale * 100
            centimetres[:5, :7] = 65504
            write_exr(folder / pattern.format(part=part, block=block, number=number), centimetres.astype(dtype))
        angle = 2 * math.atan(20 / square(truth)[0].camera.fx)
        text = json.dumps({"camera_angle_x": angle, "frames": frames})
        (root / part / block / "transforms.json").write_text(text)
    return root


@pytest.mark.parametrize("kind", DEPTHS)
def test_matrixcity_with_depth(tmp_path, truth, kind):
    data = Data(city(tmp_path, truth, kind))
    scene = read(data)
    assert (len(scene.train), len(scene.held_out), scene.frame.metres) == (4, 2, 1.0)
    assert all(view.name.startswith("test/block_1_test/") for view in scene.held_out)
    with noted() as notes:
        priors = read_priors(data, scene)
    assert priors is not None and not notes.texts
    for at, view in enumerate(truth.scene.train):
        wanted = truth.exact[view.name].depth
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
    wanted = truth.exact[truth.scene.train[1].name].depth
    torch.testing.assert_close(1 / priors[1].inverse[5:].double(), wanted[5:], rtol=1e-3, atol=0)
    assert read(Data(root)).frame.scale * 100 == pytest.approx(scene.frame.scale), "the same extent in other units"


def test_depth_without_its_package_or_of_another_kind_is_said(tmp_path, truth, monkeypatch):
    data = Data(city(tmp_path, truth, "aerial"))
    scene = read(data)
    path = tmp_path / "city_depth_float32/aerial/train/block_1_depth/0002.exr"
    path.write_bytes(path.read_bytes()[:200])
    with noted() as notes:
        assert read_priors(data, scene)[2] is None
    assert "1 of 4 photographs train without a depth prior: cannot be read" in notes.texts[0]
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with noted() as notes:
        assert read_priors(data, scene) is None
    assert "needs the package OpenEXR: pip install 'surfkit[exr]'" in notes.texts[0]


def renumbered(model):
    """Numbers of the images of a COLMAP model in the reverse order of their names."""
    lines = (model / "images.txt").read_text().splitlines()
    count = len(lines) // 2
    for at in range(0, len(lines), 2):
        words = lines[at].split()
        lines[at] = " ".join([str(count + 1 - int(words[0])), *words[1:]])
    (model / "images.txt").write_text("\n".join(lines) + "\n")


def test_the_split_of_gauu_scene(tmp_path):
    """24 images: step 24 // 3 = 8, in the order of COLMAP's numbers, not of the names."""
    write_colmap(tmp_path, photograph(Flight(views=24, width=16, height=12, points=30, test_every=0)))
    renumbered(tmp_path / "sparse/0")
    held = [view.name for view in read(Data(tmp_path, split="gauu-scene")).held_out]
    assert held == ["view_007.png", "view_015.png", "view_023.png"]
    assert [view.name for view in read(Data(tmp_path)).held_out] == ["view_000.png", "view_008.png", "view_016.png"]
    with pytest.raises(BadInput, match="--split, --test-list and --test-data each choose"):
        Data(tmp_path, split="gauu-scene", test_list=Path("a.txt"))
    with pytest.raises(BadInput, match="--split gauu-scene: is for COLMAP data sets"):
        (tmp_path / "transforms.json").write_text("{}")
        read(Data(tmp_path, split="gauu-scene", layout="nerfstudio"))


def test_a_test_folder_with_a_model_of_its_own(tmp_path, truth):
    """MatrixCity as CityGaussian prepares it: two COLMAP folders in the same coordinates."""
    train, test = tmp_path / "train/block_all", tmp_path / "test/block_all_test"
    write_colmap(train, truth, tracks=True)
    shutil.copytree(train, test)
    held = {view.name for view in truth.scene.held_out}
    for folder, drop in ((train, held), (test, {f"view_{i:03d}.png" for i in range(6)} - held)):
        model = folder / "sparse/0"
        lines = (model / "images.txt").read_text().splitlines()
        kept = [i for i in range(0, len(lines), 2) if lines[i].split()[-1] not in drop]
        (model / "images.txt").write_text("".join(f"{lines[i]}\n\n" for i in kept))
        points = [line.split()[:8] for line in (model / "points3D.txt").read_text().splitlines()]
        (model / "points3D.txt").write_text("".join(" ".join(words) + "\n" for words in points))
    scene = read(Data(train, test_data=test))
    assert [view.name for view in scene.held_out] == [f"block_all_test/{name}" for name in sorted(held)]
    for view, wanted in zip(scene.held_out, truth.scene.held_out, strict=True):
        assert view.path == test / "images" / wanted.name
        pose = truth.scene.frame.input_pose(wanted.camera.world_to_camera)
        np.testing.assert_allclose(scene.frame.input_pose(view.camera.world_to_camera), pose, atol=1e-6)
    with pytest.raises(BadInput, match="--test-data .*gone: no such folder"):
        read(Data(train, test_data=tmp_path / "gone"))
