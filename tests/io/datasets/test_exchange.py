"""Cameras in formats for exchange and of scanning apps show known dots where the formulas of these formats put them."""

import base64
from dataclasses import replace
from functools import partial

import numpy as np
import pyproj
import pytest
from exchange_files import blocks_exchange, opf, polycam, record3d, xmp_sidecars
from PIL import Image
from program_files import COLORS, DOTS, ORIGIN, POSES, realitycapture
from scipy.spatial.transform import Rotation

from surfkit.apps.doctor.gather import heard
from surfkit.cli import main
from surfkit.core.check import BadInput, collecting
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_layout import DepthQuery, find_maps
from surfkit.io.datasets.read import observations, read, read_capture, reader_of
from surfkit.runs.run_notes import collect_notes

BROWN = {"K1": -0.09, "K2": 0.06, "K3": -0.03, "P1": 0.003, "P2": -0.002}
AXES = ("XRightYUp", "XLeftYDown", "XLeftYUp", "XDownYRight", "XDownYLeft", "XUpYRight", "XUpYLeft")
CASES = {
    "blocks": partial(blocks_exchange, **BROWN),
    "blocks in degrees": partial(blocks_exchange, degrees=True),
    "blocks in degrees, x right, y up": partial(blocks_exchange, degrees=True, axes="XRightYUp"),
    "blocks in millimetres": partial(blocks_exchange, millimetres=True),
    **{f"blocks {axes}": partial(blocks_exchange, axes=axes, millimetres=True) for axes in AXES},
    "opf": partial(opf, R1=-0.1, R2=0.07, R3=-0.02, T1=0.003, T2=-0.002),
    "polycam": polycam,
    "polycam without corrections": partial(polycam, kind=""),
    "record3d": record3d,
    "record3d with a lens each": partial(record3d, own=True),
    "xmp": partial(xmp_sidecars, k1=-0.09, k2=0.06, k3=-0.03, u=0.02, v=-0.015),
    "xmp with tangential terms": partial(xmp_sidecars, model="brown4t2", k1=-0.09, t1=0.003, t2=-0.002),
    "xmp in attributes": partial(xmp_sidecars, model="perspective", elements=False, u=0.01, aspect=1.004),
    "xmp without distortion": partial(xmp_sidecars, model="division"),
}


@pytest.mark.parametrize("case", CASES)
def test_dots_lie_where_the_format_puts_them(tmp_path, case):
    project = CASES[case](tmp_path)
    data = Data(tmp_path, test_every=0)
    shots = read_capture(data, reader_of(data)).shots
    assert len(shots) == len(POSES) and (
        case.startswith(("polycam", "record3d")) or [shot.name for shot in shots] == list(POSES)
    )
    for shot, (turn, centre) in zip(shots, POSES.values(), strict=True):
        np.testing.assert_allclose(shot.pose[:3, :3], turn, atol=1e-9)
        np.testing.assert_allclose(-shot.pose[:3, :3].T @ shot.pose[:3, 3], centre, atol=1e-9)
        local = DOTS @ shot.pose[:3, :3].T + shot.pose[:3, 3]
        np.testing.assert_allclose(np.asarray(shot.camera.img_from_cam(local)), project(shot.name, DOTS), atol=1e-6)


def test_tie_points_of_blocks_keep_their_tracks(tmp_path):
    project = blocks_exchange(tmp_path, **BROWN)
    data = Data(tmp_path, test_every=0)
    with collect_notes() as kept:
        capture = read_capture(data, reader_of(data))
    assert any("1 of 5" in t and "no pose: 'D:/lost/IMG 9.png'" in t for t in kept.texts)
    np.testing.assert_array_equal(capture.xyz, DOTS)
    np.testing.assert_array_equal(capture.rgb, COLORS)
    assert [sorted(group) for group in capture.groups] == [sorted(POSES)]
    tracks = reader_of(data).tracks(data)
    assert tracks.error_px.max() < 1e-6 and tracks.seen.keys() == POSES.keys()
    for name, (rows, pixels) in tracks.seen.items():
        np.testing.assert_allclose(pixels, project(name, DOTS[rows]), atol=1e-9)


LOCAL_CS = 'LOCAL_CS["Local",UNIT["metre",1]]'
FEET = (
    'PROJCS["Feet",GEOGCS["WGS 84",DATUM["D",SPHEROID["S",6378137,298.25]],PRIMEM["Greenwich",0],UNIT["degree",'
    '0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["central_meridian",9],UNIT["US survey foot",'
    "0.3048006096]]"
)
ENU = "+proj=topocentric +ellps=WGS84 +lat_0=39.97523 +lon_0=-83.00678 +h_0=0.0"


@pytest.mark.parametrize(
    ("system", "crs", "metres"),
    [
        ("EPSG:32632", "EPSG:32632", 1.0),
        ("EPSG:32632+5773", "EPSG:32632", 1.0),
        (pyproj.CRS("EPSG:32632+5773").to_wkt("WKT1_GDAL"), "EPSG:32632", 1.0),
        ("ENU:39.97523,-83.00678", ENU, 1.0),
        (FEET, FEET, pytest.approx(1200 / 3937, rel=1e-9)),
        (LOCAL_CS, None, 1.0),
        ('LOCAL_CS["of no unit"]', None, None),
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
    has_heights = system is not None and ("+5773" in system or "COMPD_CS" in system)
    told = [text for text in kept.texts if "heights are those of" in text]
    assert len(told) == has_heights and all("5773" in text or "EGM96 height" in text for text in told)


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
    ("change", "said"),
    [
        (words("<TiePoints>", "<TiePoints><Path>ties.xml</Path>"), "tie points lie in 'ties.xml', which is not read"),
        (words("<TiePoints>", "<TiePoints><SRSId>9</SRSId>"), "tie points are in another coordinate reference system"),
        (words("<Block>", "<Block><Photogroups/></Block><Block>"), "it has 2 blocks; the one of most photographs"),
    ],
)
def test_tie_points_of_blocks_that_are_left_out(tmp_path, change, said):
    blocks_exchange(tmp_path, change=change)
    with collect_notes() as kept:
        capture = read_capture(Data(tmp_path), reader_of(Data(tmp_path)))
    assert len(capture.shots) == len(POSES) and not len(capture.xyz)
    assert any(said in text for text in kept.texts)
    assert reader_of(Data(tmp_path)).tracks(Data(tmp_path)) is None


def test_damaged_tie_points_of_blocks_are_told_all_at_once(tmp_path):
    blocks_exchange(tmp_path, change=lambda text: text.replace("<Red>", "<Red>x").replace("<Red>x", "<Red>", 18))
    with collecting() as kept:
        capture = reader_of(Data(tmp_path)).read(Data(tmp_path))
    assert len(kept) == 2 and len(capture.xyz) == len(capture.rgb) == 18


def test_blocks_of_another_component_are_left_out(tmp_path):
    blocks_exchange(tmp_path, change=words("<Component>1", "<Component>0"))
    with collect_notes() as kept:
        shots = read_capture(Data(tmp_path), reader_of(Data(tmp_path))).shots
    assert [shot.name for shot in shots] == list(POSES)[1:]
    assert any("1 of 4 photographs are left out, which are not of" in t for t in kept.texts)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"system": "EPSG:4326"}, "in degrees"),
        ({"system": "WGS84"}, "in degrees; export in a projected or a local coordinate system"),
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
    blocks_exchange(tmp_path, **given)
    with pytest.raises(BadInput) as caught:
        read(Data(tmp_path))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_depths_of_polycam_are_millimetres(tmp_path):
    polycam(tmp_path)
    capture = read_capture(Data(tmp_path), reader_of(Data(tmp_path)))
    maps = find_maps(DepthQuery(tmp_path, [shot.name for shot in capture.shots], tmp_path, capture.metres))
    assert capture.metres == 1.0 and maps.keys() == {shot.name for shot in capture.shots}
    for each in maps.values():
        assert each.aligned and each.metric
        np.testing.assert_allclose(each.read(), 1 / 1.25, rtol=1e-6)


def test_depths_of_polycam_end_at_the_reach_of_the_lidar_and_have_a_confidence(tmp_path):
    polycam(tmp_path)
    depth, sure = np.full((4, 6), 1250, np.uint16), np.full((4, 6), 255, np.uint8)
    depth[0, 0], sure[1], sure[2] = 5001, 127, 0
    for folder, values in (("depth", depth), ("confidence", sure)):
        (tmp_path / "keyframes" / folder).mkdir(exist_ok=True)
        Image.fromarray(values).save(tmp_path / f"keyframes/{folder}/100.png")
    (found,) = find_maps(DepthQuery(tmp_path, ["keyframes/corrected_images/100.jpg"], tmp_path)).values()
    expected = np.full((4, 6), 0.8)
    expected[0, 0] = np.nan
    np.testing.assert_allclose(found.read(), expected, rtol=1e-6)
    np.testing.assert_array_equal(found.read_confidence()[:, 0], [1, 0.5, 0, 1])


def test_raw_data_of_polycam_without_corrections_is_told(tmp_path):
    polycam(tmp_path, kind="")
    with collect_notes() as kept:
        read(Data(tmp_path))
    assert any("no corrected_images and corrected_cameras: " in text for text in kept.texts)


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (partial(polycam, change=lambda number, values: values.pop("t_12")), "100.json: it lacks t_12"),
        (partial(polycam, change=lambda number, values: values.update(t_00=9)), "the pose is not a rotation"),
        (partial(polycam, change=lambda number, values: values.update(fx="wide")), "where 6 finite numbers belong"),
        (partial(polycam, change=lambda number, values: values.update(fx=0)), "no lens has size"),
        (partial(record3d, change=lambda values: values.pop("K")), "metadata: it lacks K; export"),
        (partial(record3d, change=lambda values: values.update(K=[1] * 8)), "where 9 finite numbers belong"),
        (partial(record3d, change=lambda values: values.update(poses=[])), "metadata: no list of poses"),
        (partial(record3d, own=True, change=lambda values: values["poses"].pop()), "a lens for each of 3 poses"),
        (
            partial(record3d, change=lambda values: values["poses"].__setitem__(2, [0] * 7)),
            "poses.2: its first four numbers are no quaternion",
        ),
        (partial(xmp_sidecars, model="division", k1=0.1), "distortion model 'division' with 6 coefficients; known: "),
        (partial(xmp_sidecars, change=lambda name, text: f"<!DOCTYPE a>{text}"), "has definitions of its own"),
        (partial(xmp_sidecars, change=lambda name, text: text[:-9]), "not XML"),
        (
            partial(xmp_sidecars, change=lambda name, text: text.replace("FocalLength35mm", "F")),
            "no xcr:FocalLength35mm",
        ),
        (partial(xmp_sidecars, change=lambda name, text: text.replace("Rotation>", "R>")), "have no pose in their XMP"),
        (partial(xmp_sidecars, skew=0.1), "no camera model of COLMAP has its skew"),
    ],
)
def test_scans_and_sidecars_that_are_refused(tmp_path, write, said):
    write(tmp_path)
    with pytest.raises(BadInput) as caught:
        read(Data(tmp_path))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_packed_file_of_record3d_is_told_to_be_unpacked(tmp_path):
    (tmp_path / "room.r3d").write_bytes(b"PK")
    with pytest.raises(BadInput, match="no metadata or metadata.json .*room.r3d"):
        read(Data(tmp_path))


def test_where_a_scan_of_record3d_lies_and_its_photographs_belong(tmp_path):
    (tmp_path / "my scan").mkdir()
    record3d(tmp_path / "my scan")
    (tmp_path / "my scan.r3d").write_bytes(b"PK")
    with pytest.raises(BadInput, match=r"`unzip '\S+/my scan.r3d' -d '\S+/my scan'`"):
        read(Data(tmp_path / "my scan.r3d"))
    (tmp_path / "my scan.r3d").unlink()
    with pytest.raises(BadInput, match=r"no data set .*'my scan' .*give \S+/my scan$"):
        read(Data(tmp_path))
    (tmp_path / "my scan/rgbd/1.jpg").unlink()
    with pytest.raises(BadInput, match=r"missing: 'rgbd/1.jpg'; .*\S+/my scan/rgbd,"):
        read(Data(tmp_path / "my scan"))


def test_depth_of_record3d_is_told_and_one_lens_is_one_camera(tmp_path):
    record3d(tmp_path, own=True)
    (tmp_path / "rgbd/1.jpg").unlink()
    with collect_notes() as kept:
        capture = read_capture(Data(tmp_path, missing="skip"), reader_of(Data(tmp_path)))
    assert any("compressed by LZFSE, and is not read" in text for text in kept.texts)
    assert [shot.name for shot in capture.shots] == ["rgbd/0.jpg", "rgbd/2.jpg", "rgbd/3.jpg"]
    assert capture.metres == 1.0 and len({id(shot.camera) for shot in capture.shots}) == 1


def test_a_csv_file_of_realitycapture_is_read_before_sidecars(tmp_path):
    xmp_sidecars(tmp_path)
    realitycapture(tmp_path)
    assert type(reader_of(Data(tmp_path))).__name__ == "RealityCapture"


def test_an_empty_folder_of_corrected_cameras_of_polycam(tmp_path):
    polycam(tmp_path, kind="")
    for part in ("images", "cameras"):
        (tmp_path / f"keyframes/corrected_{part}").mkdir()
        (tmp_path / f"keyframes/corrected_{part}/.DS_Store").touch()
    assert len(read_capture(Data(tmp_path), reader_of(Data(tmp_path))).shots) == len(POSES)


def test_a_photograph_without_a_pose_in_its_xmp_is_left_out(tmp_path):
    xmp_sidecars(tmp_path, change=lambda name, text: text.replace("Position>", "P>") if name == "IMG 2.png" else text)
    with collect_notes() as kept:
        scene = read(Data(tmp_path, test_every=0))
    assert [view.name for view in scene.train] == ["IMG 1.png", "IMG 3.png", "IMG 4.png"]
    assert any("1 of 4" in t and "in their XMP: 'IMG 2.xmp'" in t for t in kept.texts)


def test_sidecars_in_the_folder_of_the_data_set(tmp_path):
    xmp_sidecars(tmp_path)
    (tmp_path / "images/IMG 1.xmp").write_text(
        '<x xmlns:lr="http://ns.adobe.com/lightroom/1.0/"/>'
    )  # of another program
    for name in ("IMG 2", "IMG 3", "IMG 4"):
        (tmp_path / f"images/{name}.xmp").rename(tmp_path / f"{name}.xmp")
    assert [view.name for view in read(Data(tmp_path, test_every=0)).train] == ["IMG 2.png", "IMG 3.png", "IMG 4.png"]


UTM16 = (  # as the specification has it
    'PROJCRS["WGS 84 / UTM zone 16N",\n BASEGEOGCRS["WGS 84",ENSEMBLE["World Geodetic System 1984 ensemble",\n'
    'MEMBER["World Geodetic System 1984 (Transit)"],MEMBER["World Geodetic System 1984 (G1762)"],'
    'ELLIPSOID["WGS 84",6378137,298.257223563,LENGTHUNIT["metre",1]],ENSEMBLEACCURACY[2.0]],ID["EPSG",4326]],\n'
    'CONVERSION["UTM zone 16N",METHOD["Transverse Mercator",ID["EPSG",9807]],'
    'PARAMETER["Longitude of natural origin",-87],PARAMETER["False easting",500000]],CS[Cartesian,2],'
    'AXIS["(E)",east,ORDER[1],LENGTHUNIT["metre",1]],AXIS["(N)",north,ORDER[2],LENGTHUNIT["metre",1]],ID["EPSG",32616]]'
)


SITE = (
    'ENGINEERINGCRS["Site",ENGINEERINGDATUM["Corner"],CS[Cartesian,2],AXIS["x",north],AXIS["y",east],'
    'LENGTHUNIT["metre",1.0]]'
)


@pytest.mark.parametrize(
    ("given", "crs", "metres"),
    [
        ({"definition": UTM16}, "EPSG:32616", 1.0),
        ({"definition": "EPSG:32616+EPSG:5773"}, "EPSG:32616", 1.0),
        ({"definition": UTM16, "scale": (3.0, 3.0, 1.0)}, None, 1 / 3),
        ({"definition": SITE, "swap": True}, None, 1.0),
    ],
)
def test_opf_on_the_map(tmp_path, given, crs, metres):
    origin = np.array([746308.125, 3714810.5, 268.75])
    opf(tmp_path, shift=-origin, **given)
    with collect_notes() as kept:
        scene = read(Data(tmp_path, test_every=0))
    assert (scene.frame.crs, scene.frame.metres, scene.frame.shift) == (crs, metres, tuple(origin))
    poses = [scene.frame.input_pose(view.camera.world_to_camera) for view in scene.train]
    places = [-pose[:3, :3].T @ pose[:3, 3] for pose in poses]
    np.testing.assert_allclose(places, [origin + centre for _, centre in POSES.values()], atol=1e-6)
    assert any("1 of 5" in t and "not calibrated: 'IMG 9.png'" in t for t in kept.texts)
    assert any("lengths are 3 times those of the map" in text for text in kept.texts) == ("scale" in given)


def test_sparse_points_of_opf_keep_their_tracks(tmp_path):
    """Pixels and coordinates are stored in 32 bits."""
    origin = np.array([746308.125, 3714810.5, 268.75])
    project = opf(tmp_path, shift=-origin, definition=UTM16, R1=-0.1, T1=0.003)
    data = Data(tmp_path, test_every=0)
    capture = read_capture(data, reader_of(data))
    np.testing.assert_allclose(capture.xyz, DOTS + origin, atol=1e-5)
    np.testing.assert_array_equal(capture.rgb, COLORS)
    assert [sorted(group) for group in capture.groups] == [sorted(POSES)]
    tracks = reader_of(data).tracks(data)
    assert tracks.error_px.max() < 1e-4 and tracks.seen.keys() == POSES.keys()
    for name, (rows, pixels) in tracks.seen.items():
        assert sorted(rows) == list(range(len(DOTS)))
        np.testing.assert_allclose(pixels, project(name, DOTS[rows]), atol=2e-5)
    assert observations(data, read(data)).seen.keys() == POSES.keys()
    (tmp_path / "images/IMG 2.png").unlink()
    some = replace(data, missing="skip")
    assert reader_of(some).tracks(some).seen.keys() == POSES.keys() - {"IMG 2.png"}


def test_nodes_of_sparse_points_of_opf_lie_in_one_another(tmp_path):
    """A quaternion, and the frame of the parent; a factor of each axis comes first."""
    parent, child = Rotation.from_rotvec([0.3, -0.8, 0.5]), Rotation.from_rotvec([1.1, 0.2, -0.4])

    def change(files):
        inner = {"mesh": 0, "rotation": (2 * child.as_quat()).tolist(), "translation": [1, 2, 3], "scale": [1, 2, 0.5]}
        outer = {"children": [0], "rotation": parent.as_quat().tolist(), "translation": [-4, 5, 6]}
        files["tracks.gltf"]["nodes"] = [inner, outer]

    opf(tmp_path, change=change)
    data = Data(tmp_path)
    x, y, z = (parent.apply(child.apply(DOTS * [1, 2, 0.5]) + [1, 2, 3]) + [-4, 5, 6]).T
    np.testing.assert_allclose(read_capture(data, reader_of(data)).xyz, np.stack([x, -z, y], 1), atol=1e-5)


def test_sparse_points_of_opf_in_the_file_itself_or_in_another_folder(tmp_path):
    def change(files):
        whole = (tmp_path / "parts/position.bin").read_bytes()
        (tmp_path / "colour.bin").write_bytes((tmp_path / "parts/colour.bin").read_bytes())
        files["tracks.gltf"]["buffers"][0]["uri"] = "data:a/b;base64," + base64.b64encode(whole).decode()
        files["tracks.gltf"]["buffers"][1]["uri"] = "../colour.bin"

    opf(tmp_path, change=change)
    capture = read_capture(Data(tmp_path), reader_of(Data(tmp_path)))
    np.testing.assert_allclose(capture.xyz, DOTS, atol=1e-5)
    np.testing.assert_array_equal(capture.rgb, COLORS)


@pytest.mark.parametrize(
    ("own", "said"),
    [
        (0, "lacks the cameras that all 80 observations of the sparse points name, so the points are of another"),
        (3, "lacks the cameras that 20 of 80 observations of the sparse points name"),
        (4, None),
    ],
)
def test_sparse_points_of_opf_of_another_calibration(tmp_path, own, said):
    def change(files):
        known = files["tracks.gltf"]["meshes"][0]["primitives"][0]["extensions"]["OPF_mesh_primitive_matches"]
        known["cameraUids"] = known["cameraUids"][:own] + list(range(100, 104 - own))

    opf(tmp_path, change=change)
    with collect_notes() as kept:
        read(Data(tmp_path))
    lines = [text for text in kept.texts if "observations" in text]
    assert len(lines) == (said is not None) and all(f"calibrated.json: {said}" in text for text in lines)


def test_what_an_opf_lacks_is_told_once(tmp_path):
    """Its tracks are read anew, by each part of a run that needs them."""
    opf(tmp_path)
    data = Data(tmp_path)
    with heard() as texts:
        scene = read(data)
        assert len(observations(data, scene).seen) == len(observations(data, scene).seen) == len(POSES)
    assert sum("1 of 5 photographs are left out" in text for text in texts) == 1


def test_doctor_tells_once_of_points_that_are_cut_off(tmp_path, capsys):
    opf(tmp_path, change=at("tracks.gltf", "accessors", 0, "count", value=10**12))
    assert main(["doctor", str(tmp_path), "recipe:surface", "--quick", "--probe", "0"]) == 2
    assert capsys.readouterr().out.count("position.bin: cut off") == 1


def test_opf_without_sparse_points_of_its_own(tmp_path):
    opf(tmp_path, change=lambda files: files["../survey.opf"]["items"][2]["resources"].pop())
    data = Data(tmp_path)
    assert not len(read_capture(data, reader_of(data)).xyz) and reader_of(data).tracks(data) is None


@pytest.mark.parametrize("name", ["position", "pixel", "range"])
def test_sparse_points_of_opf_that_are_cut_off(tmp_path, name):
    opf(tmp_path)
    path = tmp_path / f"parts/{name}.bin"
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(BadInput, match=f"{name}.bin: cut off"):
        read(Data(tmp_path))
    path.unlink()
    with pytest.raises(BadInput, match=f"{name}.bin: cannot be read"):
        read(Data(tmp_path))


MATCHES = ("meshes", 0, "primitives", 0, "extensions", "OPF_mesh_primitive_matches")
TWICE = "calibrated.json: more than one calibration of '../photos/IMG 1.png'; calibrate and export the project again"


def at(name, *path, value):
    def change(files):
        place = files[name]
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (at("calibrated.json", "sensors", 0, "internals", "type", value="fisheye"), "sensor 7: of type 'fisheye'"),
        (at("calibrated.json", "sensors", 0, "id", value=8), "the input cameras do not have it"),
        (at("calibrated.json", "cameras", value=[]), "no camera in it"),
        (at("calibrated.json", "cameras", value=3), "cameras is no list of objects"),
        (at("calibrated.json", "cameras", 0, "position", value=[1, 2]), "position: [1, 2], where 3 finite numbers"),
        (at("../survey.opf", "items", 2, "resources", value=[]), "names no file of calibrated-cameras"),
        (lambda files: files["calibrated.json"]["cameras"].append(files["calibrated.json"]["cameras"][0]), TWICE),
        (at("tracks.gltf", "accessors", value=[]), "tracks.gltf: names number 0 of its 0 accessors"),
        (at("tracks.gltf", "accessors", 0, value={}), "not as OPF has sparse points: 'bufferView' is missing; export"),
        (
            at("tracks.gltf", "accessors", 0, "bufferView", value=-1),
            "tracks.gltf: names number -1 of its 5 bufferViews",
        ),
        (at("tracks.gltf", "accessors", 0, "count", value=10**12), "position.bin: cut off; copy the project whole"),
        (at("tracks.gltf", "accessors", 0, "count", value=-3), "tracks.gltf: accessor 0 has -3 values from byte 8 on"),
        (
            at("tracks.gltf", "accessors", 0, "componentType", value=5130),
            "accessor 0 is 'VEC3' of type 5130, which OPF",
        ),
        (at("tracks.gltf", "buffers", 0, "uri", value="../../x.bin"), "names '../../x.bin', which does not lie in the"),
        (at("tracks.gltf", "buffers", 0, "uri", value="/etc/hosts"), "names '/etc/hosts', which does not lie in the"),
        (
            at("tracks.gltf", "buffers", 0, "uri", value="data:a/b,%00"),
            "a buffer in it is not in base64: 'data:a/b,%00'",
        ),
        (
            at("tracks.gltf", "buffers", 0, "uri", value="data:a/b;base64,AAAA"),
            "tracks.gltf: cut off; copy the project",
        ),
        (at("tracks.gltf", "nodes", 0, "children", value=[0]), "tracks.gltf: node 0 is its own parent"),
        (
            at("tracks.gltf", "nodes", 0, value={"mesh": 0, "rotation": [0] * 4}),
            "node 0: rotation: a quaternion of zeros",
        ),
        (at("tracks.gltf", *MATCHES, "cameraUids", value=[]), "its points have matches that are not there"),
        (at("tracks.gltf", "accessors", 4, "count", value=3), "its points have matches that are not there"),
        (at("tracks.gltf", "bufferViews", 4, "byteStride", value=16), "its buffers are interleaved"),
        (at("tracks.gltf", "accessors", 0, "byteOffset", value=4), "its buffers are interleaved"),
        (at("tracks.gltf", "nodes", 0, "matrix", value=[1, 2]), "matrix: [1, 2], where 16 finite numbers belong"),
        (at("../survey.opf", "items", 2, "resources", 0, "uri", value="https://a/b.json"), "is not on this machine"),
        (at("../survey.opf", "items", 2, "resources", 0, "uri", value="parts/lost.json"), "lost.json: no such file"),
    ],
)
def test_opf_that_is_refused(tmp_path, change, said):
    opf(tmp_path, change=change)
    with pytest.raises(BadInput) as caught:
        read(Data(tmp_path))
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert str(caught.value).count(";") <= 1, "advice once"
