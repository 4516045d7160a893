from types import SimpleNamespace

import pytest
from PIL import Image

from surfkit.io.datasets.photo_cameras import cameras_of
from surfkit.io.datasets.raw_dataset import RawImage

MAKE, MODEL, FOCAL, SERIAL, EXIF_PART = 0x010F, 0x0110, 0x920A, 0xA431, 0x8769
ONE, OTHER = SimpleNamespace(), SimpleNamespace()


@pytest.fixture
def shot(tmp_path):
    """A function that writes a photograph with some EXIF, and gives it with its camera in the data set."""

    def write(name, camera=ONE, basic=None, more=None):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        exif = Image.Exif()
        exif.update(basic or {})
        if more:
            exif.get_ifd(EXIF_PART).update(more)
        Image.new("RGB", (8, 6)).save(path, exif=exif)
        return RawImage(name, None, camera, path)

    return write


def test_exif_tells_cameras_apart(shot):
    dji = {MAKE: "DJI\0", MODEL: "FC6310"}
    shots = [
        shot("a/1.jpg", ONE, dji, {FOCAL: 8.8, SERIAL: "007"}),
        shot("b/1.jpg", OTHER, dji, {FOCAL: 8.8, SERIAL: "007"}),
        shot("a/2.jpg", ONE, dji, {FOCAL: 8.8, SERIAL: "008"}),
        shot("a/3.jpg", ONE, dji, {FOCAL: 24.0, SERIAL: "007"}),
        shot("a/4.jpg", ONE, dji),
        shot("b/4.jpg", ONE, dji),
        shot("5.jpg", ONE, {MODEL: "X"}),
    ]
    names = cameras_of(shots)
    assert names[0] == names[1] == "DJI FC6310 007 8.8 mm" and len(set(names[1:])) == 6
    assert names[4:] == ["DJI FC6310 in a/", "DJI FC6310 in b/", "X"]


def test_folders_that_a_camera_numbers_are_of_one_camera(shot):
    """It begins a new one when one is full; those of two cards lie in folders of their own."""
    dji = {MAKE: "DJI", MODEL: "FC6310"}
    names = ["100MEDIA/1.jpg", "101MEDIA/1.jpg", "east/100MEDIA/1.jpg", "east/101_0002/1.jpg", "1000MEDIA/1.jpg"]
    assert cameras_of([shot(name, ONE, dji) for name in names]) == [
        *["DJI FC6310"] * 2,
        *["DJI FC6310 in east/"] * 2,
        "DJI FC6310 in 1000MEDIA/",
    ]


def test_without_exif_the_data_set_does(shot):
    shots = [
        shot("1.png"),
        shot("2.png"),
        shot("3.png", OTHER),
        shot("north\\4.png", OTHER),
        shot("north/5.png", OTHER),
    ]
    assert cameras_of(shots) == ["camera 1", "camera 1", "camera 2", *["camera 2 in north/"] * 2]


def test_a_camera_for_each_photograph_is_none_of_its_own(shot):
    shots = [shot(f"{folder}/{i}.png", SimpleNamespace()) for folder in "ab" for i in range(3)]
    assert cameras_of(shots) == ["in a/"] * 3 + ["in b/"] * 3
    assert cameras_of(shots[:1]) == ["camera 1 in a/"]


def test_damaged_exif_counts_as_none(shot, tmp_path):
    one = shot("1.jpg", ONE, {MAKE: "DJI", MODEL: "FC6310"}, {FOCAL: 8.8})
    raw = one.path.read_bytes()
    at = raw.index(b"Exif\0\0") + 6
    one.path.write_bytes(raw[:at] + b"\0" * 40 + raw[at + 40 :])
    assert cameras_of([one]) == ["camera 1"]
