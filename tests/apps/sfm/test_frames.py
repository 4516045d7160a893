"""Frames of videos that OpenCV writes of a known scene: which are taken, and that the cameras of them are found."""

import json
import struct
import sys
from functools import cache

import numpy as np
import pytest
from needs import needs
from PIL import Image

from surfkit.apps.sfm import video_frames as frames
from surfkit.apps.sfm.video_frames import Track, choose, take_frames
from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import bare_photographs, read
from surfkit.runs.run_notes import collect_notes

from .pictures import HEIGHT, WIDTH, arc, looking, picture, save

cv2 = needs("cv2")
ANGLES = [*np.linspace(0, 0.35, 15), *[0.35] * 20, *np.linspace(0.35, 0.7, 15)]
"""Around the scene, then a rest, then on."""
STILL = range(14, 36)
BLURRED = (3, 4, 9, 40, 41)
QUICK = ("--max-features", "800")


@cache
def shown(angle):
    """(H, W, 3) uint8 of the scene from an angle."""
    return picture(looking((15 * np.cos(angle), 15 * np.sin(angle), 11)))


def film(path, angles=ANGLES, blurred=BLURRED):
    """A video of cameras that look at the scene from these angles."""
    path.parent.mkdir(parents=True, exist_ok=True)
    code = "MJPG" if path.suffix == ".avi" else "mp4v"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 25, (WIDTH, HEIGHT))
    for at, angle in enumerate(angles):
        pixels = np.ascontiguousarray(shown(angle)[..., ::-1])
        writer.write(cv2.GaussianBlur(pixels, (0, 0), 4) if at in blurred else pixels)
    writer.release()
    return path


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return film(tmp_path_factory.mktemp("walk") / "walk.mp4")


def numbers(taken):
    return [int(name.removesuffix(".jpg")) for name in taken.names]


@pytest.mark.parametrize("name", ["walk.mp4", "walk.avi", "walk.MOV", "walk.mkv"])
def test_sharp_frames_are_taken_evenly_and_of_a_rest_only_one(tmp_path, name):
    path = film(tmp_path / name)
    with collect_notes() as notes:
        taken = take_frames(path, tmp_path / "frames", 0.04, 300)
    chosen = numbers(taken)
    assert taken.frames == 50 and 6 <= len(chosen) <= 20 and chosen == sorted(set(chosen))
    assert not set(chosen) & set(BLURRED) and len(set(chosen) & set(STILL)) <= 2
    moved = np.abs(np.diff([ANGLES[at] for at in chosen]))
    assert moved.max() < 2.5 * np.median(moved), "evenly, though the camera rests for half of the time"
    assert notes.texts == [
        f"{path}: {len(chosen)} of 50 frames are taken, one each time that the picture moves by 4% of its width"
    ]
    with Image.open(tmp_path / "frames" / taken.names[0]) as image:
        pixels = np.asarray(image, float)
    assert np.abs(pixels - shown(ANGLES[chosen[0]])).mean() < 6, "the frame of that number"


def test_no_more_frames_are_taken_than_asked_for(walk, tmp_path):
    with collect_notes() as notes:
        taken = take_frames(walk, tmp_path / "f", 0.005, 5)
    assert 3 <= len(taken.names) <= 5 and numbers(taken)[-1] > 36 and taken.step > 0.005
    assert "of 50 frames are taken" in notes.texts[0] and f"by {taken.step:.0%} of its width" in notes.texts[0]


def test_frames_that_are_there_are_not_taken_again(walk, tmp_path, monkeypatch):
    first = take_frames(walk, tmp_path / "f", 0.04, 300)
    (tmp_path / "f" / first.names[2]).unlink()
    seen, plain = [], frames.follow
    monkeypatch.setattr(frames, "follow", lambda *given: seen.append(1) or plain(*given))
    assert take_frames(walk, tmp_path / "f", 0.04, 300) == first and seen == [1], "one was gone"
    assert take_frames(walk, tmp_path / "f", 0.04, 300) == first and seen == [1]
    assert len(take_frames(walk, tmp_path / "f", 0.1, 300).names) < len(first.names) and seen == [1, 1]
    assert len(list((tmp_path / "f").glob("*.jpg"))) < len(first.names), "those of other settings are gone"


def test_a_record_that_names_files_elsewhere_counts_for_nothing(walk, tmp_path):
    first = take_frames(walk, tmp_path / "f", 0.1, 300)
    save(tmp_path / "000000.jpg", shown(0.0))
    record = json.loads((tmp_path / "f/frames.json").read_text())
    (tmp_path / "f/frames.json").write_text(json.dumps(record | {"names": ["../000000.jpg"]}))
    assert take_frames(walk, tmp_path / "f", 0.1, 300) == first


def test_the_sharpest_near_each_step_is_chosen():
    way = np.arange(41) / 40
    sharpness = np.ones(41)
    sharpness[[9, 22, 31]] = 1.2
    sharpness[[10, 20, 30]] = 0.2
    chosen, step = choose(Track(way, sharpness), 0.25, 100)
    assert chosen[:2] == [0, 9] and not {10, 20, 30} & set(chosen) and step == 0.25
    assert choose(Track(np.zeros(30), np.ones(30)), 0.1, 100)[0] == [0]
    fast, _ = choose(Track(np.arange(6.0), np.ones(6)), 0.1, 100)
    assert fast == list(range(6)), "of a picture that moves by its width from frame to frame, all"


def test_a_video_as_it_is_turned_by_its_metadata(walk, tmp_path):
    """The matrix of the track header, as telephones write it that are held upright."""
    data = bytearray(walk.read_bytes())
    at = data.index(b"tkhd") + 4 + 4 + 32 + (12 if data[data.index(b"tkhd") + 4] else 0) + 4
    unit = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    at = data.index(unit)
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, HEIGHT << 16, 0, 1 << 30)
    (tmp_path / "up.mp4").write_bytes(data)
    plain, turned = (take_frames(path, tmp_path / path.stem, 0.04, 300) for path in (walk, tmp_path / "up.mp4"))
    upright = [np.asarray(Image.open(tmp_path / "up" / name), float) for name in turned.names]
    lying = np.asarray(Image.open(tmp_path / "walk" / plain.names[0]), float)
    assert upright[0].shape == (WIDTH, HEIGHT, 3)
    assert np.abs(np.rot90(lying, -1) - upright[0]).mean() < 6


@pytest.mark.parametrize("content", [b"", b"no video at all" * 100])
def test_what_is_no_video(tmp_path, content, capfd):
    (tmp_path / "x.mp4").write_bytes(content)
    assert main(["prepare", "photos", str(tmp_path / "x.mp4"), "--out", str(tmp_path / "s")]) == 2
    said = capfd.readouterr().err.strip().splitlines()[-1]
    assert "x.mp4: OpenCV cannot read it" in said


def test_a_video_that_is_cut_off_is_told(tmp_path):
    whole = film(tmp_path / "a.avi")
    data = whole.read_bytes()
    whole.write_bytes(data[: len(data) // 2])
    with collect_notes() as notes:
        taken = take_frames(whole, tmp_path / "f", 0.04, 300)
    assert taken.frames < 30 and any("cut off or damaged there" in text for text in notes.texts)


def test_cameras_of_a_video_are_found(walk, tmp_path, capsys):
    assert main(["prepare", "photos", str(walk), "--out", str(tmp_path / "s"), "--frame-step", "0.06", *QUICK]) == 0
    said = capsys.readouterr()
    assert "of 50 frames are taken" in said.err
    scene = read(Data(tmp_path / "s"))
    names = [view.name for view in (*scene.train, *scene.held_out)]
    assert len(names) > 5 and all(name.startswith("walk.mp4/0000") for name in names)
    report = json.loads((tmp_path / "s/report.json").read_text())
    assert report["registered"] == report["photographs"] and len(report["models"][0]["cameras"]) == 1
    turned = [view.camera.world_to_camera[2, :3].numpy() for view in (*scene.train, *scene.held_out)]
    swing = np.degrees(np.arccos(min(np.dot(one, two) for one in turned for two in turned)))
    assert 15 < swing < 40, "0.7 rad about the scene, seen from above"
    assert (tmp_path / "s/images/walk.mp4").is_dir() and not list(walk.parent.glob("*/"))


def test_videos_in_a_folder_beside_photographs(walk, tmp_path, capsys):
    for at, pose in enumerate(arc(4)):
        save(tmp_path / "p" / f"IMG_{at}.jpg", picture(pose))
    (tmp_path / "p/day 2").mkdir()
    (tmp_path / "p/day 2/walk.mov").write_bytes(walk.read_bytes())
    (tmp_path / "p/IMG_2.MOV").write_bytes(walk.read_bytes())
    (tmp_path / "p/broken.mp4").write_bytes(b"x")
    words = ["prepare", "photos", str(tmp_path / "p"), "--out", str(tmp_path / "s"), "--frame-step", "0.06", *QUICK]
    assert main(words) == 0
    said = capsys.readouterr().err
    assert "live photos are: 'IMG_2.MOV'" in said
    assert "no frames are taken of 1 videos, 'broken.mp4'" in said
    report = json.loads((tmp_path / "s/report.json").read_text())
    assert report["photographs"] > 6
    lenses = len(report["models"][0]["cameras"])
    assert lenses == 2, "one of the photographs, one of the video"
    assert (tmp_path / "s/images/day 2/walk.mov").is_dir()


def test_without_opencv_one_line_names_the_extra(walk, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert main(["prepare", "photos", str(walk), "--out", str(tmp_path / "s")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "needs the package cv2" in said
    assert "pip install 'surfkit[video]'" in said
    with pytest.raises(BadInput, match="pip install"):
        take_frames(walk, tmp_path / "f", 0.04, 300)


def test_training_on_a_video_says_what_to_do(walk, tmp_path, capsys):
    words = ["train", "recipe:2dgs", "--out", str(tmp_path / "run"), "--data"]
    assert main([*words, str(walk)]) == 2
    assert f"`surfkit prepare photos {walk}`" in capsys.readouterr().err
    assert main([*words, str(walk.parent)]) == 2
    assert f"`surfkit prepare photos {walk.parent}`" in capsys.readouterr().err
    assert bare_photographs(walk) == walk and bare_photographs(walk.parent) == walk.parent
