"""EXIF as cameras and drones write it, in files that Pillow reads back."""

import math

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from surfkit.sfm import exif
from surfkit.sfm.exif import Exif, facts, read_exif
from surfkit.testing.exif import write_exif

DJI = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description drone-dji:GpsLatitude="+52.1" drone-dji:RtkFlag="50"
 drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.011" drone-dji:RtkStdHgt="0.025"/></x:xmpmeta>"""
PIX4D = "<Camera:GPSXYAccuracy>1.5</Camera:GPSXYAccuracy><Camera:GPSZAccuracy>3</Camera:GPSZAccuracy>"


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "a.jpg"
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(path)
    return path


def read(path):
    with Image.open(path) as image:
        return read_exif(image, image.size)


@pytest.mark.parametrize("position", [(52.7512345678, 16.87, 120.25), (-33.9, -70.6501, -12.5), (0.0, 179.999999, 0.0)])
def test_positions_come_back(photo, position):
    write_exif(photo, position)
    assert read(photo).position == pytest.approx(position, abs=1e-9)


def test_a_photograph_that_says_nothing(photo):
    assert read(photo) == Exif()


def test_camera_time_and_orientation(photo):
    basic = {exif.MAKE: "DJI\0", exif.MODEL: "FC6310", exif.ORIENTATION: 6}
    write_exif(photo, basic=basic, camera={exif.TAKEN: "2024:05:01 12:00:00", exif.SUBSECOND: "25"})
    found = read(photo)
    assert (found.camera, found.taken, found.orientation) == ("DJI FC6310", "2024:05:01 12:00:00.25", 6)


def test_focal_lengths():
    size = (5472, 3648)
    diagonal = facts({}, {exif.FOCAL35_MM: 24}, {}, {}, size).focal_px
    assert diagonal == pytest.approx(24 / 36 * 5472, rel=1e-3)  # 3:2 as film is, so width and diagonal agree
    plane = {exif.FOCAL_MM: IFDRational(88, 10), exif.PIXELS_X: 5472, exif.PER_UNIT_X: 5472 / 13.2, exif.UNIT: 3}
    assert facts({}, plane | {exif.PER_UNIT_X: 5472 / 1.32}, {}, {}, size).focal_px == pytest.approx(8.8 / 13.2 * 5472)
    half = facts({}, plane | {exif.PER_UNIT_X: 5472 / 1.32}, {}, {}, (2736, 1824)).focal_px
    assert half == pytest.approx(8.8 / 13.2 * 2736)  # reduced by a program that kept EXIF
    assert facts({}, {exif.FOCAL_MM: 8.8}, {}, {}, size).focal_px is None
    dpi = {exif.FOCAL_MM: 8.8, exif.PIXELS_X: 5472, exif.PER_UNIT_X: 72, exif.UNIT: 2}
    for wrong in ({exif.FOCAL35_MM: 65535}, {exif.FOCAL35_MM: 1}, dpi):
        assert facts({}, wrong, {}, {}, size).focal_px is None, "a wrong one would be held to"


@pytest.mark.parametrize(
    "xmp, found",
    [
        (DJI, (0.012, 0.011, 0.025)),
        (PIX4D, (1.5, 1.5, 3.0)),
        ('drone-dji:RtkStdLon="0"', None),
        ("<", None),
        (PIX4D.replace("1.5", "150/100"), None),  # a fraction is no 150 m
        (None, None),
    ],
)
def test_accuracies(xmp, found):
    assert facts({}, {}, {}, exif._xmp(xmp and xmp.encode()), (40, 30)).accuracy_m == found
    assert facts({}, {}, {exif.ERROR_M: 4.0}, {}, (40, 30)).accuracy_m == (4, 4, 8)


@pytest.mark.parametrize("south, below, height", [("S", b"\x03", -12.5), ("South", b"\x02", 12.5), ("s", 1, -12.5)])
def test_halves_of_the_earth_and_heights_below_either_zero(south, below, height):
    gps = {exif.LATITUDE_REF: south, exif.LATITUDE: (33, 30, 0), exif.LONGITUDE_REF: "W", exif.LONGITUDE: (70, 0, 0)}
    found = facts({}, {}, gps | {exif.ALTITUDE_REF: below, exif.ALTITUDE: 12.5}, {}, (40, 30)).position
    assert found == (-33.5, -70, height)


def test_which_of_several_equal_cameras_it_is():
    basic = {exif.MAKE: "MicaSense", exif.MODEL: "RedEdge", exif.ORIENTATION: IFDRational(6)}
    rig = exif._xmp("<Camera:RigCameraIndex>2</Camera:RigCameraIndex>")
    found = facts(basic, {exif.BODY: "RX01-17"}, {}, rig, (40, 30))
    assert found.which == "MicaSense RedEdge RX01-17 2.0" and found.camera == "MicaSense RedEdge"
    assert facts(basic, {}, {}, {}, (40, 30)).which == "MicaSense RedEdge"
    assert type(found.orientation) is int and found.orientation == 6, "it is kept as a whole number"


@pytest.mark.parametrize(
    "gps",
    [
        {exif.LATITUDE: (0, 0, 0), exif.LONGITUDE: (0, 0, 0), exif.ALTITUDE: 0},  # a receiver without a fix
        {exif.LATITUDE: (91, 0, 0), exif.LONGITUDE: (10, 0, 0), exif.ALTITUDE: 1},
        {exif.LATITUDE: (52, 0, math.nan), exif.LONGITUDE: (10, 0, 0), exif.ALTITUDE: 1},
        {exif.LATITUDE: 52, exif.LONGITUDE: "x", exif.ALTITUDE: 1},
        {exif.LATITUDE: (52, 0, 0), exif.LONGITUDE: (10, 0, 0)},
        {exif.LATITUDE: (52, 0, IFDRational(1, 0)), exif.LONGITUDE: (10, 0, 0), exif.ALTITUDE: 1},
    ],
)
def test_what_is_no_position(gps):
    assert facts({}, {}, gps, {}, (40, 30)).position is None


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")  # as the module does, outside pytest
def test_damaged_exif_counts_as_not_said(photo):
    whole = photo.read_bytes()
    photo.write_bytes(whole[:2] + b"\xff\xe1\x00\x12Exif\0\0II*\0\xff\xff\xff\x7f\0\0" + whole[2:])
    assert read(photo) == Exif()
