"""Ground control points: lists of OpenDroneMap, triangulation, similarities, checkpoints, and points that are wrong."""

import re
from dataclasses import replace

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from surfkit.apps.sfm.control_list import read_ground, read_list
from surfkit.apps.sfm.control_marks import triangulate
from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.georeference import NoSimilarity
from surfkit.apps.sfm.ground_control import doubts, place_by_points
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.survey_plausibility import upside_down
from surfkit.core.check import BadInput
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.earth import from_utm, utm

from .models import reconstruction
from .pictures import arc

OFFSET = np.array([512_000.0, 5_800_000.0, 90.0])
PLACES = np.random.default_rng(0).uniform(-6, 6, (9, 3)) * (1, 1, 0.2)
TURN = Rotation.from_rotvec([0.7, -0.2, 1.1]).as_matrix()
POSES = {f"{at}.jpg": pose for at, pose in enumerate(arc(5))}
SIZES = dict.fromkeys(POSES, (400, 400))  # room for what is just outside


def lens():
    params = [260.0, 120.0, 90.0, 0.05]
    return load_pycolmap().Camera(model="SIMPLE_RADIAL", width=240, height=180, params=params)


def pixels(place):
    rays = {name: pose[:3, :3] @ place + pose[:3, 3] for name, pose in POSES.items()}
    return {name: np.asarray(lens().img_from_cam(ray[None])).ravel() for name, ray in rays.items()}


def model():
    """The cameras in a frame that is turned, moved and of a tenth of the size, as pycolmap has them."""
    return reconstruction(POSES, PLACES, TURN, 0.1, (3, 4, 5), lens())


def written(path, first="EPSG:32633", places=PLACES, names=True):
    lines = [first, "# x y z px py photograph name", ""]
    for at, place in enumerate(places):
        x, y, z = place + OFFSET
        for photo, (across, down) in pixels(PLACES[at]).items():
            lines.append(f"{x:.4f}\t{y:.4f} {z:.4f} {across:.3f} {down:.3f} {photo}" + f" P{at}" * names)
    path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize("names", [True, False])
def test_a_list_is_read(tmp_path, names):
    crs, points = read_list(written(tmp_path / "gcp_list.txt", names=names))
    assert crs == "EPSG:32633" and len(points) == 9 and (points[3].name == "P3") == names
    assert points[3].xyz == pytest.approx(PLACES[3] + OFFSET, abs=1e-4)
    assert set(points[3].marks) == set(POSES) and points[3].marks["2.jpg"] == pytest.approx(
        pixels(PLACES[3])["2.jpg"], abs=1e-3
    )


def test_rays_meet_in_the_point():
    images = {image.name: image for image in map(model().image, model().reg_image_ids())}
    for place in PLACES:
        found = triangulate(images, pixels(place))
        np.testing.assert_allclose(found, 0.1 * TURN @ place + (3, 4, 5), atol=1e-6)
    assert triangulate(images, {"0.jpg": (10, 10), "elsewhere.jpg": (3, 3)}) is None


@pytest.mark.parametrize("first", ["epsg:32633", "WGS84 UTM 33n", "+proj=utm +zone=33 +ellps=WGS84 +units=m +no_defs"])
def test_points_place_the_model_and_checkpoints_check_it(tmp_path, first):
    ground = read_ground(written(tmp_path / "gcp_list.txt", first), "auto", SIZES)
    found = place_by_points(model(), ground, 3)
    assert found.chart.crs == "EPSG:32633" and found.similarity.scale == pytest.approx(10, rel=1e-4)
    assert len(found.control) == 6 and len(found.checkpoints) == 3 and not set(found.control) & set(found.checkpoints)
    assert max(found.rms(found.checkpoints).values()) < 0.005
    centre = found.similarity.points(np.array([[3.0, 4, 5]]))[0] + found.chart.offset
    np.testing.assert_allclose(centre, OFFSET, atol=0.01)


def test_a_checkpoint_has_no_say_and_a_wrong_point_is_found(tmp_path):
    places = PLACES.copy()
    path = tmp_path / "gcp_list.txt"
    held = place_by_points(model(), read_ground(written(path), "auto", SIZES), 1).checkpoints[0]
    places[int(held[1:])] += (0.5, 0, -1)
    found = place_by_points(model(), read_ground(written(path, places=places), "auto", SIZES), 1)
    assert found.residuals[held] == pytest.approx((0.5, 0, -1), abs=0.01)
    assert max(found.rms(found.control).values()) < 0.005
    places[int(found.control[2][1:])] += (0, 40, 0)
    wrong = place_by_points(model(), read_ground(written(path, places=places), "auto", SIZES), 1)
    assert wrong.wrong == (found.control[2],) and max(wrong.rms(wrong.control).values()) < 0.005


def test_degrees_come_to_utm(tmp_path):
    back = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
    lines = ["EPSG:4326"]
    for at, place in enumerate(PLACES[:4] + OFFSET):
        longitude, latitude = back.transform(*place[:2])
        assert utm(latitude, longitude, 33, False) == pytest.approx(place[:2], abs=1e-3)
        lines += [f"{longitude:.10f} {latitude:.10f} {place[2]} 1 2 {photo} P{at}" for photo in ("0.jpg", "1.jpg")]
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines))
    ground = read_ground(tmp_path / "gcp_list.txt", "auto", SIZES)
    np.testing.assert_allclose(ground.onto + ground.chart.offset, PLACES[:4] + OFFSET, atol=1e-3)
    (tmp_path / "gcp_list.txt").write_text("\n".join(["EPSG:4326+3855", *lines[1:]]))
    for wanted in ("auto", "EPSG:32633+3855"):
        with collect_notes() as notes:
            ground = read_ground(tmp_path / "gcp_list.txt", wanted, SIZES)
        np.testing.assert_allclose(ground.onto + ground.chart.offset, PLACES[:4] + OFFSET, atol=1e-3)
        assert any("above EGM2008 height, which the zone of UTM" in text for text in notes.texts) == (wanted == "auto")
    with pytest.raises(BadInput, match="'P0', 'P1', 'P2' and 6 more .*line 1, 'EPSG:4326'"):
        read_ground(written(tmp_path / "gcp_list.txt", "EPSG:4326"), "auto", SIZES)


@pytest.mark.parametrize(
    "first, crs, metres",
    [
        ("+proj=utm +south +zone=33 +datum=WGS84 +units=m +no_defs", "EPSG:32733", 1),
        ("+proj=utm +zone=33 +south +datum=WGS84 +units=m +no_defs", "EPSG:32733", 1),
        ("+proj=utm +zone=33 +ellps=intl +towgs84=-87,-98,-121,0,0,0,0 +units=m", None, 1),  # ED50, 150 m away
        ("+proj=utm +zone=33 +datum=NAD83 +units=us-ft +vunits=us-ft", None, 0.3048),
    ],
)
def test_other_systems_are_not_taken_for_utm_on_wgs84(tmp_path, first, crs, metres):
    ground = read_ground(written(tmp_path / "gcp_list.txt", first), "auto", SIZES)
    assert ground.chart.crs == (crs or first) and ground.chart.metres == pytest.approx(metres, rel=1e-5)


def test_photographs_of_equal_names_in_two_folders_are_told_apart(tmp_path, capsys):
    path = written(tmp_path / "gcp_list.txt")
    sizes = {f"{folder}/{name}": size for folder in ("100", "101") for name, size in SIZES.items()}
    with pytest.raises(BadInput, match="'0.jpg' .*'100/0.jpg', '101/0.jpg';"):
        read_ground(path, "auto", sizes)
    path.write_text(path.read_text().replace(" 0.jpg", " 101/0.jpg"))
    with collect_notes():
        ground = read_ground(path, "auto", dict.fromkeys(["101/0.jpg", "100/0.jpg", "b/1.jpg"], (400, 400)))
    assert set(ground.points[0].marks) == {"101/0.jpg", "b/1.jpg"}
    assert "3 of its photographs are not" in capsys.readouterr().err


def test_places_with_x_and_y_exchanged_or_of_another_zone_are_told(tmp_path):
    flat, offset = PLACES * (1, 1, 0), np.array([512_000.0, 580_000.0, 90.0])  # as if flat, and near the equator
    path = tmp_path / "gcp_list.txt"
    lines = ["EPSG:32633"]
    for at, place in enumerate(flat):
        x, y, z = place + offset
        lines += [f"{x} {y} {z} {a} {d} {photo} P{at}" for photo, (a, d) in pixels(place).items()]
    path.write_text("\n".join(lines))
    images = [model().image(number) for number in model().reg_image_ids()]
    centres = {image.name: np.asarray(image.projection_center()) for image in images}
    latitude, longitude = from_utm(*offset[:2], 33, False)
    near = Exif(position=(float(latitude), float(longitude), 120.0))
    photos = [Photo(name, (0, 0), exif=near) for name in centres]

    def told():
        found = place_by_points(model(), read_ground(path, "auto", SIZES), 0)
        assert max(found.rms(found.control).values()) < 0.01, "the residuals are no help"
        why = upside_down(model(), found.similarity, TURN @ (0, 0, 1), 1.0, found.handed)
        return [*([] if why is None else [why]), *doubts(found, centres, photos)]

    assert told() == []
    path.write_text("\n".join(lines).replace("EPSG:32633", "EPSG:32634"))
    (far,) = told()
    assert "EXIF: is EPSG:32634" in far
    exchanged = [lines[0]] + [" ".join([y, x, *rest]) for x, y, *rest in (line.split() for line in lines[1:])]
    path.write_text("\n".join(exchanged))
    upside, far = told()
    assert re.search("upside down, 1. m below .* view 3. degrees above", upside)
    assert "96 km from" in far
    low = [lines[0]] + [" ".join([x, y, str(float(z) - 500), *rest]) for x, y, z, *rest in map(str.split, lines[1:])]
    path.write_text("\n".join(low))
    sea, below = told()
    assert re.search("[34].. m below zero", sea)
    assert re.search("5.. m below their altitudes in EXIF", below)
    path.write_text("\n".join([lines[0]] + ["5" + line for line in exchanged[1:]]))  # where no zone reaches
    with pytest.raises(BadInput, match="x is east and y north"):
        read_ground(path, "auto", SIZES)


def test_heights_that_count_down_are_found_out(tmp_path):
    path, mirror = tmp_path / "gcp_list.txt", np.array([1, 1, -1])
    found = place_by_points(model(), read_ground(written(path, places=PLACES * mirror), "auto", SIZES), 0)
    assert isinstance(found, NoSimilarity) and "fit mirrored only, to 0.00 m for" in found.reason
    noise = np.random.default_rng(0).normal(0, 0.3, PLACES.shape)
    found = place_by_points(model(), read_ground(written(path, places=PLACES + noise), "auto", SIZES), 0)
    assert not isinstance(found, NoSimilarity)


def test_points_that_do_not_fit_at_all_place_nothing(tmp_path):
    places = np.random.default_rng(5).permutation(PLACES)
    found = place_by_points(model(), read_ground(written(tmp_path / "gcp_list.txt", places=places), "auto", SIZES), 0)
    assert isinstance(found, NoSimilarity) and "too large for" in found.reason
    far = written(tmp_path / "far.txt", places=30 * places)
    found = place_by_points(model(), read_ground(far, "auto", SIZES), 0)
    assert "too large for" in found.reason and "--gcp-sigma" not in found.reason, "no receiver is so inaccurate"


def test_points_as_inaccurate_as_stated_place_the_model_and_what_it_is_worth_is_told(tmp_path):
    places = PLACES + np.random.default_rng(3).normal(0, 1.5, PLACES.shape)
    ground = read_ground(written(tmp_path / "gcp_list.txt", places=places), "auto", SIZES)
    found = place_by_points(model(), ground, 0)
    assert isinstance(found, NoSimilarity)
    off, said = re.search(r"residuals of ([\d.]+) m a coordinate .*: '(\w+) .*--gcp-sigma", found.reason).groups()
    assert float(off) == pytest.approx(1.5, rel=0.5)
    stated = place_by_points(model(), ground, 0, sigma_m=1.5)
    assert max(stated.residuals, key=lambda name: np.linalg.norm(stated.residuals[name])) == said
    assert Settings(gcp=tmp_path, gcp_sigma=0.02, gcp_sigma_up=1.5).worst_gcp_sigma == 1.5
    away = abs(stated.similarity.scale / 10 - 1)
    assert 0.05 < stated.turn_error < 0.3 and away < 3 * stated.turn_error
    (doubt,) = doubts(stated, {"0.jpg": np.zeros(3)}, [])
    assert f"known to {100 * stated.turn_error:.0f} % only" in doubt


def test_heights_that_are_all_0_are_told(tmp_path):
    ground = read_ground(written(tmp_path / "gcp_list.txt"), "auto", SIZES)
    points = [replace(point, xyz=(*point.xyz[:2], 0.0)) for point in ground.points]
    flat = replace(ground, points=points, onto=ground.onto * (1, 1, 0) - (0, 0, ground.chart.offset[2]))
    found = place_by_points(model(), flat, 0, sigma_m=2.0)
    assert "all heights on the list are 0" in "\n".join(doubts(found, {"0.jpg": np.zeros(3)}, []))
    found = place_by_points(model(), ground, 0)
    assert not doubts(found, {"0.jpg": np.zeros(3)}, [])


def test_too_few_points_and_points_on_a_line(tmp_path):
    ground = read_ground(written(tmp_path / "gcp_list.txt"), "auto", SIZES)
    with pytest.raises(BadInput, match="9 of its 9 .* 3 .* 7 --checkpoints"):
        read_ground(tmp_path / "gcp_list.txt", "auto", SIZES, 7)
    found = place_by_points(model(), ground, 7)
    assert isinstance(found, NoSimilarity) and "3 are needed besides 7 checkpoints" in found.reason
    line = [np.array([at, 2 * at, 0.1 * at]) - 3 for at in range(4)]
    points = [type(ground.points[0])(f"P{at}", tuple(xyz), pixels(xyz)) for at, xyz in enumerate(line)]
    found = place_by_points(model(), replace(ground, points=points, onto=np.stack(line)), 0)
    assert isinstance(found, NoSimilarity) and "line" in found.reason


@pytest.mark.parametrize(
    "text, said",
    [
        ("", "empty"),
        ("EPSG:32633\n1 2 3 4 5", "line 2 is '1 2 3 4 5'"),
        ("EPSG:32633\n1 2 3 4 x a.jpg", "line 2"),
        ("EPSG:32633\n1 2 nan 4 5 a.jpg", "not finite"),
        ("EPSG:32633\n1 2 3 4 5 0.jpg P\n1 2 9 4 5 1.jpg P", "puts 'P' elsewhere"),
        (
            "EPSG:32633\n1 2 3 4 5 0.jpg P\n1 2 3 4 5 0.jpg P\n1 2 3 4 7 0.jpg P",
            "line 4 marks 'P' in '0.jpg' at 4 7, and a line before at 4 5; keep",
        ),
        ("EPSG:32633\n1 2 3 4 5 a.jpg", "none .*in the folder: 'a.jpg'"),
        ("EPSG:32633", "no points"),
        ("EPSG:32633\n1 2 3 4 500 0.jpg P", "'P' .*4 500 .*'0.jpg', .*400 x 400"),
        ("EPSG:32633\n1 2 3 4 5 0.jpg\n1 2 3 4 5 1.jpg", "1 of its 1 .*2 or more"),
        ("EPSG:32633" + "".join(f"\n{x} {x * x} 3 4 5 {y}.jpg" for x in range(3) for y in range(2)), "--crs EPSG:2180"),
    ],
)  # fmt: skip
def test_lists_that_will_not_do(tmp_path, text, said):
    (tmp_path / "gcp.txt").write_text(text)
    with pytest.raises(BadInput, match=said) as raised:
        read_ground(tmp_path / "gcp.txt", "EPSG:2180", SIZES)
    assert "\n" not in str(raised.value)
    with pytest.raises(BadInput, match="no such file"):
        read_list(tmp_path / "no.txt")
