"""One small scene in the layouts of several programs is the same scene."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from surfkit.core.check import BadInput
from surfkit.folder import noted
from surfkit.scene.data import Data
from surfkit.scene.photos import view_photo
from surfkit.scene.ply import write_points
from surfkit.scene.read import RANDOM_POINTS, observations, read
from surfkit.scene.synthetic import Flight, photograph

FLIGHT = Flight(views=6, width=40, height=30, points=60, test_every=3)
GL = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def truth():
    return photograph(FLIGHT)


def views_of(truth):
    return sorted([*truth.scene.train, *truth.scene.held_out], key=lambda view: view.name)


def pixels_of(truth, name, alpha=False):
    pixels = (truth.exact[name].color.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], 2) if alpha else pixels


def save(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def to_world(truth, view):
    """OpenGL camera_to_world, as a list."""
    return (np.linalg.inv(truth.scene.frame.input_pose(view.camera.world_to_camera)) @ GL).tolist()


def lens(truth):
    c = views_of(truth)[0].camera
    return {"w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy}


def sparse(truth):
    cloud = truth.scene.cloud
    return truth.scene.frame.to_input(cloud.xyz.numpy()), cloud.rgb.numpy()


def nerfstudio(folder, truth, change=None):
    frames = []
    for view in views_of(truth):
        save(folder / "images" / view.name, pixels_of(truth, view.name))
        frames.append({"file_path": f"./images/{view.name}", "transform_matrix": to_world(truth, view)})
    write_points(folder / "sparse_pc.ply", *sparse(truth))
    contents = {**lens(truth), "camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply", "frames": frames}
    if change:
        change(contents)
    (folder / "transforms.json").write_text(json.dumps(contents))
    return folder


def same(scene, truth, atol=1e-6):
    """The cameras of the scene are those of the truth, in its own input frame."""
    expected = {Path(view.name).stem: view for view in views_of(truth)}
    for view in (*scene.train, *scene.held_out):
        wanted, camera = expected[Path(view.name).stem], view.camera
        pose = truth.scene.frame.input_pose(wanted.camera.world_to_camera)
        np.testing.assert_allclose(scene.frame.input_pose(camera.world_to_camera), pose, atol=1e-6)
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(camera, name) == pytest.approx(getattr(wanted.camera, name), abs=atol)
        photo = truth.exact[wanted.name].color * 255
        assert (view_photo(view).double() - photo).abs().max() <= 1


def test_nerfstudio(tmp_path, truth):
    scene = read(Data(nerfstudio(tmp_path, truth), test_every=3))
    same(scene, truth)
    assert [view.name for view in scene.held_out] == ["images/view_000.png", "images/view_003.png"]
    np.testing.assert_allclose(scene.frame.to_input(scene.cloud.xyz.numpy()), sparse(truth)[0], atol=1e-4)
    assert torch.equal(scene.cloud.rgb, truth.scene.cloud.rgb)
    assert not observations(Data(tmp_path), scene).seen


def test_nerfstudio_with_its_own_split_intrinsics_by_frame_masks_and_points_as_text(tmp_path, truth):
    def change(contents):
        for key in lens(truth):
            del contents[key]
        for frame in contents["frames"]:
            frame.update(lens(truth))
        contents["test_filenames"] = ["./images/view_002.png"]
        contents["frames"][1]["mask_path"] = "hidden/m.png"

    nerfstudio(tmp_path, truth, change)
    save(tmp_path / "hidden/m.png", np.zeros((30, 40), np.uint8))
    xyz, rgb = sparse(truth)
    rows = "\n".join(f"{a} {b} {c} {r} {g} {h}" for (a, b, c), (r, g, h) in zip(xyz, rgb.tolist(), strict=True))
    head = "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uint8 {color}\n" for color in ("red", "green", "blue"))
    text = f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n{head}end_header\n{rows}\n"
    (tmp_path / "sparse_pc.ply").write_text(text)
    with noted() as kept:
        notes = kept.texts
        scene = read(Data(tmp_path))
    same(scene, truth)
    assert [view.name for view in scene.held_out] == ["images/view_002.png"]
    assert scene.train[1].mask == tmp_path / "hidden/m.png" and "1 of 6" in notes[0]
    np.testing.assert_allclose(scene.frame.to_input(scene.cloud.xyz.numpy()), xyz, atol=1e-4)
    assert torch.equal(scene.cloud.rgb, truth.scene.cloud.rgb)


def test_distorted_nerfstudio(tmp_path, truth):
    scene = read(Data(nerfstudio(tmp_path, truth, lambda c: c.update(k1=-0.05, k2=0.01, p1=0.001, k3=0.002))))
    assert all(view.path.parent == tmp_path / "undistorted" for view in scene.train)
    (tmp_path / "fisheye").mkdir()
    fisheye = nerfstudio(tmp_path / "fisheye", truth, lambda c: c.update(camera_model="OPENCV_FISHEYE", k1=0.01))
    assert all(view.path.parent.name == "undistorted" for view in read(Data(fisheye)).train)


@pytest.mark.parametrize("white", [False, True])
def test_blender(tmp_path, truth, white):
    angle = 2 * math.atan(20 / views_of(truth)[0].camera.fx)
    held = {view.name for view in truth.scene.held_out}
    for part, chosen in {"train": False, "test": True}.items():
        frames = []
        for view in views_of(truth):
            if (view.name in held) == chosen:
                pixels = pixels_of(truth, view.name, alpha=True)
                pixels[:5, :5, 3] = 0
                save(tmp_path / part / view.name, pixels)
                stem = Path(view.name).stem
                frames.append({"file_path": f"./{part}/{stem}", "transform_matrix": to_world(truth, view)})
        contents = {"camera_angle_x": angle, "frames": frames}
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps(contents))
    with noted() as kept:
        notes = kept.texts
        scene = read(Data(tmp_path, white=white))
    assert [view.name for view in scene.held_out] == ["test/view_000.png", "test/view_003.png"]
    camera = scene.train[0].camera
    assert camera.fx == camera.fy == pytest.approx(views_of(truth)[0].camera.fx) and (camera.cx, camera.cy) == (20, 15)
    assert (view_photo(scene.train[0])[:, :5, :5] == (255 if white else 0)).all()
    assert len(scene.cloud.xyz) == RANDOM_POINTS and "no sparse points" in notes[0]
    shown = scene.cloud.xyz.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    assert (shown[:, 2] > 0).float().mean() > 0.2


def test_matrixcity(tmp_path, truth):
    """Poses with shrunken rotations, photographs by number, and a test folder of its own."""
    held = {view.name for view in truth.scene.held_out}
    for part, block, chosen in (("train", "block_1", False), ("test", "block_1_test", True)):
        frames = []
        for number, view in enumerate(v for v in views_of(truth) if (v.name in held) == chosen):
            save(tmp_path / "aerial" / part / block / f"{number:04d}.png", pixels_of(truth, view.name))
            matrix = np.array(to_world(truth, view))
            matrix[:3, :3] /= 100
            frames.append({"frame_index": number, "rot_mat": matrix.tolist()})
        contents = {"camera_angle_x": 1.0, "frames": frames}
        (tmp_path / "aerial" / part / block / "transforms.json").write_text(json.dumps(contents))
    scene = read(Data(tmp_path / "aerial"))
    assert len(scene.train) == 4 and [v.name for v in scene.held_out] == [
        f"test/block_1_test/000{i}.png" for i in (0, 1)
    ]
    for view, wanted in zip(scene.train, truth.scene.train, strict=True):
        pose = truth.scene.frame.input_pose(wanted.camera.world_to_camera)
        np.testing.assert_allclose(scene.frame.input_pose(view.camera.world_to_camera), pose, atol=1e-6)


def odm(folder, truth, kind="brown", **coefficients):
    c = views_of(truth)[0].camera
    normal = {"c_x": (c.cx - 20) / 40, "c_y": (c.cy - 15) / 40, "focal_x": c.fx / 40, "focal_y": c.fy / 40}
    camera = {"projection_type": kind, "width": 40, "height": 30, **normal, **coefficients}
    shots = {}
    for view in views_of(truth):
        save(folder / "images" / view.name, pixels_of(truth, view.name))
        pose = truth.scene.frame.input_pose(view.camera.world_to_camera)
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
        shots[view.name] = {"rotation": turn, "translation": pose[:3, 3].tolist(), "camera": "v2 made"}
    xyz, rgb = sparse(truth)
    pairs = enumerate(zip(xyz.tolist(), rgb.tolist(), strict=True))
    points = {str(i): {"coordinates": place, "color": color} for i, (place, color) in pairs}
    small = {"cameras": {}, "shots": {"a.png": {}}, "points": {}}
    model = {"cameras": {"v2 made": camera}, "shots": shots, "points": points}
    (folder / "opensfm").mkdir(exist_ok=True)
    (folder / "opensfm/reconstruction.json").write_text(json.dumps([small, model]))
    return folder


def test_opendronemap(tmp_path, truth):
    with noted() as kept:
        notes = kept.texts
        scene = read(Data(odm(tmp_path, truth), test_every=3))
    same(scene, truth)
    assert len(notes) == 1 and "has 2 reconstructions; the largest is used, of 6 photographs" in notes[0]
    np.testing.assert_allclose(scene.frame.to_input(scene.cloud.xyz.numpy()), sparse(truth)[0], atol=1e-4)
    for kind, extra in {"brown": {"k1": -0.1, "k3": 0.01}, "fisheye_opencv": {"k1": 0.01}}.items():
        scene = read(Data(odm(tmp_path, truth, kind, **extra)))
        assert all(view.path.parent == tmp_path / "undistorted" for view in scene.train)


def damage(key, value):
    def change(contents):
        for place in (contents, contents["frames"][2]):
            if key in place:
                place[key] = value

    return change


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (damage("frames", []), "transforms.json: no list of frames in it"),
        (damage("fl_x", "wide"), "frames.0: fl_x is 'wide', not a number"),
        (damage("camera_model", "EQUIRECTANGULAR"), "frames.0: camera_model EQUIRECTANGULAR; known: PINHOLE"),
        (damage("transform_matrix", [[1, 2], [3, 4]]), "frames.2: transform_matrix is not 4 x 4 finite numbers"),
        (damage("transform_matrix", np.zeros((4, 4)).tolist()), "frames.2: transform_matrix is not a rotation"),
        (damage("file_path", "images/gone.png"), "frames.2: no photograph 'images/gone.png'"),
        (damage("file_path", "images/view_001.png"), "two frames have the same photograph"),
        (damage("ply_file_path", "gone.ply"), "gone.ply: cannot be read"),
        (damage("h", 20), "view_000.png: 40 x 30 px, but its camera"),
    ],
)
def test_damaged_transforms(tmp_path, truth, change, text):
    def twice(contents):
        change(contents)

    nerfstudio(tmp_path, truth, twice)
    with pytest.raises(BadInput) as error:
        read(Data(tmp_path))
    assert text in str(error.value) and "\n" not in str(error.value), str(error.value)


def test_a_folder_of_two_layouts_needs_a_choice_unless_one_is_colmap(tmp_path, truth):
    from surfkit.scene.synthetic import write_colmap

    odm(nerfstudio(tmp_path, truth), truth)
    with pytest.raises(BadInput, match="could be of layout nerfstudio or odm; choose one with --layout"):
        read(Data(tmp_path))
    assert len(read(Data(tmp_path, layout="nerfstudio", test_every=0)).train) == 6
    write_colmap(tmp_path, truth)
    with noted() as kept:
        notes = kept.texts
        assert observations(Data(tmp_path), read(Data(tmp_path))).seen
    assert len(notes) == 1 and "read as COLMAP; it could also be read with --layout nerfstudio, odm" in notes[0]


@pytest.mark.parametrize("layout", ["nerfstudio", "distorted", "odm"])
def test_every_layout_trains(tmp_path, truth, layout):
    from surfkit.cli.recipes import recipes
    from surfkit.core.tree import evolve
    from surfkit.pipeline import run, with_steps

    folder = tmp_path / "data"
    folder.mkdir()
    if layout == "odm":
        odm(folder, truth)
    else:
        nerfstudio(folder, truth, None if layout == "nerfstudio" else lambda contents: contents.update(k1=-0.02))
    recipe = evolve(with_steps(recipes()["2dgs"], 100), "primitive.sh_degree", 0)
    metrics = run(recipe, Data(folder, test_every=3), tmp_path / "run")
    assert metrics["images"]["psnr"] > 10 and metrics["steps"] == 100


def test_opendronemap_on_the_map(tmp_path, truth):
    """The topocentric reconstruction is used, not the one that OpenDroneMap put in its place, and moved to UTM."""
    folder = odm(tmp_path, truth)
    (folder / "opensfm/reconstruction.json").rename(folder / "opensfm/reconstruction.topocentric.json")
    (folder / "opensfm/reconstruction.json").write_text("[]")
    (folder / "opensfm/reference_lla.json").write_text('{"latitude": 47.5, "longitude": 8.9, "altitude": 430.0}')
    (folder / "odm_georeferencing").mkdir()
    (folder / "odm_georeferencing/coords.txt").write_text("WGS84 UTM 32N\n492000 5260000\n")
    scene = read(Data(folder, test_every=3))
    frame = scene.frame
    assert (frame.crs, frame.metres, frame.shift) == ("EPSG:32632", 1.0, (492000.0, 5260000.0, 0.0))
    np.testing.assert_allclose(frame.origin, (492468.65734, 5260734.57871, 444), atol=15)
    for view, wanted in zip(scene.train, truth.scene.train, strict=True):
        east = wanted.camera.centre - truth.scene.train[0].camera.centre
        here = view.camera.centre - scene.train[0].camera.centre
        assert float(here.norm()) == pytest.approx(float(east.norm()), abs=1e-3), (
            "the same flight at the same scale of the extent"
        )
