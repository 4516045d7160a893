"""Paths against geometry, cameras of files against their formats, frames that go on, videos read back."""

import json
import math
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from needs import needs
from PIL import Image

from surfkit.apps.render.frame_files import FRAMES_RECORD, draw_frames, identity, shown
from surfkit.apps.render.path import flyover, from_file, lens_of, middle_of, orbit, posed, through
from surfkit.apps.render.video import write_video
from surfkit.cli import main
from surfkit.core.check import BadInput, Fault
from surfkit.io.splats.cameras import write_cameras
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, Scene, SparsePoints, View

UP = np.array([0.0, 0.0, 1.0])
LENS = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 32.0, 24.0, 64, 48)


def nadir(at, tilt=0.0):
    """A camera that looks down, its picture's upper edge to the north, tilted to the north by radians."""
    c, s = math.cos(tilt), math.sin(tilt)
    return posed(LENS, np.array(at, float), np.array([[1, 0, 0], [0, -c, -s], [0, s, -c]], float))


def survey(height=3.0, points=True, frame=None):
    """Eight by three photographs over the ground about (0.2, 0.1, 0)."""
    views = [
        View(f"{i}{j}.jpg", nadir([i - 3.5, j - 1.0, height], 0.3 * (-1) ** (i + j)), Path())
        for i in range(8)
        for j in range(3)
    ]
    xyz = (
        torch.tensor([[0.2, 0.1, 0.0]]).repeat(9 if points else 0, 1)
        + torch.linspace(-1, 1, 9 if points else 0)[:, None]
    )
    return Scene("survey", tuple(views), (), SparsePoints(xyz, xyz.to(torch.uint8)), frame or Frame(np.zeros(3), 1.0))


def axis(camera):
    return camera.world_to_camera[2, :3].numpy()


def test_an_orbit_looks_at_the_middle_from_all_sides():
    cameras = orbit(survey(), LENS, 12).cameras
    centres = np.stack([camera.centre.numpy() for camera in cameras])
    assert np.allclose(centres[:, 2], 3.0) and np.allclose(centres.mean(0), [0.2, 0.1, 3.0])
    assert np.allclose(np.linalg.norm(centres[:, :2] - [0.2, 0.1], axis=1), 3.0), (
        "the height: it is more than the spread"
    )
    for camera in cameras:
        x, y, z = camera.project(torch.tensor([[0.2, 0.1, 0.0]]))[0].tolist()
        assert (x, y) == pytest.approx((32, 24)) and z == pytest.approx(3 * 2**0.5)
        above = camera.project(torch.tensor([[0.2, 0.1, 0.5]]))[0]
        assert above[0] == pytest.approx(32) and above[1] < 24, "held level, the right way up"
        assert torch.linalg.det(camera.world_to_camera) == pytest.approx(1)
    turns = np.diff(np.unwrap(np.arctan2(*(centres[:, 1::-1] - [0.1, 0.2]).T)))
    assert np.allclose(np.abs(turns), 2 * math.pi / 12)


def test_a_flight_over_the_scene():
    cameras = flyover(survey(), LENS, 5).cameras
    centres = np.stack([camera.centre.numpy() for camera in cameras])
    seen = centres + 3 * 2**0.5 * np.stack([axis(camera) for camera in cameras])
    assert np.allclose(seen[:, 2], 0, atol=1e-9) and np.allclose(centres[:, 2], 3)
    assert np.allclose(np.diff(seen[:, 0]), np.diff(seen[:, 0])[0]) and (np.diff(seen[:, 0]) > 1).all()
    assert seen[0, 0] < -2.9 and seen[-1, 0] > 2.9 and np.allclose(seen[:, 1], 0, atol=1e-6)
    level = [axis(camera) for camera in flyover(survey(height=0.1), LENS, 3).cameras]
    assert np.allclose(level, [[1, 0, 0]] * 3, atol=1e-6), "on the ground it looks ahead"


def test_without_points_the_middle_is_what_the_cameras_look_at():
    target = np.array([0.5, -0.2, 0.3])
    views = []
    for angle in (0.0, 1.0, 2.5, 4.0):
        at = target + 2 * np.array([math.cos(angle), math.sin(angle), 0.7])
        ahead = (target - at) / np.linalg.norm(target - at)
        right = np.cross(ahead, UP) / np.linalg.norm(np.cross(ahead, UP))
        views.append(View(f"{angle}", posed(LENS, at, np.stack([right, np.cross(ahead, right), ahead])), Path()))
    empty = replace(survey(points=False), train=tuple(views))
    assert np.allclose(middle_of(empty), target)


def test_cameras_that_stand_in_one_place():
    scene = survey()
    one = replace(scene, train=scene.train[:1] * 3)
    with pytest.raises(BadInput, match="--path flyover: .*one place"):
        flyover(one, LENS, 4)


def test_a_smooth_path_goes_through_its_cameras():
    keys = [nadir([0, 0, 2]), nadir([1, 0.5, 2], 0.4), nadir([3, 0, 2.5], -0.2), nadir([3, 0, 2.5], 0.3)]
    cameras = through(keys, LENS, 601).cameras
    for key in (keys[0], keys[-1]):
        apart = [float((camera.world_to_camera - key.world_to_camera).abs().max()) for camera in cameras]
        assert min(apart) < 1e-9
    for key in keys[1:-1]:
        assert min(float((camera.world_to_camera - key.world_to_camera).abs().max()) for camera in cameras) < 0.02
    steps = np.linalg.norm(np.diff([camera.centre.numpy() for camera in cameras], axis=0), axis=1)
    assert steps.max() < 0.05, "no jumps"
    assert len({id(camera) for camera in through(keys[:1], LENS, 5).cameras}) <= 5
    assert torch.equal(through(keys[:1], LENS, 5).cameras[3].world_to_camera, keys[0].world_to_camera)


def test_cameras_json_is_a_path_in_the_frame_of_the_data_set(tmp_path):
    frame = Frame(np.array([500_000.0, 5_000_000.0, 100.0]), 0.01, shift=(500_000.0, 5_000_000.0, 0.0))
    scene = survey(frame=frame)
    write_cameras(tmp_path / "cameras.json", scene)
    found = from_file(tmp_path / "cameras.json", scene.frame, LENS, 2).cameras
    for at, view in ((0, scene.train[0]), (-1, scene.train[-1])):
        assert torch.allclose(found[at].world_to_camera, view.camera.world_to_camera, atol=1e-6)


def test_a_camera_path_of_nerfstudio(tmp_path):
    frame = Frame(np.array([10.0, 20.0, 30.0]), 0.5)
    pose = np.eye(4)  # looks along -z with y up
    pose[:3, 3] = [12, 20, 34]
    row = {"camera_to_world": pose.flatten().tolist(), "fov": 90.0, "aspect": 1.3}
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"camera_path": [row, row, row], "fps": 12, "render_width": 1}))
    flight = from_file(path, frame, LENS, 99)
    assert len(flight.cameras) == 3 and flight.fps == 12
    camera = flight.cameras[1]
    assert (
        np.allclose(camera.centre, [1, 0, 2])
        and np.allclose(axis(camera), [0, 0, -1])
        and camera.fy == pytest.approx(24)
    )
    # a point ahead, to the right and above is drawn to the right and above
    x, y, z = camera.project(torch.tensor([[1.5, 0.25, 1.0]]))[0].tolist()
    assert (x, y, z) == pytest.approx((32 + 24 * 0.5, 24 - 24 * 0.25, 1.0))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ("[]", "no cameras in it"),
        ('{"camera_path": []}', "no cameras in it"),
        ('[{"position": [0, 0, 1]}]', "camera 0: rotation .* 3 x 3"),
        ('[{"position": [0, 0, "a"], "rotation": [[1,0,0],[0,1,0],[0,0,1]]}]', "camera 0: position must be 3 finite"),
        ('[{"position": [0, 0, 1], "rotation": [[1,0,0],[0,1,0],[0,0,-1]]}]', "camera 0: its rotation is no rotation"),
        ('[{"position": [0, 0, 1], "rotation": [[2,0,0],[0,2,0],[0,0,2]]}]', "camera 0: its rotation is no rotation"),
        ('{"camera_path": [{"camera_to_world": [1, 2]}]}', "camera 0: camera_to_world .*16"),
        ('{"camera_path": [3]}', "camera 0: camera_to_world .*16"),
    ],
)
def test_damaged_paths_are_one_line(tmp_path, data, said):
    (tmp_path / "path.json").write_text(data)
    with pytest.raises(BadInput, match=said):
        from_file(tmp_path / "path.json", survey().frame, LENS, 3)


def test_a_field_of_view_that_cannot_be(tmp_path):
    row = {"camera_to_world": np.eye(4).flatten().tolist(), "fov": 180}
    (tmp_path / "path.json").write_text(json.dumps({"camera_path": [row]}))
    with pytest.raises(BadInput, match="fov is 180; .*0 .*180"):
        from_file(tmp_path / "path.json", survey().frame, LENS, 3)


def test_the_lens_is_that_of_training():
    scene = survey()
    plain = lens_of(scene, None)
    assert (plain.fx, plain.cx, plain.width, plain.height) == (60, 32, 64, 48)
    wide = lens_of(scene, (128, 32))
    assert (wide.fx, wide.fy, wide.cx, wide.cy, wide.width, wide.height) == (120, 120, 64, 16, 128, 32)


class Drawing:
    """Draws a plain picture with the height of the camera, and counts."""

    def __init__(self):
        self.drawn = []

    def __call__(self, view):
        camera = view.camera
        self.drawn.append(float(camera.centre[0]))
        color = torch.full((3, camera.height, camera.width), float(camera.centre[0]) / 10)
        return Maps(color=color, alpha=color[0], depth=color[0] * 2, median=color[0] + 1)


def test_frames_go_on_where_they_stopped(tmp_path, warned):
    cameras, folder, drawing = [nadir([x, 0, 1]) for x in range(6)], tmp_path / "frames", Drawing()
    folder.mkdir()
    paths = draw_frames(folder, cameras, drawing, "color", "model")
    assert drawing.drawn == [0, 1, 2, 3, 4, 5] and [path.name for path in paths][-1] == "000005.png"
    assert np.asarray(Image.open(paths[4])).shape == (48, 64, 3) and np.asarray(Image.open(paths[4]))[0, 0, 0] == 102
    paths[2].unlink()
    again = Drawing()
    assert draw_frames(folder, cameras, again, "color", "model") == paths and again.drawn == [2]
    for other in (
        {"of": "other"},
        {"show": "depth"},
        {"cameras": cameras[:5]},
        {"cameras": [replace(camera, fx=61.0) for camera in cameras]},
    ):
        given = {"cameras": cameras, "show": "color", "of": "model"} | other
        with pytest.raises(BadInput, match="another model, path or size"):
            draw_frames(folder, draw=Drawing(), **given)
    anew = Drawing()
    draw_frames(folder, cameras[:5], anew, "color", "model", replace=True)
    assert len(anew.drawn) == 5 and len(list(folder.glob("*.png"))) == 5 and "are replaced" in warned[0]


def test_a_folder_of_other_things_is_left_alone(tmp_path):
    (tmp_path / "000000.png").write_bytes(b"mine")
    for replace_frames in (False, True):
        with pytest.raises(BadInput, match=f"no {FRAMES_RECORD}"):
            draw_frames(tmp_path, [LENS], Drawing(), "color", "model", replace_frames)
    assert (tmp_path / "000000.png").read_bytes() == b"mine"


def test_depth_has_the_same_colours_in_all_frames(tmp_path):
    tmp_path = tmp_path / "f"
    tmp_path.mkdir()

    def draw(view):
        near = torch.linspace(1, 3, 64).repeat(48, 1) + view.camera.centre[0].float()
        return Maps(color=torch.zeros(3, 48, 64), median=near)

    paths = draw_frames(tmp_path, [nadir([x, 0, 1]) for x in (0.0, 0.0, 0.5)], draw, "depth", "m")
    first, _, last = (np.asarray(Image.open(path)).astype(int) for path in paths)
    shift = round(0.5 / (2 / 63))  # pixels by which the same depth lies further to the left
    assert np.abs(first[10, shift + 5 : 60] - last[10, 5 : 60 - shift]).max() <= 8
    with pytest.raises(BadInput, match="draws no normals"):
        shown(Maps(color=torch.zeros(3, 2, 2)), "normal", None)
    with pytest.raises(BadInput, match="draws no depth"):
        shown(Maps(color=torch.zeros(3, 2, 2)), "depth", None)


@pytest.mark.parametrize("ending", ["mp4", "webm"])
def test_a_video_shows_its_frames(tmp_path, ending):
    cv2 = needs("cv2")
    paths = []
    for at in range(12):
        picture = np.zeros((48, 64, 3), np.uint8)
        picture[:, : 5 * at + 5] = [200, 40, 90]
        paths.append(tmp_path / f"{at:06d}.png")
        Image.fromarray(picture).save(paths[-1])
    out = tmp_path / f"film.{ending}"
    write_video(out, paths, 12.0)
    video = cv2.VideoCapture(str(out))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(12) and int(video.get(cv2.CAP_PROP_FOURCC)) != 0
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1][..., ::-1].astype(int))
    assert len(frames) == 12 and frames[0].shape == (48, 64, 3)
    assert np.abs(frames[6][24, 10] - [200, 40, 90]).max() < 24 and frames[6][24, 50].max() < 24
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*(path.name for path in paths), out.name])


def test_the_command(trained, tmp_path, capsys):
    run = trained
    out = tmp_path / "pictures"
    words = ["render", str(run), "--seconds", "0.2", "--fps", "10", "--size", "40x30", "--out", str(out)]
    assert main([*words, "--path", "flyover"]) == 0
    assert "2, 0.2 s at 10 per second" in capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == ["000000.png", "000001.png", FRAMES_RECORD]
    assert Image.open(out / "000001.png").size == (40, 30) and np.asarray(Image.open(out / "000000.png")).std() > 5
    before = (out / "000000.png").stat().st_mtime_ns
    assert main([*words, "--path", "flyover"]) == 0 and (out / "000000.png").stat().st_mtime_ns == before
    assert main([*words, "--path", "orbit"]) == 2
    assert "frames of another model, path or size" in capsys.readouterr().err
    needs("cv2")
    assert main([*words[:-2], "--path", str(run / "cameras.json"), "--out", str(tmp_path / "a.webm")]) == 0
    assert (tmp_path / "a.webm").stat().st_size > 100 and not (tmp_path / "a.webm.frames").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--path", "spiral"], "--path spiral: no such file; give orbit, flyover or a JSON file"),
        (["--size", "40"], "--size 40: give width and height such as 1920x1080"),
        (["--size", "4x99999"], "of 16 to 16384 pixels"),
        (["--seconds", "0"], "--seconds 0: give more than 0"),
        (["--seconds", "1e6", "--fps", "1000"], "at most 1000000 are drawn"),
        (["--out", "a.avi"], "--out a.avi: give a video, .mp4 or .webm, or a folder"),
    ],
)
def test_words_that_cannot_be(tmp_path, capsys, words, said):
    assert main(["render", str(tmp_path), *words]) == 2
    assert said in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_models_are_told_apart(tmp_path):
    for name in ("run.json", "point_cloud.ply", "compressed/model.surfkit"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("a")
    whole, packed = identity(tmp_path, False), identity(tmp_path, True)
    assert whole != packed
    (tmp_path / "compressed" / "model.surfkit").write_text("another")
    assert identity(tmp_path, False) == whole and identity(tmp_path, True) != packed
    (tmp_path / "run.json").write_text("another")
    assert identity(tmp_path, False) != whole, "trained again"
    file = tmp_path / "point_cloud.ply"
    before = identity(file)
    file.write_text("another")
    assert identity(file) != before


def test_no_run(tmp_path, capsys):
    assert main(["render", str(tmp_path), "--out", str(tmp_path / "f")]) == 2
    assert str(tmp_path) in capsys.readouterr().err and not (tmp_path / "f").exists()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A small run."""
    from surfkit.testing.synthetic import Flight, photograph, write_colmap

    folder = tmp_path_factory.mktemp("render")
    write_colmap(folder / "scene", photograph(Flight()))
    words = ["train", "recipe:2dgs", "mesh:none", "--data", str(folder / "scene"), "--out", str(folder / "run")]
    assert main([*words, "--steps", "10", "--device", "cpu"]) == 0
    shutil.rmtree(folder / "run" / "progress", ignore_errors=True)
    return folder / "run"


@pytest.mark.parametrize("ending", [".mp4", ".webm"])
def test_a_video_that_finds_no_room_is_not_there(tmp_path, ending):
    """OpenCV says nothing; the frames stay, and the same command makes the video from them."""
    needs("cv2")
    noise = np.random.default_rng(0)
    paths = [tmp_path / f"{at}.png" for at in range(12)]
    for path in paths:
        Image.fromarray(noise.integers(0, 255, (48, 64, 3), np.uint8)).save(path)
    known = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, known[1]))
    try:
        with pytest.raises(Fault, match="could not be written to its end"):
            write_video(tmp_path / f"cut{ending}", paths, 12.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, known)
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    write_video(tmp_path / f"whole{ending}", paths, 12.0)
    assert (tmp_path / f"whole{ending}").stat().st_size > 8_000
