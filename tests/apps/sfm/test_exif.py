"""EXIF as cameras and drones write it, in files that Pillow reads back."""

import math

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from surfkit.apps.sfm import exif
from surfkit.apps.sfm.exif import Exif, facts, read_exif
from surfkit.apps.sfm.xmp import read_xmp
from surfkit.testing.write_exif import write_exif

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


@pytest.mark.parametrize(
    ("reference", "version", "flag", "zero"),
    [(0, b"0232", None, "sea level"), (1, None, 0, "sea level"), (None, b"0300", None, "sea level")]
    + [(2, b"0300", None, "sea level"), (3, None, 50, "sea level"), (0, b"0300", None, "ellipsoid")]
    + [(1, b"0310", None, "ellipsoid"), (0, None, 50, "ellipsoid"), (0, b"0232", 16, "ellipsoid")],
)
def test_where_altitudes_are_0(reference, version, flag, zero):
    """2 and 3 are sea level. 0 and 1 are it up to EXIF 2.32, and the ellipsoid from 3.0 on (CIPA DC-008); drones with
    RTK write heights above the ellipsoid under the older 0."""
    gps = {exif.ALTITUDE_TAG: 120.0} | ({} if reference is None else {exif.ALTITUDE_REF_TAG: bytes([reference])})
    xmp = {} if flag is None else {"RtkFlag": float(flag)}
    camera = {} if version is None else {36864: version}
    assert facts({}, camera, gps, xmp, (40, 30)).zero == zero
    assert facts({}, {}, {exif.ALTITUDE_REF_TAG: b"\0"}, xmp, (40, 30)).zero is None, "no altitude"


@pytest.mark.parametrize(
    ("said", "zero"),
    [("ellipsoidal", "ellipsoid"), ("EPSG:4979", "ellipsoid"), ("EPSG:5773", "sea level"), ("EGM96", "sea level")]
    + [("of a town", "ellipsoid")],
)
def test_what_pix4d_s_tag_says_of_heights_goes_before_rtk(said, zero):
    for packet in (f"<Camera:VertCS>{said}</Camera:VertCS>", f"<rdf:Description Camera:VertCS='{said}'/>"):
        xmp = read_xmp(packet) | {"RtkFlag": 50.0}
        assert facts({}, {}, {exif.ALTITUDE_TAG: 120.0, exif.ALTITUDE_REF_TAG: b"\0"}, xmp, (40, 30)).zero == zero
        xmp = read_xmp(packet) | {"altitude": 120.0}
        wanted = "sea level" if said == "of a town" else zero
        assert facts({}, {}, {}, xmp, (40, 30)).zero == wanted
        assert facts({}, {}, {exif.ALTITUDE_TAG: 1.0, exif.ALTITUDE_REF_TAG: b"\2"}, xmp, (40, 30)).zero == "sea level"


def test_camera_time_and_orientation(photo):
    basic = {exif.MAKE_TAG: "DJI\0", exif.MODEL_TAG: "FC6310", exif.ORIENTATION_TAG: 6}
    write_exif(photo, basic=basic, camera={exif.TAKEN_TAG: "2024:05:01 12:00:00", exif.SUBSECOND_TAG: "25"})
    found = read(photo)
    assert (found.camera, found.taken, found.orientation) == ("DJI FC6310", "2024:05:01 12:00:00.25", 6)


def test_the_equivalent_focal_length_is_of_the_whole_sensor():
    """A Phantom 3 (FC300S, 1/2.3 inch, 6.17 mm wide, 3.61 mm) has 20 mm in EXIF at 4:3, and at 16:9 too."""
    tags = {exif.FOCAL35_MM_TAG: 20, exif.FOCAL_MM_TAG: 3.61}
    whole, wide = (facts({}, tags, {}, {}, size).focal_px for size in ((4000, 3000), (4000, 2250)))
    assert whole == wide == pytest.approx(3.61 / 6.17 * 4000, rel=0.02)
    inch = facts({}, {exif.FOCAL35_MM_TAG: 24, exif.FOCAL_MM_TAG: 8.8}, {}, {}, (5472, 3078)).focal_px
    assert inch == pytest.approx(8.8 / 13.2 * 5472, rel=0.01)


def test_focal_lengths():
    size = (5472, 3648)
    diagonal = facts({}, {exif.FOCAL35_MM_TAG: 24}, {}, {}, size).focal_px
    assert diagonal == pytest.approx(24 / 36 * 5472, rel=1e-3)  # 3:2 as film is, so width and diagonal agree
    plane = {
        exif.FOCAL_MM_TAG: IFDRational(88, 10),
        exif.PIXELS_X_TAG: 5472,
        exif.PER_UNIT_X_TAG: 5472 / 13.2,
        exif.UNIT_TAG: 3,
    }
    assert facts({}, plane | {exif.PER_UNIT_X_TAG: 5472 / 1.32}, {}, {}, size).focal_px == pytest.approx(
        8.8 / 13.2 * 5472
    )
    half = facts({}, plane | {exif.PER_UNIT_X_TAG: 5472 / 1.32}, {}, {}, (2736, 1824)).focal_px
    assert half == pytest.approx(8.8 / 13.2 * 2736)  # reduced by a program that kept EXIF
    assert facts({}, {exif.FOCAL_MM_TAG: 8.8}, {}, {}, size).focal_px is None
    dpi = {exif.FOCAL_MM_TAG: 8.8, exif.PIXELS_X_TAG: 5472, exif.PER_UNIT_X_TAG: 72, exif.UNIT_TAG: 2}
    for wrong in ({exif.FOCAL35_MM_TAG: 65535}, {exif.FOCAL35_MM_TAG: 1}, dpi):
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
    assert facts({}, {}, {}, read_xmp(xmp and xmp.encode()), (40, 30)).accuracy_m == found
    assert facts({}, {}, {exif.ERROR_M_TAG: 4.0}, {}, (40, 30)).accuracy_m == (4, 4, 8)


@pytest.mark.parametrize("south, below, height", [("S", b"\x03", -12.5), ("South", b"\x02", 12.5), ("s", 1, -12.5)])
def test_halves_of_the_earth_and_heights_below_either_zero(south, below, height):
    gps = {
        exif.LATITUDE_REF_TAG: south,
        exif.LATITUDE_TAG: (33, 30, 0),
        exif.LONGITUDE_REF_TAG: "W",
        exif.LONGITUDE_TAG: (70, 0, 0),
    }
    found = facts({}, {}, gps | {exif.ALTITUDE_REF_TAG: below, exif.ALTITUDE_TAG: 12.5}, {}, (40, 30)).position
    assert found == (-33.5, -70, height)


def test_which_of_several_equal_cameras_it_is():
    basic = {exif.MAKE_TAG: "MicaSense", exif.MODEL_TAG: "RedEdge", exif.ORIENTATION_TAG: IFDRational(6)}
    rig = read_xmp("<Camera:RigCameraIndex>2</Camera:RigCameraIndex>")
    found = facts(basic, {exif.BODY_SERIAL_TAG: "RX01-17"}, {}, rig, (40, 30))
    assert found.which == "MicaSense RedEdge RX01-17 2.0" and found.camera == "MicaSense RedEdge"
    assert facts(basic, {}, {}, {}, (40, 30)).which == "MicaSense RedEdge"
    assert type(found.orientation) is int and found.orientation == 6, "it is kept as a whole number"


@pytest.mark.parametrize(
    "value, letter, wanted, signed",
    [
        ((33, 30, 0), None, 33.5, False),
        ((33, 30, 0), "\0", 33.5, False),
        ((33, 30, 0), "", 33.5, False),
        ((33, 30, 0), "?", 33.5, False),
        ((33, 30, 0), "south", -33.5, True),
        ((33, 30, 0), b"s\0", -33.5, True),
        ((33, 30, 0), "North", 33.5, True),
        ((-33, 30, 0), None, -33.5, True),
        ((-33, 30, 0), "S", -33.5, True),
        ((-33, 30, 0), "N", 33.5, False),
        (IFDRational(335, 10), "S", -33.5, True),
        ((IFDRational(335, 10),), "S", -33.5, True),
        ((33, IFDRational(30, 1)), "S", -33.5, True),
        ("33.5", "S", -33.5, True),
    ],
)
def test_degrees_and_their_sign(value, letter, wanted, signed):
    gps = {
        exif.LATITUDE_TAG: value,
        exif.LATITUDE_REF_TAG: letter,
        exif.LONGITUDE_TAG: (70, 0, 0),
        exif.LONGITUDE_REF_TAG: "E",
    }
    found = facts({}, {}, gps, {}, (40, 30))
    assert found.position == (pytest.approx(wanted), 70, None)
    assert found.unsigned == (() if signed else ("latitude",)), "without a sign it is not north by default"


@pytest.mark.parametrize(
    "reference, height, unsure",
    [(None, 12.5, True), (b"", 12.5, True), (b"\0", 12.5, False), (b"\1", -12.5, False), ("1", -12.5, False)],
)
def test_what_altitudes_are_counted_from(reference, height, unsure):
    gps = {1: "N", 2: (1, 0, 0), 3: "E", 4: (1, 0, 0), exif.ALTITUDE_TAG: 12.5, exif.ALTITUDE_REF_TAG: reference}
    found = facts({}, {}, gps, {}, (40, 30))
    assert (found.position[2], found.no_reference) == (height, unsure)
    found = facts({}, {}, gps | {exif.ALTITUDE_TAG: -12.5, exif.ALTITUDE_REF_TAG: b"\1"}, {}, (40, 30))
    assert found.position[2] == -12.5, "below, said twice"
    found = facts({}, {}, gps | {exif.ALTITUDE_TAG: IFDRational(0, 0)}, {}, (40, 30))
    assert found.position[2] is None and not found.no_reference


@pytest.mark.parametrize(
    "xmp, position, altitude, above",
    [
        ('drone-dji:GpsLatitude="-33.5" drone-dji:GpsLongitude="+70.25"', (-33.5, 70.25, None), None, None),
        (
            "<drone-dji:GpsLatitude>33.5</drone-dji:GpsLatitude><drone-dji:GpsLongtitude>-70.25</drone-dji:GpsLongtitude>"
            "<drone-dji:AbsoluteAltitude>+120.5</drone-dji:AbsoluteAltitude>"
            "<drone-dji:RelativeAltitude>+40.1</drone-dji:RelativeAltitude>",
            (33.5, -70.25, 120.5),
            120.5,
            40.1,
        ),
        (
            'exif:GPSLatitude="33,30S" exif:GPSLongitude="70,15,0E" exif:GPSAltitude="2410/20" exif:GPSAltitudeRef="0"',
            (-33.5, 70.25, 120.5),
            120.5,
            None,
        ),
        (
            "exif:GPSAltitude='12/1' exif:GPSAltitudeRef='1' exif:GPSLatitude='33,30.0n' exif:GPSLongitude='70,15w'",
            (33.5, -70.25, -12.0),
            -12.0,
            None,
        ),
        ('drone-skydio:Latitude="33.5" drone-skydio:Longitude="-70.25"', (33.5, -70.25, None), None, None),
        ('photoshop:Latitude="33.5" photoshop:Longitude="-70.25"', None, None, None),
        ('drone-dji:GpsLatitude="+0.000000" drone-dji:GpsLongitude="+0.000000"', None, None, None),
        ('exif:GPSLatitude="33,30" exif:GPSLongitude="70,15"', None, None, None),  # no letters
        ('drone-dji:GpsLatitude="nan" drone-dji:GpsLongitude="95"', None, None, None),
        ('drone-dji:GpsLatitude="95" drone-dji:GpsLongitude="95" drone-dji:AbsoluteAltitude="1/0"', None, None, None),
    ],
)
def test_positions_in_xmp(xmp, position, altitude, above):
    found = facts({}, {}, {}, read_xmp(f"<rdf:Description {xmp} x='y'/>".encode()), (40, 30))
    assert found.position is None and found.xmp_position == (position and pytest.approx(position))
    assert (found.xmp_altitude, found.above_start) == (altitude, above)


@pytest.mark.parametrize(
    "gps",
    [
        {exif.LATITUDE_TAG: (0, 0, 0), exif.LONGITUDE_TAG: (0, 0, 0), exif.ALTITUDE_TAG: 0},  # a receiver without a fix
        {exif.LATITUDE_TAG: (91, 0, 0), exif.LONGITUDE_TAG: (10, 0, 0), exif.ALTITUDE_TAG: 1},
        {exif.LATITUDE_TAG: (52, 0, math.nan), exif.LONGITUDE_TAG: (10, 0, 0), exif.ALTITUDE_TAG: 1},
        {exif.LATITUDE_TAG: 52, exif.LONGITUDE_TAG: "x", exif.ALTITUDE_TAG: 1},
        {exif.LATITUDE_TAG: (52, 0, 0, 0), exif.LONGITUDE_TAG: (10, 0, 0)},
        {exif.LATITUDE_TAG: (52, 0, IFDRational(1, 0)), exif.LONGITUDE_TAG: (10, 0, 0), exif.ALTITUDE_TAG: 1},
    ],
)
def test_what_is_no_position(gps):
    assert facts({}, {}, gps, {}, (40, 30)).position is None


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")  # as the module does, outside pytest
def test_damaged_exif_counts_as_not_said(photo):
    whole = photo.read_bytes()
    photo.write_bytes(whole[:2] + b"\xff\xe1\x00\x12Exif\0\0II*\0\xff\xff\xff\x7f\0\0" + whole[2:])
    assert read(photo) == Exif()
