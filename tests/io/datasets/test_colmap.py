"""COLMAP folders: every layout, the frame, the split, and one clear line for everything that can be wrong."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.datasets import colmap
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.io.datasets.sparse_points import RANDOM_POINTS
from surfkit.runs.run_notes import collect_notes
from surfkit.testing.synthetic import Flight, photograph, write_colmap

BORUSZYN = Path(__file__).parents[3] / "examples" / "boruszyn"
FLIGHT = Flight(views=5, width=40, height=30, points=60)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A text model in sparse/0, never changed, and the truth about it."""
    folder = tmp_path_factory.mktemp("made") / "farm"
    truth = photograph(FLIGHT)
    write_colmap(folder, truth)
    return folder, truth


@pytest.fixture
def farm(made, tmp_path):
    """A copy to damage."""
    return Path(shutil.copytree(made[0], tmp_path / "farm"))


def edit(path, change):
    path.write_text(change(path.read_text()))


def names(views):
    return [view.name for view in views]


def same(a, b):
    assert names(a.train) == names(b.train) and names(a.held_out) == names(b.held_out)
    for one, other in zip((*a.train, *a.held_out), (*b.train, *b.held_out), strict=True):
        torch.testing.assert_close(one.camera.world_to_camera, other.camera.world_to_camera, rtol=0, atol=1e-12)
        assert replace(one.camera, world_to_camera=0) == replace(other.camera, world_to_camera=0)
    torch.testing.assert_close(a.cloud.xyz, b.cloud.xyz, rtol=0, atol=1e-6)
    assert torch.equal(a.cloud.rgb, b.cloud.rgb)
    np.testing.assert_allclose(a.frame.origin, b.frame.origin, atol=1e-9)
    assert a.frame.scale == pytest.approx(b.frame.scale, rel=1e-12)


def test_what_was_written_is_read(made):
    folder, truth = made
    scene = read(Data(folder))
    same(scene, truth.scene)
    assert scene.name == "farm" and scene.train[0].path == folder / "images" / "view_001.png"


@pytest.mark.parametrize("place", colmap.MODEL_FOLDERS)
@pytest.mark.parametrize("binary", [False, True])
def test_layouts_in_text_and_binary(made, tmp_path, place, binary):
    folder, truth = made
    shutil.copytree(folder / "images", tmp_path / "images")
    write_colmap(tmp_path / "model", truth, binary)
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "model" / "sparse" / "0").rename(tmp_path / place)
    same(read(Data(tmp_path)), truth.scene)


def test_nested_images_and_another_folder_of_images(farm):
    (farm / "images" / "left").mkdir()
    (farm / "images" / "view_003.png").rename(farm / "images" / "left" / "view_003.png")
    edit(farm / "sparse/0/images.txt", lambda text: text.replace(" view_003", " left/view_003"))
    (farm / "images").rename(farm / "photos")
    scene = read(Data(farm, images=Path("photos"), test_every=0))
    assert names(scene.train) == ["left/view_003.png", *(f"view_00{i}.png" for i in (0, 1, 2, 4))]
    assert scene.train[0].path == farm / "photos" / "left" / "view_003.png"


def test_points_project_where_the_input_says(made):
    """The frame moves cameras and points together, and the principal point is not the centre of the image."""
    folder, truth = made
    scene = read(Data(folder))
    text = (folder / "sparse/0/images.txt").read_text().split("\n")[0].split()
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat([float(text[i]) for i in (2, 3, 4, 1)]).as_matrix()
    fx, fy, cx, cy = map(float, (folder / "sparse/0/cameras.txt").read_text().split()[4:])
    assert abs(cx - 20) > 1 and abs(cy - 15) > 0.5
    xyz = np.loadtxt(folder / "sparse/0/points3D.txt")[:, 1:4]
    eye = xyz @ rotation.T + [float(value) for value in text[5:8]]
    expected = eye[:, :2] / eye[:, 2:] * [fx, fy] + [cx, cy]

    camera = scene.held_out[0].camera
    pose = camera.world_to_camera.numpy()
    local = scene.cloud.xyz.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
    got = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    np.testing.assert_allclose(got, expected, atol=1e-4)
    np.testing.assert_allclose(local[:, 2], eye[:, 2] * scene.frame.scale, atol=1e-6)


def test_the_frame_is_that_of_the_training_cameras(made):
    scene = read(Data(made[0]))
    centres = torch.stack([view.camera.centre for view in scene.train])
    torch.testing.assert_close(centres.mean(0), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)
    assert centres.norm(dim=1).max().item() == pytest.approx(1 / 1.1)
    assert read(Data(made[0], test_every=0)).frame.scale != scene.frame.scale


def test_the_frame_goes_there_and_back_far_from_the_origin(made):
    frame = replace(read(Data(made[0])).frame, origin=np.array([340_622.0, 5_548_143.0, 71.0]))
    local = np.random.default_rng(0).normal(size=(50, 3))
    np.testing.assert_allclose(frame.to_local(frame.to_input(local)), local, atol=1e-9)
    pose = read(Data(made[0])).train[0].camera.world_to_camera
    torch.testing.assert_close(frame.local_pose(frame.input_pose(pose)), pose, rtol=0, atol=1e-8)


def test_one_place_takes_the_extent_of_the_points(farm):
    lines = (farm / "sparse/0/images.txt").read_text().splitlines()[:2]
    (farm / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    scene = read(Data(farm, test_every=0))
    assert scene.cloud.xyz.norm(dim=1).median().item() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ({}, (40, 30)),
        ({"scale": 4}, (10, 8)),
        ({"scale": 1.7}, (24, 18)),
        ({"longest": 20}, (20, 15)),
        ({"longest": 4000}, (40, 30)),
        ({"scale": 2, "longest": 10}, (10, 8)),
    ],
)
def test_size(made, settings, size):
    camera = read(Data(made[0], **settings)).train[0].camera
    assert (camera.width, camera.height) == size
    assert camera.fx == pytest.approx(0.9 * 40 * size[0] / 40) and camera.cy == pytest.approx(0.48 * 30 * size[1] / 30)


def test_large_photographs_are_reduced_to_1600_unless_a_scale_is_given():
    assert Data(Path()).size(4000, 3000) == (1600, 1200)
    assert Data(Path()).size(3000, 4000) == (1200, 1600)
    assert Data(Path(), scale=2).size(4000, 3000) == (2000, 1500)


def test_photographs_that_were_resized_keep_the_true_intrinsics(farm):
    for path in (farm / "images").iterdir():
        Image.open(path).resize((27, 20)).save(path)
    camera = read(Data(farm)).train[0].camera
    assert (camera.width, camera.height) == (27, 20)
    assert camera.fx == pytest.approx(0.9 * 40 * 27 / 40) and camera.fy == pytest.approx(0.91 * 40 * 20 / 30)


def test_split_of_the_example():
    scene = read(Data(BORUSZYN))
    everything = sorted(path.name for path in (BORUSZYN / "images").iterdir())
    assert len(everything) == 28
    assert names(scene.held_out) == [everything[i] for i in (0, 8, 16, 24)]
    assert names(scene.train) == [name for name in everything if name not in names(scene.held_out)]
    assert scene.cloud.xyz.shape == (12_000, 3) and scene.cloud.xyz.dtype == torch.float32
    assert scene.frame.scale == pytest.approx(0.00525, abs=1e-5)


def test_split_by_a_list(made, tmp_path):
    listed = tmp_path / "test.txt"
    listed.write_text("view_003.png\n\n  view_001.png \r\n")
    scene = read(Data(made[0], test_list=listed))
    assert names(scene.held_out) == ["view_001.png", "view_003.png"] and len(scene.train) == 3
    assert not read(Data(made[0], test_every=0)).held_out


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"scale": 0.5}, "--scale 0.5"),
        ({"longest": 0}, "--longest 0"),
        ({"test_every": -1}, "--test-every -1"),
        ({"test_every": 1}, "--test-every 1 holds out all 5 photographs"),
        ({"test_list": "view_003.jpg"}, "no photograph 'view_003.jpg' in the model; did you mean 'view_003.png'?"),
        ({"test_list": "\n"}, "names no photograph"),
        ({"test_list": None}, "cannot be read as text: No such file"),
        ({"images": Path("photos")}, "photos: no such folder of photographs"),
    ],
)
def test_wrong_settings(made, tmp_path, settings, text):
    if "test_list" in settings:
        path = tmp_path / "list.txt"
        if settings["test_list"]:
            path.write_text(settings["test_list"])
        settings = {"test_list": path}
    complaint(text, lambda: read(Data(made[0], **settings)))


def test_the_only_photograph_is_not_held_out_unasked():
    alone = SimpleNamespace(shots=[SimpleNamespace(name="a.jpg")], held_out=None)
    complaint("--test-every 8 holds out the only photograph; use --test-every 0", lambda: Data(Path()).held_out(alone))


def complaint(text, do):
    """BadInput of one line that contains `text`."""
    with pytest.raises(BadInput) as error:
        do()
    assert text in str(error.value) and "\n" not in str(error.value), str(error.value)


def panorama(farm):
    edit(farm / "sparse/0/cameras.txt", lambda _: "7 EQUIRECTANGULAR 40 30 40 30\n")
    edit(farm / "sparse/0/images.txt", lambda text: text.replace(" 1 view", " 7 view"))


def strange_model(farm):
    edit(farm / "sparse/0/cameras.txt", lambda text: text.replace("PINHOLE", "HOLEPIN"))


def no_images(farm):
    shutil.rmtree(farm / "images")


def no_model(farm):
    shutil.rmtree(farm / "sparse")


def half_a_model(farm):
    (farm / "sparse/0/points3D.txt").unlink()


def missing(farm):
    (farm / "images/view_002.png").rename(farm / "images/View_002.PNG")
    (farm / "images/view_003.png").unlink()


def other_size(farm):
    Image.new("RGB", (40, 20)).save(farm / "images/view_002.png")


def turned(farm):
    Image.new("RGB", (30, 40)).save(farm / "images/view_002.png")


def no_picture(farm):
    (farm / "images/view_002.png").write_bytes(b"<html>not found</html>")


def no_points(farm):
    (farm / "sparse/0/points3D.txt").write_text("# none\n")


def no_poses(farm):
    (farm / "sparse/0/images.txt").write_text("# none\n")


def bad_text(farm):
    edit(farm / "sparse/0/images.txt", lambda text: text.replace(" 1 view_002", " view_002"))


def no_camera(farm):
    edit(farm / "sparse/0/images.txt", lambda text: text.replace(" 1 view_002", " 3 view_002"))


def no_focal(farm):
    (farm / "sparse/0/cameras.txt").write_text("1 PINHOLE 40 30 0 36 20 15\n")


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (panorama, "view_000.png: 40 x 30 px, a panorama that is not twice as wide as high"),
        (strange_model, "a camera model that COLMAP does not know"),
        (no_images, "images: no such folder of photographs"),
        (no_model, "no COLMAP model (cameras, images, points3D as .bin or .txt) in sparse/0, sparse, colmap/sparse/0"),
        (half_a_model, "the COLMAP model lacks points3D.txt"),
        (
            missing,
            "1 of 5 photographs are missing: 'view_003.png'; put them there, or delete them from the model; --missing",
        ),
        (other_size, "view_002.png: 40 x 20 px, but its camera 1 has 40 x 30"),
        (turned, "view_002.png: 30 x 40 px (turned by 90 degrees), but"),
        (no_picture, "view_002.png: not a whole picture"),
        (no_poses, "the model has no image with a pose"),
        (bad_text, "the COLMAP model is damaged"),
        (no_camera, "the COLMAP model is damaged"),
        (no_focal, "camera 1 of view_000.png has size 40 x 30 and parameters"),
    ],
)
def test_damaged_folders(farm, damage, text):
    damage(farm)
    complaint(text, lambda: read(Data(farm)))


def test_a_model_of_poses_alone_is_read_and_told_to_have_no_points(farm):
    no_points(farm)
    with collect_notes() as kept:
        scene = read(Data(farm))
    assert len(scene.cloud.xyz) == RANDOM_POINTS
    told = f"`surfkit prepare points {farm}` makes a data set"
    assert any("no sparse points" in text and told in text for text in kept.texts)


def test_no_folder(tmp_path):
    complaint("no such folder; a data set is a folder with images/", lambda: read(Data(tmp_path / "nowhere")))
    complaint("the folder is empty; a data set is", lambda: read(Data(tmp_path)))
    (tmp_path / "file").touch()
    complaint("a file, not a folder; a data set is", lambda: read(Data(tmp_path / "file")))


@pytest.mark.parametrize("part", list(colmap.MIN_ENTRY_BYTES))
@pytest.mark.parametrize("keep", [0, 4, 20, 60, -1, -12, -30])
def test_binary_files_that_are_cut_off(made, tmp_path, part, keep):
    """Also within the name of an image, at which pycolmap would read for ever."""
    write_colmap(tmp_path, made[1], binary=True)
    path = tmp_path / "sparse" / "0" / f"{part}.bin"
    raw = path.read_bytes()
    path.write_bytes(raw[: min(keep, len(raw) - 2)])
    complaint(f"{part}.bin: the file is cut off", lambda: read(Data(tmp_path)))


@pytest.mark.parametrize("part", ["images", "points3D"])
@pytest.mark.parametrize("lost", [3, 900, 40_000])
def test_observations_that_are_cut_off(tmp_path, part, lost):
    shutil.copytree(BORUSZYN / "sparse", tmp_path / "sparse")
    path = tmp_path / "sparse" / "0" / f"{part}.bin"
    path.write_bytes(path.read_bytes()[:-lost])
    complaint(f"{part}.bin: the file is cut off", lambda: read(Data(tmp_path)))


def test_points_that_are_not_finite_are_left_out(made, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(colmap, "emit", told.append)
    write_colmap(tmp_path, made[1], binary=True)
    path = tmp_path / "sparse" / "0" / "points3D.bin"
    raw = bytearray(path.read_bytes())
    raw[16:24] = np.float64(np.nan).tobytes()  # x of the first point in the file
    path.write_bytes(raw)
    scene = read(Data(tmp_path))
    assert len(scene.cloud.xyz) == len(scene.cloud.rgb) == FLIGHT.points - 1 and scene.cloud.xyz.isfinite().all()
    assert len(told) == 1 and "1 of 60 points" in told[0].text


def test_a_pose_that_is_not_finite_is_named(made, tmp_path):
    write_colmap(tmp_path, made[1], binary=True)
    model = tmp_path / "sparse" / "0"
    for name in ("rigs.bin", "frames.bin"):  # the classic layout, with the poses in images.bin
        (model / name).unlink(missing_ok=True)
    raw = bytearray((model / "images.bin").read_bytes())
    raw[8 + 4 + 32 : 8 + 4 + 40] = np.float64(np.inf).tobytes()
    (model / "images.bin").write_bytes(raw)
    complaint("is not finite; delete the image from the model", lambda: read(Data(tmp_path)))


def test_simple_pinhole_has_one_focal_length(farm):
    (farm / "sparse/0/cameras.txt").write_text("1 SIMPLE_PINHOLE 40 30 36 21.5 14\n")
    camera = read(Data(farm)).train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (36, 36, 21.5, 14)


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
@pytest.mark.parametrize("gap", [" ", "\t"])
def test_names_with_blanks_in_text_files(farm, ends, gap):
    """The name is the rest of the line."""
    names = {f"view_{at:03d}.png": f"A DJI {at}  map ({at}).png" for at in range(5)}
    for old, new in names.items():
        (farm / "images" / old).rename(farm / "images" / new)
    path = farm / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    for at, line in enumerate(lines):
        if line.endswith(".png"):
            *numbers, name = line.split(" ")
            lines[at] = gap.join([*numbers, names[name]])
    path.write_bytes(ends.join(lines).encode())
    scene = read(Data(farm, test_every=0))
    assert [view.name for view in scene.train] == sorted(names.values())
    assert all(view.path.is_file() for view in scene.train)


def test_missing_photographs_are_skipped_where_that_is_asked_for(farm):
    whole = read(Data(farm, test_every=0))
    (farm / "images/view_003.png").unlink()
    with collect_notes() as kept:
        scene = read(Data(farm, test_every=0, missing="skip"))
    assert [view.name for view in scene.train] == [f"view_00{at}.png" for at in (0, 1, 2, 4)]
    assert any("1 of 5 photographs are missing and are skipped: 'view_003.png'" in note for note in kept.texts)
    far = scene.frame.input_pose(scene.train[3].camera.world_to_camera)
    assert np.allclose(far, whole.frame.input_pose(whole.train[4].camera.world_to_camera), atol=1e-6)
    for path in (farm / "images").iterdir():
        path.unlink()
    complaint("5 of 5 photographs are missing", lambda: read(Data(farm, missing="skip")))


def test_no_photograph_of_the_model_is_proposed_for_a_missing_one(farm):
    (farm / "images/view_003.png").unlink()
    with pytest.raises(BadInput) as caught:
        read(Data(farm))
    assert "did you mean" not in str(caught.value)
    (farm / "images/view_0o3.png").write_bytes((farm / "images/view_001.png").read_bytes())
    complaint("did you mean 'view_0o3.png'?", lambda: read(Data(farm)))
