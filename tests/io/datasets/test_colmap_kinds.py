"""COLMAP folders as people have them: several models, other spellings, rigs, distorted cameras."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.datasets import colmap, undistort
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.io.datasets.read import observations, read
from surfkit.runs.run_notes import collect_notes
from surfkit.scene import decoded_photos as copies
from surfkit.scene.photos import read_photo, view_photo
from surfkit.testing.synthetic import Flight, photograph, write_colmap

FLIGHT = Flight(views=5, width=64, height=48, points=80)
LENSES = {
    "SIMPLE_RADIAL": "58 31 24 -0.08",
    "RADIAL": "58 31 24 -0.08 0.02",
    "OPENCV": "58 57 31 24 -0.08 0.02 0.001 -0.002",
    "FULL_OPENCV": "58 57 31 24 -0.08 0.02 0.001 -0.002 0.001 0.01 0.002 0.001",
    "FOV": "58 57 31 24 0.6",
    "SIMPLE_RADIAL_FISHEYE": "58 31 24 0.05",
    "RADIAL_FISHEYE": "58 31 24 0.05 0.01",
    "OPENCV_FISHEYE": "58 57 31 24 0.05 0.01 0 0",
    "THIN_PRISM_FISHEYE": "58 57 31 24 0.05 0.01 0 0 0 0 0.001 0.001",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "farm"
    truth = photograph(FLIGHT)
    write_colmap(folder, truth, tracks=True)
    return folder, truth


@pytest.fixture
def farm(made, tmp_path):
    return Path(shutil.copytree(made[0], tmp_path / "farm"))


def noticed(data):
    """The scene, and what was said of it."""
    with collect_notes() as kept:
        notes = kept.texts
        return read(data), notes


def test_the_largest_of_several_models_is_used(farm):
    model = farm / "sparse" / "0"
    lines = (model / "images.txt").read_text().splitlines(keepends=True)
    model.rename(farm / "sparse" / "1")
    shutil.copytree(farm / "sparse" / "1", model)
    (model / "images.txt").write_text("".join(lines[:4]))  # two of the five
    points = (model / "points3D.txt").read_text().splitlines()
    (model / "points3D.txt").write_text("".join(" ".join(line.split()[:8]) + "\n" for line in points))
    scene, notes = noticed(Data(farm))
    assert len(scene.train) + len(scene.held_out) == 5
    assert len(notes) == 1 and "sparse/0 of 2, sparse/1 of 5" in notes[0]
    assert "sparse/1 is used, choose another with --model" in notes[0]
    small, notes = noticed(Data(farm, model=Path("sparse/0"), test_every=0))
    assert [view.name for view in small.train] == ["view_000.png", "view_001.png"] and not notes
    with pytest.raises(BadInput, match="--model .*sparse/2: no COLMAP"):
        read(Data(farm, model=Path("sparse/2")))
    (model / "cameras.txt").unlink()
    with pytest.raises(BadInput, match="sparse/0: .*lacks cameras.txt"):
        read(Data(farm, model=Path("sparse/0")))
    shutil.rmtree(model)
    assert len(read(Data(farm)).train) == 4, "a lone sparse/1 does too"


def test_points_that_images_refer_to_must_be_there(farm):
    (farm / "sparse" / "0" / "points3D.txt").write_text("")
    with pytest.raises(BadInput, match="sparse/0: .*3D points.* none"):
        read(Data(farm))


def test_exif_that_turns_photographs_is_ignored_and_said(farm):
    """As COLMAP does, so that sizes and pixels are those stored."""
    turn = Image.Exif()
    turn[0x0112] = 6
    for path in (farm / "images").iterdir():
        Image.open(path).save(path.with_suffix(".jpg"), quality=95, exif=turn)
        path.unlink()
    seen = np.asarray(load_pycolmap().Bitmap.read(str(farm / "images/view_001.jpg"), True).to_array())
    scene, notes = noticed(Data(farm))
    assert "5 of 5 photographs have an EXIF tag" in notes[-1] and "view_000.png" in notes[-1]
    photo = view_photo(scene.train[0]).permute(1, 2, 0).numpy()
    assert photo.shape == (48, 64, 3) and np.abs(photo.astype(int) - seen).max() <= 2
    (farm / "sparse/0/cameras.txt").write_text("1 PINHOLE 48 64 58 57 24 31\n")
    with pytest.raises(BadInput, match=r"\(turned by 90 degrees\).*EXIF"):
        read(Data(farm))


def test_names_in_another_spelling_are_matched_with_one_note(farm):
    images = farm / "images"
    (images / "view_001.png").rename(images / "VIEW_001.PNG")
    (images / "left").mkdir()
    (images / "view_002.png").rename(images / "left" / "view_002.png")
    Image.open(images / "view_003.png").save(images / "view_003.tif")
    (images / "view_003.png").unlink()
    scene, notes = noticed(Data(farm, test_every=0))
    files = [view.path.relative_to(images).as_posix() for view in scene.train]
    assert files == ["view_000.png", "VIEW_001.PNG", "left/view_002.png", "view_003.tif", "view_004.png"]
    assert len(notes) == 1 and "3 photographs" in notes[0]


def test_a_spelling_that_fits_two_files_is_none(farm):
    images = farm / "images"
    for side in ("left", "right"):
        (images / side).mkdir()
        shutil.copy(images / "view_002.png", images / side)
    (images / "view_002.png").unlink()
    with pytest.raises(BadInput, match="1 of 5 .*missing: 'view_002.png'"):
        read(Data(farm))


def test_rigs_and_frames(made, tmp_path):
    """A camera that is mounted on another stands where both transforms together put it."""
    pycolmap = load_pycolmap()
    folder, truth = made
    if not hasattr(pycolmap, "Rig"):
        pytest.skip("this pycolmap knows no rigs")
    shutil.copytree(folder / "images", tmp_path / "images")
    (tmp_path / "sparse/0").mkdir(parents=True)
    source = pycolmap.Reconstruction(str(folder / "sparse/0"))
    model = pycolmap.Reconstruction()
    for number in (1, 2):
        lens = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[58, 57, 31, 24], camera_id=number)
        model.add_camera(lens)
    mount = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0, 0.1, 0.995])), np.array([0.3, -0.1, 0.2]))
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), mount)
    model.add_rig(rig)
    poses = {}
    for at, one in enumerate((1, 3), 1):
        first, second = source.images[one], source.images[one + 1]
        frame = pycolmap.Frame(frame_id=at, rig_id=1, rig_from_world=first.cam_from_world())
        for camera, image in ((1, first), (2, second)):
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera), image.image_id))
            poses[image.name] = (mount if camera == 2 else pycolmap.Rigid3d()) * first.cam_from_world()
        model.add_frame(frame)
        for camera, image in ((1, first), (2, second)):
            model.add_image(pycolmap.Image(name=image.name, image_id=image.image_id, camera_id=camera, frame_id=at))
        model.register_frame(at)
    for point in source.points3D.values():
        model.add_point3D(point.xyz, pycolmap.Track(), point.color)
    model.write_binary(str(tmp_path / "sparse/0"))
    assert (tmp_path / "sparse/0/rigs.bin").exists() and (tmp_path / "sparse/0/frames.bin").exists()
    scene = read(Data(tmp_path, test_every=0))
    assert len(scene.train) == 4
    for view in scene.train:
        wanted = poses[view.name].matrix()
        np.testing.assert_allclose(scene.frame.input_pose(view.camera.world_to_camera)[:3], wanted, atol=1e-9)


def distort(farm, lens):
    """Give the model another lens, and bend its photographs and observations as that lens would."""
    from scipy.ndimage import map_coordinates

    pycolmap = load_pycolmap()
    (farm / "sparse/0/cameras.txt").write_text(f"1 {lens} 64 48 {LENSES[lens]}\n")
    bent = pycolmap.Camera(model=lens, width=64, height=48, params=[float(v) for v in LENSES[lens].split()])
    xy = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), -1).reshape(-1, 2)
    rays = bent.cam_from_img(xy)
    truth = photograph(FLIGHT)
    straight = truth.scene.train[0].camera
    at = rays * (straight.fx, straight.fy) + (straight.cx, straight.cy) - 0.5
    for path in (farm / "images").iterdir():
        pixels = np.asarray(Image.open(path), np.float64)
        made = [map_coordinates(pixels[..., c], at.T[::-1], order=1, mode="nearest") for c in range(3)]
        Image.fromarray(np.stack(made, -1).reshape(48, 64, 3).round().astype(np.uint8)).save(path)
    model = pycolmap.Reconstruction(str(farm / "sparse/0"))
    for image in model.images.values():
        for spot in image.points2D:
            ray = (np.array(spot.xy) - (straight.cx, straight.cy)) / (straight.fx, straight.fy)
            spot.xy = bent.img_from_cam(np.array([[*ray, 1.0]]))[0]
    model.write_text(str(farm / "sparse/0"))
    return truth


@pytest.mark.parametrize("lens", LENSES)
def test_distorted_cameras_are_undistorted(farm, lens):
    truth = distort(farm, lens)
    scene = read(Data(farm))
    tracks = observations(Data(farm), scene)
    straight = truth.scene.train[0].camera
    for view in scene.train:
        camera, photo = view.camera, view_photo(view).float()
        assert view.path.parent == farm / "undistorted" and photo.shape[1:] == (camera.height, camera.width)
        x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx * straight.fx + straight.cx
        y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy * straight.fy + straight.cy
        grid = torch.stack(torch.meshgrid(x / 32 - 1, y / 24 - 1, indexing="xy"), -1)[None].float()
        wanted = torch.nn.functional.grid_sample(
            truth.exact[view.name].color[None].float() * 255, grid, align_corners=False
        )[0]
        inside = (grid[0].abs() < 0.9).all(-1)
        assert (photo - wanted)[:, inside].abs().mean() < 4, "of 255; sampled twice"
        at, inverse = tracks.of(view)
        assert len(at) > 10
        seen = tracks.seen[view.name]
        pose = camera.world_to_camera.numpy()
        local = tracks.xyz[seen.points] @ pose[:3, :3].T + pose[:3, 3]
        pixels = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        np.testing.assert_allclose(seen.at * (camera.width, camera.height), pixels, atol=1e-3)


def test_a_binary_model_has_the_tracks_of_a_text_model_without_an_object_for_each(farm, monkeypatch):
    """A survey of thousands of photographs has millions of observations."""
    model = farm / "sparse/0"
    text = colmap.COLMAP().tracks(Data(farm))
    loaded = load_pycolmap().Reconstruction(str(model))
    loaded.delete_point3D(min(loaded.points3D))  # its features show no point any more
    loaded.write_binary(str(model))
    for path in model.glob("*.txt"):
        path.unlink()
    monkeypatch.setattr(load_pycolmap().Image, "points2D", property(lambda image: pytest.fail("one object for each")))
    binary = colmap.COLMAP().tracks(Data(farm))
    assert len(binary.xyz) == len(text.xyz) - 1 and sum(len(rows) for rows, _ in text.seen.values()) > 100
    for name, (rows, pixels) in text.seen.items():
        kept = rows > 0
        np.testing.assert_array_equal(binary.seen[name][0], rows[kept] - 1)
        np.testing.assert_array_equal(binary.seen[name][1], pixels[kept])


def test_undistorted_photographs_are_made_once_and_made_anew_when_something_changed(farm, monkeypatch):
    distort(farm, "OPENCV")
    first = read(Data(farm)).train[0]
    monkeypatch.setattr(undistort, "save_picture", None)  # making one again would fail
    assert read(Data(farm)).train[0].path == first.path
    monkeypatch.undo()
    assert read(Data(farm, scale=2)).train[0].path != first.path
    path = farm / "images" / first.name
    pixels = 255 - np.asarray(Image.open(path))
    Image.fromarray(pixels).save(path)
    again = read(Data(farm)).train[0]
    assert again.path != first.path and (view_photo(again).float() + view_photo(first).float() - 255).abs().max() <= 2
    assert not [p for p in (farm / "undistorted").iterdir() if p.name.startswith(".")]


def test_what_a_lens_does_not_show_is_masked(farm):
    (farm / "sparse/0/cameras.txt").write_text("1 OPENCV 64 48 58 57 31 24 0.9 0 0 0\n")
    scene = read(Data(farm))
    view = scene.train[0]
    if view.mask is not None:
        from surfkit.io.datasets.masks import read_mask

        keep = read_mask(view.mask.path, (view.camera.width, view.camera.height))
        assert (view_photo(view)[:, ~keep] == 0).all()


def test_a_lens_without_distortion_is_left_alone(farm):
    (farm / "sparse/0/cameras.txt").write_text("1 OPENCV 64 48 58 57 31 24 0 0 0 0\n")
    view = read(Data(farm)).train[0]
    assert view.path == farm / "images" / view.name and (view.camera.fx, view.camera.cx) == (58, 31)
    assert torch.equal(view_photo(view), read_photo(view.path, (64, 48)))


def test_a_folder_that_cannot_be_written_uses_the_cache_of_the_user(farm, monkeypatch, tmp_path):
    distort(farm, "RADIAL")
    monkeypatch.setattr(copies.os, "access", lambda path, mode: False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("SURFKIT_CACHE")
    view = read(Data(farm)).train[0]
    assert view.path.parent == tmp_path / "cache" / "surfkit" / "undistorted" and view.path.exists()


def test_layouts_by_name(farm):
    assert len(read(Data(farm, layout="colmap")).train) == 4
    with pytest.raises(BadInput, match="no Reader .*'colmpa'; .*'colmap'"):
        read(Data(farm, layout="colmpa"))
