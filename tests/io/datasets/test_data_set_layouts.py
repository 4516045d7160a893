"""One small scene in the layouts of several programs is the same scene."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from data_set_folders import FLIGHT, blender, lens, nerfstudio, odm, pixels_of, save, sparse, to_world, views_of

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read, read_capture, reader_of
from surfkit.io.datasets.sparse_points import RANDOM_POINTS
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Mask
from surfkit.testing.synthetic import photograph


@pytest.fixture(scope="module")
def truth():
    return photograph(FLIGHT)


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
    with collect_notes() as kept:
        notes = kept.texts
        scene = read(Data(tmp_path))
    same(scene, truth)
    assert [view.name for view in scene.held_out] == ["images/view_002.png"]
    assert scene.train[1].mask == Mask(tmp_path / "hidden/m.png") and "1 of 6" in notes[0]
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
    blender(tmp_path, truth)
    with collect_notes() as kept:
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


def test_opendronemap(tmp_path, truth):
    with collect_notes() as kept:
        notes = kept.texts
        scene = read(Data(odm(tmp_path, truth), test_every=3))
    same(scene, truth)
    assert len(notes) == 1 and "has 2 reconstructions; the largest is used, of 6 photographs" in notes[0]
    np.testing.assert_allclose(scene.frame.to_input(scene.cloud.xyz.numpy()), sparse(truth)[0], atol=1e-4)
    for kind, extra in {"brown": {"k1": -0.1, "k3": 0.01}, "fisheye_opencv": {"k1": 0.01}}.items():
        scene = read(Data(odm(tmp_path, truth, kind, **extra)))
        assert all(view.path.parent == tmp_path / "undistorted" for view in scene.train)


def test_opendronemap_with_tracks(tmp_path, truth):
    """OpenSfM's tracks.csv: from the middle of the picture, in shares of the longer side."""
    folder, lines = odm(tmp_path, truth), ["OPENSFM_TRACKS_VERSION_v2"]
    assert reader_of(Data(folder)).tracks(Data(folder)) is None
    xyz, wanted = sparse(truth)[0], {}
    for view in views_of(truth):
        pose, c = truth.scene.frame.input_pose(view.camera.world_to_camera), view.camera
        local = xyz @ pose[:3, :3].T + pose[:3, 3]
        pixels = local[:, :2] / local[:, 2:] * (c.fx, c.fy) + (c.cx, c.cy)
        shown = np.flatnonzero(((pixels > 0) & (pixels < (40, 30))).all(1))
        wanted[view.name] = (shown, pixels[shown])
        for row, (x, y) in zip(shown, (pixels[shown] - (20, 15)) / 40, strict=True):
            lines.append(
                "\t".join(
                    [view.name, str(row), "7", repr(float(x)), repr(float(y)), "0.001", "1", "2", "3", "-1", "-1"]
                )
            )
    lines.append("gone.png\t1\t7\t0\t0\t0.001\t1\t2\t3")
    (folder / "opensfm/tracks.csv").write_text("\n".join(lines) + "\n")
    (folder / "opensfm/reference_lla.json").write_text(json.dumps(dict(latitude=47.5, longitude=8.9, altitude=430.0)))
    (folder / "odm_georeferencing").mkdir()
    (folder / "odm_georeferencing/coords.txt").write_text("WGS84 UTM 32N\n492000 5260000\n")
    tracks = reader_of(Data(folder)).tracks(Data(folder))
    for name, (rows, pixels) in wanted.items():
        np.testing.assert_array_equal(tracks.seen[name][0], rows)
        np.testing.assert_allclose(tracks.seen[name][1], pixels, atol=1e-9)
    seen = np.unique(np.concatenate([rows for rows, _ in wanted.values()]))
    assert tracks.error_px[seen].max() < 1e-3, "on the map, too"
    assert not observations(Data(folder), read(Data(folder))).is_empty
    (folder / "opensfm/tracks.csv").write_text("\n".join(lines).replace("0.001", "x").replace("\t7\t", "\t7\tx"))
    with pytest.raises(BadInput, match="tracks.csv: .*'view_000.png' .*number"):
        reader_of(Data(folder)).tracks(Data(folder))


def test_points_of_opendronemap_that_are_nowhere_are_left_out(tmp_path, truth):
    path = odm(tmp_path, truth) / "opensfm/reconstruction.json"
    contents = json.loads(path.read_text())
    points, good = max(contents, key=lambda model: len(model["shots"]))["points"], read(Data(tmp_path)).cloud
    for number, value in zip(list(points), (1e300, float("inf"), float("nan")), strict=False):
        points[number]["coordinates"][1] = value
    path.write_text(json.dumps(contents))
    left = read(Data(tmp_path)).cloud
    assert len(left.xyz) == len(good.xyz) - 3 and left.xyz.isfinite().all()


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
        (damage("camera_model", "ORTHOPHOTO"), "frames.0: camera_model ORTHOPHOTO; known: PINHOLE"),
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
    from surfkit.testing.synthetic import write_colmap

    odm(nerfstudio(tmp_path, truth), truth)
    with pytest.raises(BadInput, match="nerfstudio or odm; .*--layout"):
        read(Data(tmp_path))
    assert len(read(Data(tmp_path, layout="nerfstudio", test_every=0)).train) == 6
    write_colmap(tmp_path, truth)
    with collect_notes() as kept:
        notes = kept.texts
        assert observations(Data(tmp_path), read(Data(tmp_path))).seen
    assert len(notes) == 1 and "read as colmap; it could also be read with --layout nerfstudio, odm" in notes[0]


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


def windows(contents):
    """File names as programs on Windows write them."""
    for frame in contents["frames"]:
        for key in ("file_path", "mask_path", "depth_file_path", "depth_path"):
            if key in frame:
                frame[key] = frame[key].replace("/", "\\")
    contents["ply_file_path"] = ".\\points\\sparse.ply"
    contents["test_filenames"] = ["images\\view_002.png", ".\\images\\view_004.png"]


def test_backslashes_in_transforms_are_slashes(tmp_path, truth):
    def change(contents):
        for frame in contents["frames"]:
            frame["mask_path"] = "kept/" + frame["file_path"][-12:]
            save(tmp_path / frame["mask_path"], np.full((30, 40), 255, np.uint8))
        windows(contents)

    nerfstudio(tmp_path, truth, change)
    (tmp_path / "points").mkdir()
    (tmp_path / "sparse_pc.ply").rename(tmp_path / "points/sparse.ply")
    scene = read(Data(tmp_path))
    same(scene, truth)
    assert [view.name for view in scene.held_out] == ["images/view_002.png", "images/view_004.png"]
    assert all(view.mask is not None for view in scene.train)
    assert len(scene.cloud.xyz) == len(truth.scene.cloud.xyz)


def test_a_file_that_has_a_backslash_in_its_name_is_that_file(tmp_path, truth):
    def change(contents):
        contents["frames"][0]["file_path"] = "images\\view_000.png"
        contents["test_filenames"] = ["images\\view_000.png"]

    nerfstudio(tmp_path, truth, change)
    (tmp_path / "images/view_000.png").rename(tmp_path / "images\\view_000.png")
    scene = read(Data(tmp_path))
    assert [view.name for view in scene.held_out] == ["images\\view_000.png"]


@pytest.mark.parametrize("said", ["images/view_002", "images\\view_002"])
def test_lists_of_tests_name_photographs_as_frames_may(tmp_path, truth, said):
    scene = read(Data(nerfstudio(tmp_path, truth, lambda contents: contents.update(test_filenames=[said]))))
    assert [view.name for view in scene.held_out] == ["images/view_002.png"]


def test_lists_that_name_no_photograph_are_told(tmp_path, truth):
    listed = ["images/view_002.png", "images/gone.png"]
    nerfstudio(tmp_path, truth, lambda contents: contents.update(test_filenames=listed))
    with collect_notes() as kept:
        scene = read(Data(tmp_path))
    assert [view.name for view in scene.held_out] == ["images/view_002.png"]
    assert len(kept.texts) == 1 and "'images/gone.png'" in kept.texts[0] and "not held out" in kept.texts[0]


def test_a_list_of_tests_may_have_backslashes(tmp_path, truth):
    (tmp_path / "list.txt").write_text("images\\view_001.png\n")
    scene = read(Data(nerfstudio(tmp_path / "data", truth), test_list=tmp_path / "list.txt"))
    assert [view.name for view in scene.held_out] == ["images/view_001.png"]


@pytest.mark.parametrize("kind", ["perspective", "simple_radial", "radial", "brown", "fisheye", "fisheye_opencv"])
def test_two_focal_lengths_of_opensfm(tmp_path, truth, kind):
    """OpenSfM's camera models (opensfm/io.py): focal_x and focal_y, shares of the longer side."""
    path = odm(tmp_path, truth) / "opensfm/reconstruction.json"
    models, k = json.loads(path.read_text()), 0.02
    for model in models:
        for camera in model.get("cameras", {}).values():
            camera.pop("focal", None)
            camera.update({"projection_type": kind, "focal_x": 0.9, "focal_y": 0.95, "k1": k})
    path.write_text(json.dumps(models))
    data = Data(tmp_path, test_every=0)
    camera = read_capture(data, reader_of(data)).shots[0].camera
    at = np.array([0.2, -0.3, 1.0])
    r = float(np.hypot(*at[:2]))
    bent = np.arctan(r) * (1 + k * np.arctan(r) ** 2) / r if "fisheye" in kind else 1 + k * r**2
    longer = max(camera.width, camera.height)
    centre = np.array(camera.principal_point_x), np.array(camera.principal_point_y)
    wanted = np.array([0.9, 0.95]) * longer * bent * at[:2] + centre
    assert np.allclose(np.ravel(camera.img_from_cam(at[None])), wanted, atol=1e-9)


def test_a_missing_photograph_of_opendronemap_is_skipped(tmp_path, truth):
    folder = odm(tmp_path, truth)
    sorted((folder / "images").iterdir())[1].unlink()
    with pytest.raises(BadInput, match="1 of 6 .*missing: .*--missing skip"):
        read(Data(folder))
    assert len(read(Data(folder, test_every=0, missing="skip")).train) == 5


def without(*names, **more):
    def change(contents):
        for name in names:
            del contents[name]
        contents.update(more)

    return change


@pytest.mark.parametrize(
    "change, words",
    [
        (
            without("w", "h", cx=40, cy=30),
            "principal point 40, 30 .*80 x 60 px.* 40 x 30",
        ),
        (without("w", "h", cx=10, cy=7.5), "photograph of about 20 x 15 px"),
        (without("w", "h", cx=20, cy=31), "photograph of about 40 x 62 px"),
        (without("h", w=80), "w is 80.* 40 x 30 px; .*w and h"),
    ],
)
def test_a_camera_of_photographs_of_another_size(tmp_path, truth, change, words):
    with pytest.raises(BadInput, match=words):
        read(Data(nerfstudio(tmp_path, truth, change)))


def test_a_camera_without_a_size_is_that_of_the_photograph(tmp_path, truth):
    true = read(Data(nerfstudio(tmp_path / "whole", truth))).train[0].camera
    for name, change, told in (
        ("centre", without("w", "h"), 0),
        ("off", without("w", "h", cx=22, cy=14), 0),
        ("nothing", without("w", "h", "cx", "cy"), 1),
    ):
        with collect_notes() as notes:
            camera = read(Data(nerfstudio(tmp_path / name, truth, change))).train[0].camera
        assert (camera.width, camera.height, camera.fx) == (true.width, true.height, true.fx)
        assert len([text for text in notes.texts if "neither w and h nor cx and cy" in text]) == told
