"""Cameras in formats for exchange and of scanning apps show known dots where the formulas of these formats put them."""

from functools import partial

import numpy as np
import pytest

from surfkit.core.check import BadInput
from surfkit.readers.data import Data
from surfkit.readers.read import read, read_capture, reader_of
from surfkit.run.notes import collect_notes

from .exchange import blocks_exchange
from .programs import COLORS, DOTS, ORIGIN, POSES

BROWN = {"K1": -0.09, "K2": 0.06, "K3": -0.03, "P1": 0.003, "P2": -0.002}
AXES = ("XRightYUp", "XLeftYDown", "XLeftYUp", "XDownYRight", "XDownYLeft", "XUpYRight", "XUpYLeft")
CASES = {
    "blocks": partial(blocks_exchange, **BROWN),
    "blocks in degrees": partial(blocks_exchange, degrees=True),
    "blocks in degrees, x right, y up": partial(blocks_exchange, degrees=True, axes="XRightYUp"),
    "blocks in millimetres": partial(blocks_exchange, millimetres=True),
    **{f"blocks {axes}": partial(blocks_exchange, axes=axes, millimetres=True) for axes in AXES},
}


@pytest.mark.parametrize("case", CASES)
def test_dots_lie_where_the_format_puts_them(tmp_path, case):
    project = CASES[case](tmp_path)
    data = Data(tmp_path, test_every=0)
    shots = read_capture(data, reader_of(data)).shots
    assert [shot.name for shot in shots] == list(POSES)
    for shot in shots:
        turn, centre = POSES[shot.name]
        np.testing.assert_allclose(shot.pose[:3, :3], turn, atol=1e-9)
        np.testing.assert_allclose(-shot.pose[:3, :3].T @ shot.pose[:3, 3], centre, atol=1e-9)
        local = DOTS @ shot.pose[:3, :3].T + shot.pose[:3, 3]
        np.testing.assert_allclose(np.asarray(shot.camera.img_from_cam(local)), project(shot.name, DOTS), atol=1e-6)


def test_tie_points_of_blocks_keep_their_tracks(tmp_path):
    project = blocks_exchange(tmp_path, **BROWN)
    data = Data(tmp_path, test_every=0)
    with collect_notes() as kept:
        capture = read_capture(data, reader_of(data))
    assert any("1 of 5 photographs are left out, which have no pose: 'D:/lost/IMG 9.png'" in t for t in kept.texts)
    np.testing.assert_array_equal(capture.xyz, DOTS)
    np.testing.assert_array_equal(capture.rgb, COLORS)
    assert [sorted(group) for group in capture.groups] == [sorted(POSES)]
    tracks = reader_of(data).tracks(data)
    assert tracks.error_px.max() < 1e-6 and tracks.seen.keys() == POSES.keys()
    for name, (rows, pixels) in tracks.seen.items():
        np.testing.assert_allclose(pixels, project(name, DOTS[rows]), atol=1e-9)


LOCAL_CS = 'LOCAL_CS["Local",UNIT["metre",1]]'
FEET = 'PROJCS["Feet",GEOGCS["WGS 84",DATUM["D",SPHEROID["S",6378137,298.25]]],UNIT["US survey foot",0.3048006096]]'
ENU = "+proj=topocentric +ellps=WGS84 +lat_0=39.97523 +lon_0=-83.00678 +h_0=0.0"


@pytest.mark.parametrize(
    ("system", "crs", "metres"),
    [
        ("EPSG:32632", "EPSG:32632", 1.0),
        ("EPSG:32632+5773", "EPSG:32632", 1.0),
        ("ENU:39.97523,-83.00678", ENU, 1.0),
        (FEET, FEET, 0.3048006096),
        (LOCAL_CS, None, None),
        ("Local Coordinates", None, None),
        (None, None, None),
    ],
)
def test_blocks_on_the_map(tmp_path, system, crs, metres):
    blocks_exchange(tmp_path, system=system, origin=ORIGIN)
    with collect_notes() as kept:
        scene = read(Data(tmp_path, test_every=0))
    assert scene.frame.crs == crs and scene.frame.metres == metres
    poses = [scene.frame.input_pose(view.camera.world_to_camera) for view in scene.train]
    places = [-pose[:3, :3].T @ pose[:3, 3] for pose in poses]
    np.testing.assert_allclose(places, [ORIGIN + centre for _, centre in POSES.values()], atol=1e-6)
    assert any("heights are those of 5773" in text for text in kept.texts) == (system == "EPSG:32632+5773")


@pytest.mark.parametrize(
    "paths",
    [
        lambda name: f"file:///C:/a%20b/{name.replace(' ', '%20')}",
        lambda name: f"images/{name}",
        lambda name: f"/somewhere/else/{name}",
    ],
)
def test_photographs_of_blocks_on_another_machine(tmp_path, paths):
    blocks_exchange(tmp_path, paths=paths)
    assert [view.name for view in read(Data(tmp_path, test_every=0)).train] == list(POSES)


def test_photographs_of_blocks_of_the_same_name_in_several_folders(tmp_path):
    folders = dict(zip(POSES, ("100MEDIA", "100MEDIA", "101MEDIA", "101MEDIA"), strict=True))
    short = {name: f"DJI_{at % 2}.png" for at, name in enumerate(POSES)}
    blocks_exchange(tmp_path, paths=lambda name: f"D:/flight/{folders[name]}/{short[name]}")
    for name in POSES:
        place = tmp_path / "images" / folders[name] / short[name]
        place.parent.mkdir(exist_ok=True)
        (tmp_path / "images" / name).rename(place)
    shots = read_capture(Data(tmp_path), reader_of(Data(tmp_path))).shots
    assert [shot.path for shot in shots] == [tmp_path / "images" / folders[name] / short[name] for name in POSES]


def words(old, new):
    def change(text):
        assert old in text, text
        return text.replace(old, new, 1)

    return change


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"system": "EPSG:4326"}, "in degrees"),
        ({"system": "WGS84"}, "in degrees; export the block in a projected or a local coordinate system"),
        ({"change": words("<Block>", "")}, "not XML, or cut off"),
        ({"change": words("<BlocksExchange", '<!DOCTYPE a [<!ENTITY b "c">]>\n<BlocksExchange')}, "definitions"),
        ({"change": words("Perspective", "Fisheye")}, "photogroup 'Group 1': its cameras are of type Fisheye"),
        ({"change": words("XRightYDown", "XRightYLeft")}, "CameraOrientation 'XRightYLeft' is none such as"),
        ({"change": words("<AspectRatio>1", "<AspectRatio>1.01")}, "AspectRatio 1.01 and Skew 0"),
        ({"change": words("<FocalLengthPixels>", "<F>")}, "not XML, or cut off"),
        ({"change": words(f"<FocalLengthPixels>{190.0!r}</FocalLengthPixels>", "")}, "no FocalLengthPixels, and no"),
        ({"change": words("<M_00>", "<M_00>x")}, "Rotation: "),
        ({"change": words("<Photogroup>", "<Photogroup><SRSId>8</SRSId>")}, "a coordinate reference system of its own"),
    ],
)
def test_blocks_that_are_refused(tmp_path, given, said):
    if "EPSG:4326" in given.values():
        pytest.importorskip("pyproj")
    blocks_exchange(tmp_path, **given)
    with pytest.raises(BadInput) as caught:
        read(Data(tmp_path))
    assert said in str(caught.value) and "\n" not in str(caught.value)
