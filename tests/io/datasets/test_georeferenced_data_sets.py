"""Where a data set lies on Earth, against PROJ, and that nothing of it is lost in files of float32."""

import json
import re

import numpy as np
import pytest
import torch
from data_set_folders import surveyed
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.opensfm import ODM
from surfkit.io.datasets.read import observations, read, read_capture
from surfkit.io.datasets.topocentric import place_on_earth
from surfkit.io.splats.ply import read_splats, read_vertices, write_splats
from surfkit.io.splats.splat_table import SplatTable
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.earth import utm
from surfkit.scene.scene import Frame
from surfkit.testing.synthetic import Flight, photograph, write_colmap

REFERENCE = {"latitude": 47.5, "longitude": 8.9, "altitude": 430.0}
PROJ_UTM = [  # pyproj 3.7, EPSG:4326 to EPSG:326zz and 327zz
    ((52.2, 21.0, 34, False), (500000.0, 5783283.161499563)),
    ((-33.9, 151.2, 56, True), (333568.9410115521, 6247473.33684402)),
    ((47.5, 8.9, 32, False), (492468.65733844985, 5260734.578714279)),
    ((69.6, 18.9, 34, False), (418319.8527741862, 7722670.3736588815)),
]
PROJ_LOCAL = [  # PROJ: +inv topocentric, +inv cart, utm zone 32, around REFERENCE
    ((0, 0, 0), (492468.65734, 5260734.57871, 430.0)),
    ((200, 0, 0), (492668.56386, 5260734.32148, 430.00313)),
    ((0, 200, 0), (492468.91458, 5260934.48519, 430.00314)),
    ((-150, 100, 20), (492318.85653, 5260834.72457, 450.00255)),
]


@pytest.mark.parametrize(("at", "wanted"), PROJ_UTM)
def test_utm_is_that_of_proj(at, wanted):
    np.testing.assert_allclose(utm(*at), wanted, atol=1e-4)


def project(folder, coords="WGS84 UTM 32N\n492000 5260000\n", reference=REFERENCE):
    (folder / "odm_georeferencing").mkdir(parents=True)
    (folder / "odm_georeferencing/coords.txt").write_text(coords)
    (folder / "opensfm").mkdir()
    (folder / "opensfm/reference_lla.json").write_text(json.dumps(reference))
    return place_on_earth(folder, folder / "opensfm", {}, 0.0)


def test_a_topocentric_reconstruction_comes_where_proj_puts_it(tmp_path):
    place = project(tmp_path)
    assert (place.crs, place.shift) == ("EPSG:32632", (492000.0, 5260000.0, 0.0))
    local, wanted = (np.array([pair[i] for pair in PROJ_LOCAL], float) for i in (0, 1))
    moved = place.moved.points(local)
    np.testing.assert_allclose(moved[:, :2], wanted[:, :2], atol=2e-3)
    np.testing.assert_allclose(moved[:, 2], wanted[:, 2], atol=2e-2, err_msg="heights are scaled too, by 0.05 %")


@pytest.mark.parametrize(("away", "said"), [(500.0, None), (1_000.0, 0.08), (2_500.0, 0.49), (5_000.0, 1.96)])
def test_how_far_the_earth_bends_below_a_reconstruction_is_told(tmp_path, away, said):
    """A camera that far from the reference is d^2 / 2 R lower on the round Earth than the similarity puts it."""
    model = {
        "cameras": {"c": {"projection_type": "perspective", "width": 40, "height": 30, "focal": 1}},
        "shots": {
            f"{at}.png": {"camera": "c", "rotation": [np.pi, 0, 0], "translation": translation}
            for at, translation in enumerate([[0.0, 0.0, 100.0], [-away, 0.0, 100.0], [0.0, 50.0, 100.0]])
        },
    }
    project(tmp_path)
    (tmp_path / "opensfm/reconstruction.json").write_text(json.dumps([model]))
    (tmp_path / "images").mkdir()
    for name in model["shots"]:
        Image.new("RGB", (40, 30), (90, 90, 90)).save(tmp_path / "images" / name)
    with collect_notes() as notes:
        capture = read_capture(Data(tmp_path), ODM())
    found = [text for text in notes.texts if "the Earth is round" in text]
    east = -capture.shots[1].pose[:3, :3].T @ capture.shots[1].pose[:3, 3] - capture.shift
    assert abs(east[0] - 468 - away) < 0.01 * away, "the case is one"
    if said is None:
        assert found == []
    else:
        off = float(re.search(r"'EPSG:32632' is flat: .* ([.\d]+) m off", found[0])[1])
        assert off == pytest.approx(said, abs=0.06), "the map is scaled too, heights with it"


def test_moving_changes_no_pixel(tmp_path):
    move = project(tmp_path).moved
    view, xyz = photograph(Flight(views=3, points=20)).scene.train[0], np.random.default_rng(0).normal(0, 9, (20, 3))
    pose = view.camera.world_to_camera.numpy()
    before = xyz @ pose[:3, :3].T + pose[:3, 3]
    new = move.pose(pose)
    after = move.points(xyz) @ new[:3, :3].T + new[:3, 3]
    np.testing.assert_allclose(after[:, :2] / after[:, 2:], before[:, :2] / before[:, 2:], atol=1e-7)
    np.testing.assert_allclose(new[:3, :3] @ new[:3, :3].T, np.eye(3), atol=1e-12)


ENU = "+proj=topocentric +ellps=WGS84 +lat_0=47.5 +lon_0=8.9 +h_0=430.0"


@pytest.mark.parametrize(
    ("text", "longitude", "crs"),
    [
        ("WGS84 UTM 56S\n333000 6247000\n", 151, "EPSG:32756"),
        ("+proj=utm +zone=7 +datum=WGS84 +units=m +no_defs\n1 2\n", -140, "EPSG:32607"),
        ("+proj=utm +zone=7 +south +datum=WGS84\n1 2\n", -140, "EPSG:32707"),
        ("WGS84 UTM 1N\n1 2\n", 179.9, "EPSG:32601"),
        ("EPSG:32632\n1 2\n", 8.9, "EPSG:32632"),
        ("EPSG:2056\n1 2\n", 8.9, ENU),
        ("+proj=utm +zone=32 +ellps=intl\n1 2\n", 8.9, ENU),
        ("", 8.9, ENU),
    ],
)
def test_zones_as_opendronemap_writes_them(tmp_path, text, longitude, crs):
    with collect_notes() as notes:
        assert project(tmp_path, text, REFERENCE | {"longitude": longitude}).crs == crs
    assert ("is no zone of UTM on WGS 84" in "".join(notes.texts)) == (crs == ENU and text != "")


def test_without_gps_there_is_no_place(tmp_path):
    assert project(tmp_path, reference=dict.fromkeys(REFERENCE, 0)) is None


@pytest.mark.parametrize(
    ("coords", "reference", "text"),
    [
        ("WGS84 UTM 32N\n1\n", REFERENCE, "coords.txt: line 2 is '1', not two numbers"),
        ("WGS84 UTM 32N\nnan 1\n", REFERENCE, "coords.txt: line 2 is 'nan 1', not two lengths on Earth"),
        ("WGS84 UTM 32N\n1e300 1\n", REFERENCE, "coords.txt: line 2 is '1e300 1', not two lengths on Earth"),
        ("WGS84 UTM 50N\n1 2\n", REFERENCE, "zone 50 of UTM is far from the reconstruction's 47.500000, 8.900000"),
        ("", [], "reference_lla.json: lacks latitude, longitude or altitude"),
        ("", REFERENCE | {"altitude": 1e300}, "47.5, 8.9 at 1e+300 m is no place"),
        ("", REFERENCE | {"longitude": float("nan")}, "47.5, nan at 430 m is no place"),
        ("WGS84 UTM 32N\n1 2\n", {"latitude": 1}, "reference_lla.json: lacks latitude, longitude or altitude"),
        ("WGS84 UTM 32N\n1 2\n", REFERENCE | {"latitude": 91}, "91, 8.9 at 430 m is no place"),
    ],
)
def test_damaged_georeferences(tmp_path, coords, reference, text):
    with pytest.raises(BadInput) as error:
        project(tmp_path, coords, reference)
    assert text in str(error.value)


def test_survey_coordinates_keep_their_precision(tmp_path):
    move = np.array([432_123.25, 5_412_345.5, 312.0])
    plain = read(Data(surveyed(tmp_path / "plain", np.zeros(3))))
    scene = read(Data(surveyed(tmp_path / "far", move), metres_per_unit=1))
    frame = scene.frame
    assert frame.shift == (432120.0, 5412350.0, 0.0)
    assert plain.frame.shift == (0, 0, 0) and frame.local_metres == pytest.approx(1 / frame.scale)
    np.testing.assert_allclose(scene.cloud.xyz, plain.cloud.xyz, atol=1e-6, err_msg="training sees the same scene")
    local = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    table = SplatTable("surfel", local, torch.ones(50, 4), *(torch.zeros(50, n) for n in (2,)), torch.zeros(50),
                       torch.zeros(50, 3), torch.zeros(50, 0, 3))  # fmt: skip
    write_splats(tmp_path / "a.ply", table.in_input_frame(frame), frame=frame)
    rows, comments = read_vertices(tmp_path / "a.ply")
    assert {"offset: 432120 5412350 0", "metres per unit: 1"} <= set(comments)
    exact = frame.to_input(local.numpy())
    np.testing.assert_allclose(frame.to_file(local.numpy()) + frame.shift, exact, atol=1e-8)
    read_back = read_splats(tmp_path / "a.ply").means
    np.testing.assert_allclose(read_back, exact, atol=1e-5, err_msg="a hundredth of a millimetre")
    assert np.abs(exact.astype(np.float32) - exact).max() > 0.05, "what plain float32 would have lost"


def test_an_offset_that_is_none(tmp_path):
    frame = Frame(np.zeros(3), 1.0, shift=(1e6, 0, 0))
    empty = [torch.zeros(1, n) for n in (3, 4, 2)]
    table = SplatTable("surfel", *empty, torch.zeros(1), torch.zeros(1, 3), torch.zeros(1, 0, 3))
    write_splats(tmp_path / "a.ply", table, frame=frame)
    path = tmp_path / "a.ply"
    path.write_bytes(path.read_bytes().replace(b"1000000 0 0", b"1000000 a 0"))
    with pytest.raises(BadInput, match="offset '1000000 a 0'.*three"):
        read_splats(path)


def test_the_unit_that_a_user_gives():
    with pytest.raises(BadInput, match="--metres-per-unit 0: .*more than 0"):
        Data(None, metres_per_unit=0)


PLACED = {"crs": "EPSG:25832", "offset": [451_234.5, 5_873_456.25, 37.0]}


@pytest.mark.parametrize("place", [".", "sparse", "sparse/0"])
def test_a_colmap_model_is_on_the_map_by_a_file_beside_it_or_above(tmp_path, place):
    write_colmap(tmp_path, photograph(Flight(views=3, width=40, height=30, points=20)))
    plain = read(Data(tmp_path))
    local = observations(Data(tmp_path), plain).xyz
    (tmp_path / place / "georeference.json").write_text(json.dumps(PLACED))
    scene = read(Data(tmp_path))
    assert (scene.frame.crs, scene.frame.metres, scene.frame.shift) == ("EPSG:25832", 1.0, tuple(PLACED["offset"]))
    np.testing.assert_allclose(scene.frame.origin, plain.frame.origin + PLACED["offset"], atol=1e-6)
    np.testing.assert_allclose(observations(Data(tmp_path), scene).xyz, local, atol=1e-6)


def test_heights_of_a_file_beside_a_model_may_have_a_system_of_their_own(tmp_path):
    write_colmap(tmp_path, photograph(Flight(views=3, width=40, height=30, points=20)))
    file = tmp_path / "georeference.json"
    file.write_text(json.dumps(PLACED | {"vertical_crs": "EPSG:7837"}))
    frame = read(Data(tmp_path)).frame
    assert (frame.crs, frame.metres) == ("EPSG:25832+7837", 1.0)
    for wrong in ({"vertical_crs": "sea level"}, {"vertical_crs": "EPSG:7837", "crs": "EPSG:25832+5773"}):
        file.write_text(json.dumps(PLACED | wrong))
        with pytest.raises(BadInput, match="vertical_crs .*EPSG:5773"):
            read(Data(tmp_path))


def test_two_files_that_put_a_colmap_model_in_two_places_are_refused(tmp_path):
    write_colmap(tmp_path, photograph(Flight(views=3, width=40, height=30, points=20)))
    for place in (".", "sparse/0"):
        (tmp_path / place / "georeference.json").write_text(json.dumps(PLACED))
    assert read(Data(tmp_path)).frame.crs == "EPSG:25832"
    (tmp_path / "georeference.json").write_text(json.dumps(PLACED | {"crs": "EPSG:25833"}))
    with pytest.raises(BadInput, match=r"sparse/0/georeference.json .*/georeference.json differ"):
        read(Data(tmp_path))
