"""Cameras of photogrammetry programs show known dots where the formulas of these programs put them."""

import re
from functools import partial

import numpy as np
import program_files as programs
import pyproj
import pytest
from PIL import Image
from program_files import (
    COLORS,
    DOTS,
    HEIGHT,
    ORIGIN,
    POSES,
    WIDTH,
    axes,
    bundler,
    metashape,
    openmvg,
    pix4d,
    realitycapture,
)

from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.geocentric import place_of
from surfkit.io.datasets.read import observations, read, read_capture, reader_of
from surfkit.io.splats.ply import write_points
from surfkit.runs.run_notes import collect_notes
from surfkit.runs.warn import warn_of_gaps
from surfkit.scene.earth import geocentric

BROWN = {"k1": -0.09, "k2": 0.06, "k3": -0.03}
CASES = {
    "metashape": partial(metashape, cx=4.3, cy=-2.6, b1=1.4, p1=0.003, p2=-0.002, **BROWN),
    "metashape k4": partial(metashape, cx=4.3, k4=0.02, p1=0.001, b2=0.05, **BROWN),
    "metashape fisheye": partial(metashape, kind="fisheye", cx=-3, k1=0.03, k2=-0.01, k3=0.004, k4=-0.001),
    "metashape decentred fisheye": partial(metashape, kind="fisheye", cy=5, k1=0.03, p1=0.004, p2=-0.002),
    "pix4d": partial(pix4d, offset=(0, 0, 0), cx=114, cy=77.5, R1=-0.1, R2=0.07, R3=-0.02, T1=0.003, T2=-0.002),
    "realitycapture": partial(realitycapture, px=0.02, py=-0.015, t1=0.003, t2=-0.002, **BROWN),
    "realityscan": partial(realitycapture, newer=True, px=0.01, k4=0.02, **BROWN),
    "bundler": bundler,
    **{f"openmvg {kind}": partial(openmvg, kind=kind) for kind in programs.OPENMVG},
}


def spots(view, at):
    """Where the middle of the spot near each (P, 2) pixel of an undistorted photograph is; nan near its border."""
    grey = np.asarray(Image.open(view.path).convert("L"), float)
    found = []
    for x, y in at:
        left, top = int(x) - 4, int(y) - 4
        part = grey[max(top, 0) : top + 9, max(left, 0) : left + 9]
        v, u = np.mgrid[top : top + 9, left : left + 9] + 0.5 if part.shape == (9, 9) else (np.nan, np.nan)
        weight = part if part.shape == (9, 9) else 1.0
        found.append((np.sum(u * weight) / np.sum(weight), np.sum(v * weight) / np.sum(weight)))
    return np.array(found)


@pytest.mark.parametrize("case", CASES)
def test_dots_lie_where_the_program_puts_them(tmp_path, case):
    project = CASES[case](tmp_path)
    data = Data(tmp_path, test_every=0)
    capture, scene = read_capture(data, reader_of(data)), read(data)
    assert len(capture.shots) == len(scene.train) == len(POSES)
    off, near = [], 0.05 if "k4" in case or case == "realityscan" else 1e-6
    for shot, view in zip(capture.shots, scene.train, strict=True):
        name = shot.name if shot.name.endswith(".png") else f"{shot.name}.png"
        pixels = project(name, DOTS)
        local = DOTS @ shot.pose[:3, :3].T + shot.pose[:3, 3]
        np.testing.assert_allclose(np.asarray(shot.camera.img_from_cam(local)), pixels, atol=near)
        c, inner = view.camera, scene.frame.to_local(DOTS) @ view.camera.world_to_camera.numpy()[:3, :3].T
        inner = inner + view.camera.world_to_camera.numpy()[:3, 3]
        straight = np.stack([c.fx * inner[:, 0], c.fy * inner[:, 1]], 1) / inner[:, 2:] + (c.cx, c.cy)
        shown = ((pixels > 6) & (pixels < (WIDTH - 6, HEIGHT - 6))).all(1)
        off.append(np.linalg.norm(spots(view, straight[shown]) - straight[shown], axis=1))
    off = np.concatenate(off)
    assert np.isfinite(off).sum() > 40 and np.nanmax(off) < 0.25, "the spots of the undistorted photographs"


@pytest.mark.parametrize("write", [bundler, openmvg])
def test_sparse_points_keep_their_tracks(tmp_path, write):
    project = write(tmp_path)
    data = Data(tmp_path, test_every=0)
    with collect_notes() as kept:
        scene = read(data)
    assert any("1 of 5 photographs are left out, which have no" in text and "IMG 9.png" in text for text in kept.texts)
    np.testing.assert_allclose(scene.frame.to_input(scene.cloud.xyz.numpy()), DOTS, atol=1e-5)
    colors = COLORS if write is bundler else np.full(DOTS.shape, 128)
    np.testing.assert_array_equal(scene.cloud.rgb.numpy(), colors)
    tracks = reader_of(data).tracks(data)
    assert tracks.error_px.max() < 1e-6 and tracks.seen.keys() == POSES.keys()
    for name, (rows, pixels) in tracks.seen.items():
        np.testing.assert_allclose(pixels, project(name, DOTS[rows]), atol=1e-9)
    seen = observations(data, scene)
    for view in scene.train:
        at, inverse = seen.of(view)
        local = scene.frame.to_local(DOTS) @ view.camera.world_to_camera.numpy()[2, :3]
        depth = local + view.camera.world_to_camera.numpy()[2, 3]
        assert len(at) >= 10 and np.isin(np.round(inverse, 9), np.round(1 / depth, 9)).all()


def test_points_that_no_track_connects_make_groups(tmp_path):
    def cut(contents):
        for row, point in enumerate(contents["structure"]):
            kept = (0, 1, 2) if row % 2 else (3,)
            point["value"]["observations"] = [o for o in point["value"]["observations"] if o["key"] in kept]

    openmvg(tmp_path, change=cut)
    groups = read_capture(Data(tmp_path), reader_of(Data(tmp_path))).groups
    assert [sorted(group) for group in groups] == [["IMG 1.png", "IMG 2.png", "IMG 3.png"], ["IMG 4.png"]]


def test_points_in_a_file_beside_the_cameras(tmp_path):
    realitycapture(tmp_path)
    with collect_notes() as kept:
        read(Data(tmp_path))
    assert [text for text in kept.texts if "no sparse points: training starts from 50000 random ones" in text]
    write_points(tmp_path / "points3D.ply", DOTS, COLORS.astype(np.uint8))
    np.testing.assert_allclose(read_capture(Data(tmp_path), reader_of(Data(tmp_path))).xyz, DOTS, atol=1e-5)


def test_positions_of_realitycapture_in_degrees_are_suspected(tmp_path):
    def degrees(text):
        head, *lines = text.splitlines()
        split = [line.split(",") for line in lines]
        for words in split:
            words[1:3] = [str(8.9 + float(words[1]) / 75_000), str(47.5 + float(words[2]) / 111_000)]
        return "\n".join([head, *map(",".join, split)])

    for change, wanted in ((degrees, ["x and y differ by 0.00012 and heights by 4: if these are degrees"]), (str, [])):
        realitycapture(tmp_path, change=change)
        with collect_notes() as kept:
            read(Data(tmp_path))
        assert [
            text.partition("csv: ")[2].partition(", export")[0] for text in kept.texts if "degrees" in text
        ] == wanted


def test_pix4d_on_the_map(tmp_path):
    origin = ORIGIN + 0.25  # is nearly always a whole number, but need not be
    pix4d(tmp_path, offset=origin)
    params = tmp_path / "1_initial/params"
    (params / "survey_wkt.prj").write_text(UTM32)
    scene = read(Data(tmp_path, test_every=0))
    assert (scene.frame.crs, scene.frame.metres, scene.frame.shift) == ("EPSG:32632", 1.0, tuple(origin))
    np.testing.assert_allclose(centres(scene), [origin + centre for _, centre in POSES.values()], atol=1e-6)
    (params / "survey_offset.xyz").unlink()
    lines = ["imageName X Y Z Omega Phi Kappa"]
    for name, (_, centre) in POSES.items():
        lines.append(" ".join([name, *(f"{value:.6f}" for value in origin + centre), "0", "0", "0"]))
    (params / "survey_calibrated_external_camera_parameters.txt").write_text("\n".join(lines))
    np.testing.assert_allclose(centres(read(Data(tmp_path, test_every=0))), centres(scene), atol=1e-5)
    (params / "survey_calibrated_external_camera_parameters.txt").unlink()
    with collect_notes() as kept:
        read(Data(tmp_path))
    assert any("no survey_offset.xyz beside it" in text for text in kept.texts)


def centres(scene):
    poses = [scene.frame.input_pose(view.camera.world_to_camera) for view in scene.train]
    return np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])


WGS84 = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984 ensemble",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY['
    '"EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.01745329251994328,AUTHORITY["EPSG","9102"]],AUTHORITY["EPSG","4326"]]'
)
UTM32 = (
    f'PROJCS["WGS 84 / UTM zone 32N",{WGS84},PROJECTION["Transverse_Mercator"],PARAMETER["central_meridian",9],'
    'PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],UNIT["metre",1,AUTHORITY["EPSG","9001"]],'
    'AUTHORITY["EPSG","32632"]]'
)
SWISS = (
    'PROJCS["CH1903+ / LV95",GEOGCS["CH1903+",DATUM["CH1903+",SPHEROID["Bessel 1841",6377397.155,299.1528128]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Hotine_Oblique_Mercator_Azimuth_Center"],'
    'UNIT["metre",1],AUTHORITY["EPSG","2056"]]'
)
VERTICAL = f'COMPD_CS["WGS 84 + EGM96",{WGS84},VERT_CS["EGM96 height",VERT_DATUM["EGM96 geoid",2005],UNIT["metre",1]]]'
LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'


@pytest.mark.parametrize(
    ("text", "crs", "ellipsoid"),
    [
        (UTM32, "EPSG:32632", "WGS84"),
        (WGS84, "EPSG:32632", "WGS84"),
        (VERTICAL, "EPSG:32632", "WGS84"),
        (SWISS, "EPSG:2056", "bessel"),
    ],
)
def test_metashape_on_the_map(tmp_path, text, crs, ellipsoid):
    """From the Earth's centre, on the datum of the chunk, to its map as PROJ goes there."""
    place = pyproj.Transformer.from_pipeline(f"+proj=cart +ellps={ellipsoid}")
    corner, (phi, lam) = np.array(place.transform(8.9, 47.5, 430.0, radians=False)), np.radians([47.5, 8.9])
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0])
    earth = np.stack([east, np.cross(up, east), up], 1)  # of the dots: metres about the corner
    onto, move, scale = axes(20, 30, 40), np.array([3.0, -2.0, 1.0]), 0.37

    def row(values):
        return " ".join(repr(float(value)) for value in np.ravel(values))

    transform = f"<transform><rotation>{row(earth @ onto)}</rotation><translation>{row(corner + earth @ move)}"
    transform += f"</translation><scale>{scale!r}</scale></transform>"
    head = f'<components next_id="1" active_id="0"><component id="0" label="C">{transform}</component></components>\n'
    tail = f"<reference>{text}</reference>\n"
    project = metashape(tmp_path, head=head, tail=tail, place=(onto, move, scale), k1=-0.05)
    with collect_notes() as kept:
        scene = read(Data(tmp_path, test_every=0))
    assert (scene.frame.crs, scene.frame.metres) == (crs, 1.0)
    assert any("heights are those above the ellipsoid, not 'EGM96 height'" in t for t in kept.texts) == (
        text == VERTICAL
    )
    target = pyproj.CRS(crs)
    flat = pyproj.Transformer.from_crs(target.geodetic_crs, target, always_xy=True)

    def mapped(points):
        longitude, latitude, height = place.transform(
            *(corner + points @ earth.T).T, direction="INVERSE", radians=False
        )
        return np.column_stack([*flat.transform(longitude, latitude), height])

    np.testing.assert_allclose(centres(scene), mapped(np.stack([c for _, c in POSES.values()])), atol=3e-3)
    shots = read_capture(Data(tmp_path), reader_of(Data(tmp_path))).shots
    for shot in shots:
        local = mapped(DOTS) @ shot.pose[:3, :3].T + shot.pose[:3, 3]
        np.testing.assert_allclose(
            np.asarray(shot.camera.img_from_cam(local)), project(f"{shot.name}.png", DOTS), atol=0.1
        )


def test_cameras_far_apart_on_the_map_are_told_how_far_the_earth_bends():
    centres = geocentric(np.full(3, 47.0), 9.0 + np.array([-0.02, 0.0, 0.02]), np.full(3, 500.0))
    with collect_notes() as kept:
        place = place_of("x", UTM32, centres)
    off = 0.5 * np.array([1521**2, 0, 1521**2]) / 6.388e6  # a parallel of a radius of 4,357 km; the Earth's is 6,388 km
    heights = place.move.points(centres)[:, 2]
    np.testing.assert_allclose(heights.max() - heights, off, atol=2e-3)
    (said,) = (text for text in kept.texts if "the Earth is round" in text)
    assert "outermost camera, coordinates are 0.18 m off" in said, said
    with collect_notes() as kept:
        place_of("x", UTM32, centres[1:])
    assert not kept.texts
    pole = np.array([[0, 0, 6.4e6]])  # a camera that is wrong
    with collect_notes() as kept:
        place_of("x", UTM32, np.concatenate([np.tile(centres, (3000, 1)), pole]))
    (said,) = kept.texts
    assert re.search(r"coordinates are \d\.\d\d m off", said), said


def test_metashape_in_local_coordinates(tmp_path):
    onto, move, scale = axes(10, 0, 90), np.array([5.0, 6.0, 7.0]), 2.5
    numbers = " ".join(repr(float(value)) for value in onto.ravel())
    text = f"<transform><rotation locked='1'>{numbers}</rotation><translation>5 6 7</translation><scale>2.5</scale>"
    metashape(tmp_path, tail=f"{text}</transform><reference>{LOCAL}</reference>", place=(onto, move, scale))
    scene = read(Data(tmp_path, test_every=0))
    assert (scene.frame.crs, scene.frame.metres) == (None, None)
    np.testing.assert_allclose(centres(scene), [centre for _, centre in POSES.values()], atol=1e-6)


def test_cameras_of_metashape_that_are_left_out(tmp_path):
    def change(text):
        text = text.replace('label="IMG 2"', 'label="IMG 2" enabled="false"')
        return text.replace('component_id="0" label="IMG 3"', 'component_id="1" label="IMG 3"')

    metashape(tmp_path, change=change)
    with collect_notes() as kept:
        scene = read(Data(tmp_path, test_every=0))
    assert [view.name for view in scene.train] == ["IMG 1", "IMG 4"]
    for text in (
        "1 of 5 photographs are left out, which are disabled: 'IMG 2'",
        "1 of 4 photographs are left out, which have no pose of their own (not aligned, or slaves of another camera): "
        "'IMG 7'",
        "1 of 3 photographs are left out, which are in another component, not aligned with the largest: 'IMG 3'",
    ):
        assert any(text in note for note in kept.texts), text


def test_groups_of_metashape_name_the_folders_of_equal_labels(tmp_path):
    """A camera that numbers its photographs anew in each folder."""

    def change(text):
        text = text.replace('label="IMG 3"', 'label="IMG 1"').replace('label="IMG 4"', 'label="IMG 2"')
        before, _, after = text.partition("</cameras>")
        head, *cameras = re.split(r"(?=<camera )", before)
        groups = {"100MEDIA": cameras[:2], "101MEDIA": cameras[2:4]}
        told = [f'<group label="{label}" type="folder">{"".join(each)}</group>' for label, each in groups.items()]
        return "".join([head, *told, *cameras[4:], "</cameras>", after])

    metashape(tmp_path, change=change)
    files = {path.stem: path for path in (tmp_path / "images").iterdir()}
    names = ["100MEDIA/IMG 1", "100MEDIA/IMG 2", "101MEDIA/IMG 1", "101MEDIA/IMG 2"]
    for at, name in enumerate(names, 1):
        place = tmp_path / "images" / f"{name}{files[f'IMG {at}'].suffix}"
        place.parent.mkdir(exist_ok=True)
        files[f"IMG {at}"].rename(place)
    scene = read(Data(tmp_path, test_every=0))
    assert [view.name for view in scene.train] == names
    assert [view.path.parent.name for view in scene.train] == ["100MEDIA", "100MEDIA", "101MEDIA", "101MEDIA"]


@pytest.mark.parametrize("program", [metashape, bundler])
def test_missing_photographs_of_other_programs_are_skipped(tmp_path, program):
    program(tmp_path)
    sorted(path for path in tmp_path.rglob("*") if path.suffix.lower() in (".jpg", ".png"))[1].unlink()
    with pytest.raises(BadInput, match="1 of 4 .*missing: .*--missing skip"):
        read(Data(tmp_path))
    with collect_notes() as kept:
        scene = read(Data(tmp_path, test_every=0, missing="skip"))
    told = "1 of 4 photographs are missing and are skipped"
    assert len(scene.train) == 3 and any(told in text for text in kept.texts)


def test_terms_that_colmap_has_not(tmp_path):
    metashape(tmp_path, k4=0.02, b2=-0.4, k1=-0.1)
    with collect_notes() as kept:
        read(Data(tmp_path))
    text = next(text for text in kept.texts if "no camera model of COLMAP has" in text)
    assert re.search(r"1 of 1 lenses .*\(k4, skew\): .*0\.1\d off", text), text
    with pytest.raises(BadInput, match=r"sensor 0: .*skew.* 1\.2"):
        metashape(tmp_path, b2=3.0)
        read(Data(tmp_path))


def words(old, new):
    def change(text):
        assert old in text, text
        return text.replace(old, new, 1)

    return change


def entry(*path, value):
    def change(contents):
        for key in path[:-1]:
            contents = contents[key]
        contents[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("write", "text"),
    [
        (partial(metashape, change=words("<chunk", "<chunk<")), "cameras.xml: not XML"),
        (partial(metashape, change=words("<document", "<!DOCTYPE x><document")), "has definitions of its own"),
        (partial(metashape, kind="cylindrical"), "sensor 0: of type cylindrical; known: frame, fisheye"),
        (partial(metashape, change=words("<f>190.0</f>", "<fx>190</fx>")), "sensor 0: no f in its calibration"),
        (
            partial(metashape, change=words("<f>190.0</f>", "<f>wide</f>")),
            "sensor 0: f: 'wide', where a finite number belongs",
        ),
        (partial(metashape, change=words("<f>190.0</f>", "<f>-1</f>")), "sensor 0: no lens has size 220 x 160"),
        (partial(metashape, change=words('<sensor id="0"', '<sensor id="1"')), "sensor 0: no calibration of it"),
        (
            partial(metashape, change=words("<transform>", "<transform>1 ")),
            "camera 'IMG 1': '1 .*, where 16 finite numbers",
        ),
        (partial(metashape, change=words("<transform>", "<transform>9")), "camera 'IMG 1': .*rotation"),
        (partial(metashape, change=words('label="IMG 2"', 'label="IMG 1"')), "IMG 1' stand for two"),
        (partial(metashape, change=words('label="IMG 2"', 'label="IMG 5"')), "1 of 4 .*missing: 'IMG 5'"),
        (partial(metashape, change=lambda t: t.replace("transform", "nothing")), "all 5 photographs have no pose"),
        (partial(metashape, tail="<transform><scale>0</scale></transform>"), "transform of the chunk: its scale is 0"),
        (
            partial(metashape, tail="<transform/><reference>PROJCS[</reference>"),
            "reference: .*pyproj reads: missing ];",
        ),
        (
            partial(metashape, tail="<transform/><reference>x</reference>"),
            "pyproj reads: Invalid WKT string: x",
        ),
        (partial(pix4d, change=words("0 0 1\n", "0 1 1\n")), "IMG 1.png: the camera matrix has entries below"),
        (partial(pix4d, change=words("radial distortion [3x1]", "fisheye poly [4x1]")), "only perspective cameras are"),
        (partial(pix4d, change=lambda t: t[: len(t) // 2]), "each takes 10: cut off"),
        (partial(pix4d, change=words("fileName", "name")), "does not begin with 'fileName imageWidth imageHeight'"),
        (partial(pix4d, change=words("IMG 1.png 220", "IMG 1.png wide")), "no photograph with"),
        (partial(pix4d, offset=(np.nan, 0, 0)), "survey_offset.xyz: 'nan 0 0.*', where 3 finite numbers belong"),
        (partial(realitycapture, change=words(",t1,t2", ",t1")), "it lacks t2; export it as"),
        (partial(realitycapture, change=words(",12.0,", ",north,")), "IMG 1.png: .*, where 15 finite numbers belong"),
        (partial(realitycapture, change=words("IMG 2.png,", "IMG 2.png,1,")), "line 3 has 17 values, not 16"),
        (partial(realitycapture, f=0), "IMG 1.png: no lens has size 220 x 160"),
        (partial(bundler, change=words("v0.3", "v0.4")), "'# Bundle file v0.4', not with"),
        (partial(bundler, change=words("5 20", "5 21")), "cut off or damaged at point 21 of 21"),
        (partial(bundler, change=words("5 20", "50 20")), "cut off: numbers of"),
        (partial(bundler, change=words("190 -0.1", "x -0.1")), "something that is no number"),
        (partial(bundler, change=words("190 -0.1", "nan -0.1")), "camera of 'IMG 1.png': focal length nan"),
        (partial(bundler, change=words("190 -0.1", "1e-320 -0.1")), "camera .* of IMG 1.png has size 220 x 160"),
        (partial(bundler, listed=lambda name: "" if "9" in name else name), "names 4 photographs, bundle.out has 5"),
        (partial(openmvg, change=entry("extrinsics", value=[])), "sfm_data.json: no extrinsics"),
        (partial(openmvg, change=entry("views", 0, "value", value=[])), "damaged, or not of OpenMVG: TypeError"),
        (
            partial(openmvg, change=entry("intrinsics", 0, "value", "polymorphic_name", value="spherical")),
            "intrinsic 0: of kind spherical; known: pinhole,",
        ),
        (
            partial(
                openmvg, change=entry("extrinsics", 1, "value", "rotation", value=[[1, 0, 0], [0, 1, 0], [0, 0, 2]])
            ),
            "pose of 'IMG 2.png': .*rotation",
        ),
        (partial(openmvg, change=entry("structure", 3, "value", "X", value=[1, 2])), "damaged, or not of OpenMVG"),
    ],
)
def test_what_is_damaged_or_cannot_be_kept(tmp_path, write, text):
    write(tmp_path)
    with pytest.raises(BadInput, match=text) as caught:
        read(Data(tmp_path))
    assert "\n" not in str(caught.value)


def test_two_exports_in_a_folder_need_a_choice(tmp_path):
    realitycapture(tmp_path)
    metashape(tmp_path)
    with pytest.raises(BadInput, match="metashape or realitycapture; .*--layout"):
        read(Data(tmp_path))
    assert read(Data(tmp_path, layout="metashape", test_every=0)).train[0].name == "IMG 1"
    metashape(tmp_path)
    (tmp_path / "cameras.xml").rename(tmp_path / "b.xml")
    metashape(tmp_path)
    with pytest.raises(BadInput, match="several .*'b.xml', 'cameras.xml'"):
        read(Data(tmp_path, layout="metashape"))


@pytest.mark.parametrize("layout", ["metashape", "pix4d", "realitycapture", "bundler"])
def test_a_folder_without_cameras_of_the_chosen_layout(tmp_path, layout):
    (tmp_path / "images").mkdir()
    with pytest.raises(BadInput, match=r"no .*(file|bundle\.out).*; (export|copy) "):
        read(Data(tmp_path, layout=layout))


def test_photographs_beside_the_cameras_or_elsewhere(tmp_path):
    realitycapture(tmp_path)
    (tmp_path / "images").rename(tmp_path / "flight")
    with pytest.raises(BadInput, match="4 of 4 photographs are missing"):
        (tmp_path / "flight").rename(tmp_path.parent / "flight")
        read(Data(tmp_path))
    (tmp_path.parent / "flight").rename(tmp_path / "flight")
    assert len(read(Data(tmp_path, images="flight", test_every=0)).train) == 4
    for path in (tmp_path / "flight").iterdir():
        path.rename(tmp_path / path.name)
    assert len(read(Data(tmp_path, test_every=0)).train) == 4


def test_where_a_bundle_file_and_its_list_may_lie(tmp_path):
    bundler(tmp_path)
    (tmp_path / "bundle.out").rename(tmp_path / "flight.bundle.out")  # as COLMAP names them
    (tmp_path / "list.txt").rename(tmp_path / "flight.list.txt")
    assert len(read(Data(tmp_path, test_every=0)).train) == 4
    (tmp_path / "bundle").mkdir()
    (tmp_path / "flight.bundle.out").rename(tmp_path / "bundle/bundle.out")  # as Bundler does
    with pytest.raises(BadInput, match="no list .*list.txt"):
        read(Data(tmp_path))
    (tmp_path / "flight.list.txt").rename(tmp_path / "list.txt")
    assert len(read(Data(tmp_path, test_every=0)).train) == 4


def test_doctor_says_once_what_a_lens_lacks_and_what_to_do_without_points(tmp_path, capsys):
    metashape(tmp_path)
    assert main(["doctor", str(tmp_path), "--quick", "--probe", "0"]) == 0
    said = capsys.readouterr().out
    assert "1 of 5 photographs are left out" in said and "spelt otherwise" not in said
    assert "no sparse points" in said and f"`surfkit prepare points {tmp_path}` makes a data set" in said
    metashape(tmp_path, change=words("<f>190.0</f>", "<f>wide</f>"))
    assert main(["doctor", str(tmp_path), "--quick", "--probe", "0"]) == 2
    said = capsys.readouterr().out
    assert said.count("where a finite number belongs") == 1 and "more like it" not in said


@pytest.mark.parametrize("program", [realitycapture, bundler])
def test_a_file_beside_the_cameras_says_which_map_they_are_on(tmp_path, program):
    project = program(tmp_path)
    (tmp_path / "georeference.json").write_text(f'{{"crs": "EPSG:32632", "offset": {ORIGIN.tolist()}}}')
    data = Data(tmp_path)
    capture = read_capture(data, reader_of(data))
    assert (capture.crs, capture.metres, capture.shift) == ("EPSG:32632", 1.0, tuple(ORIGIN))
    for shot in capture.shots:
        local = (DOTS + ORIGIN) @ shot.pose[:3, :3].T + shot.pose[:3, 3]
        assert np.allclose(shot.camera.img_from_cam(local), project(shot.name, DOTS), atol=0.05)
    if program is bundler:
        scene = read(data)
        seen = observations(data, scene).xyz
        assert np.abs(seen - scene.frame.to_local(DOTS + ORIGIN)).max() < 1e-6 * np.abs(seen).max()
    both = read_capture(Data(tmp_path, test_data=tmp_path), reader_of(data))
    same = {shot.name.rpartition("/")[2]: [] for shot in both.shots}
    for shot in both.shots:
        same[shot.name.rpartition("/")[2]].append(shot.pose)
    assert all(len(poses) == 2 and (poses[0] == poses[1]).all() for poses in same.values())
    (tmp_path / "georeference.json").write_text('{"crs": "EPSG:32632", "metres_per_unit": 0}')
    with pytest.raises(BadInput, match="georeference.json"):
        read(data)


def test_what_files_leave_out_is_found_where_the_file_names_no_offset(tmp_path):
    """Coordinates of an export are those of the map already; float32 cannot hold them."""
    realitycapture(tmp_path, change=moved_to_the_map)
    (tmp_path / "georeference.json").write_text('{"crs": "EPSG:32632", "offset": [0, 0, 0]}')
    with collect_notes() as notes:
        scene = read(Data(tmp_path))
        assert not any("leave out the offset" in text for text in notes.texts)
        for state in (None, object()):  # a run that begins, and one that goes on
            warn_of_gaps(scene, state)
    assert sum("leave out the offset" in text for text in notes.texts) == 1
    frame = scene.frame
    assert frame.crs == "EPSG:32632" and np.abs(np.array(frame.shift[:2]) - ORIGIN[:2]).max() < 1e4


def test_the_unit_of_a_map_is_that_of_its_system(tmp_path):
    """US survey feet, unless the file says otherwise; where it contradicts the system, a line does."""
    realitycapture(tmp_path)
    place = '{"crs": "EPSG:2263", "offset": [980000, 200000, 0]%s}'
    (tmp_path / "georeference.json").write_text(place % "")
    with collect_notes() as notes:
        assert read(Data(tmp_path)).frame.metres == pytest.approx(1200 / 3937, rel=1e-12)
    assert not any("EPSG:2263" in text for text in notes.texts)
    (tmp_path / "georeference.json").write_text(place % ', "metres_per_unit": 1')
    with collect_notes() as notes:
        assert read(Data(tmp_path)).frame.metres == 1
    assert any("EPSG:2263 is in units of US survey foot" in text for text in notes.texts)


def moved_to_the_map(text):
    head, *rows = text.splitlines()
    words = [row.split(",") for row in rows]
    moved = [[w[0], *(repr(float(v) + float(o)) for v, o in zip(w[1:4], ORIGIN, strict=True)), *w[4:]] for w in words]
    return "\n".join([head, *(",".join(row) for row in moved)]) + "\n"


def test_two_that_name_the_map_are_refused(tmp_path):
    pix4d(tmp_path)
    (tmp_path / "1_initial/params/survey_wkt.prj").write_text(UTM32)
    (tmp_path / "georeference.json").write_text('{"crs": "EPSG:32632", "offset": [0, 0, 0]}')
    with pytest.raises(BadInput, match="delete this file"):
        read_capture(Data(tmp_path), reader_of(Data(tmp_path)))


def resized(folder, by):
    for path in sorted((folder / "images").iterdir()):
        with Image.open(path) as image:
            image.resize((round(image.width * by), round(image.height * by))).save(path)


@pytest.mark.parametrize("by, told", [(0.5, "outside of 4 of 4 photographs"), (0.8, "outside of"), (1.0, None)])
def test_a_bundle_file_of_photographs_of_another_size(tmp_path, by, told):
    """The file has no sizes: marks of points that lie outside show that the photographs were larger."""
    bundler(tmp_path)
    resized(tmp_path, by)
    if told is None:
        assert len(read(Data(tmp_path, test_every=0)).train) == 4
    else:
        with pytest.raises(BadInput, match=f"{told}.*smaller"):
            read(Data(tmp_path, test_every=0))


def test_a_bundle_file_of_photographs_that_were_enlarged(tmp_path, monkeypatch):
    monkeypatch.setattr("surfkit.io.datasets.bundler.MIN_INNER_MARKS", 20)
    bundler(tmp_path)
    for by, count in ((1.0, 0), (2.0, 1)):
        resized(tmp_path, by)
        with collect_notes() as notes:
            read(Data(tmp_path, test_every=0))
        assert len([text for text in notes.texts if "all marks of points lie in the inner" in text]) == count
