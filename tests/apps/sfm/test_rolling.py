"""Rolling shutters: a simulated flight whose rows have poses of their own, against the same with a global shutter."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from flight import FOCAL, HEIGHT, WIDTH, Flight, reconstructed
from listening import listening
from PIL import Image

from surfkit.apps.sfm import rolling_shutter, row_adjustment
from surfkit.apps.sfm.camera_motion import motion_of, seconds
from surfkit.apps.sfm.control_list import GroundControl, GroundControlPoint
from surfkit.apps.sfm.dataset_export import undistorted
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.exif import TAKEN_TAG, Exif, facts
from surfkit.apps.sfm.georeference import MapProjection, centres_of
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.readout_times import known_readout
from surfkit.apps.sfm.rolling_shutter import LensReadout, RollingShutter, correct, correct_once, refuse_timeless, still
from surfkit.apps.sfm.row_motion import RowMotion
from surfkit.apps.sfm.settings import Settings
from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.core.events import Progress
from surfkit.scene.earth import from_utm
from surfkit.testing.write_exif import write_exif
from tests.apps.sfm.pictures import looking, picture, save

READOUT_S, EACH_S = 0.1, 1.5
"""A long readout, as the photographs are small: 8 m/s are 3 px from the first row to the last."""


def at(moment):
    """(3,) centre of the camera: five strips, flown to and fro, at 8 m/s that vary by 20 %."""
    way = 8 * (moment + 0.4 * (1 - np.cos(0.5 * moment)))
    strip = min(int(way // 120), 4)
    along = way - 120 * strip - 60
    return np.array([along * (1 - 2 * (strip % 2)), 25.0 * (strip - 2), 60.0])


def flown(readout, noise=0.2):
    """The flight with a readout time, seconds, and the photographs, with times and positions."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-90, 90, 500), rng.uniform(-80, 80, 500), np.zeros(500)])
    points[:, 2] = 6 * np.sin(points[:, 0] / 20) * np.cos(points[:, 1] / 15)
    moments = [m for m in np.arange(0.7, 74, EACH_S * 2) if abs(at(m)[0]) < 55]
    turns, centres, seen = [], [], []
    turn = np.array([[0, -1.0, 0], [-1, 0, 0], [0, 0, -1]])
    for moment in moments:
        pixels = np.full((len(points), 2), HEIGHT / 2.0)
        for _ in range(6):
            when = moment + readout * (pixels[:, 1] / HEIGHT - 0.5)
            ray = (points - np.stack([at(one) for one in when])) @ turn.T
            pixels = FOCAL * ray[:, :2] / ray[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        inside = (pixels >= 0).all(1) & (pixels < (WIDTH, HEIGHT)).all(1)
        turns.append(turn)
        centres.append(at(moment))
        seen.append((np.flatnonzero(inside), (pixels + rng.normal(0, noise, pixels.shape))[inside]))
    flight, photos = Flight(points, turns, np.array(centres), seen), {}
    for name, moment, centre in zip(flight.names, moments, centres, strict=True):
        latitude, longitude = (float(v) for v in from_utm(500_000 + centre[0], 5_800_000 + centre[1], 33, False))
        moment += 60 * round(centre[1] / 25)  # turns take a minute
        exif = Exif(
            taken=f"2024:05:01 12:{30 + int(moment // 60):02}:{moment % 60:05.2f}",
            focal_px=FOCAL,
            position=(latitude, longitude, float(centre[2])),
            camera="MADE BY US",
        )
        photos[name] = Photo(name, (0, 0), size=(WIDTH, HEIGHT), exif=exif)
    return flight, photos


@pytest.fixture(scope="module")
def rolled():
    flight, photos = flown(READOUT_S)
    return flight, photos, reconstructed(flight)


def shape_error(flight, model):
    """RMS distance of the cameras from the truth after the best similarity, metres."""
    from surfkit.apps.sfm.similarity import umeyama

    centres = centres_of(model)
    ours = np.stack([centres[name] for name in flight.names])
    left = umeyama(ours, flight.centres, np.ones(len(ours))).points(ours) - flight.centres
    return float(np.sqrt((left**2).sum(1).mean()))


@pytest.mark.parametrize("readout", [1000 * READOUT_S, "auto"])
def test_the_correction_comes_to_what_a_global_shutter_comes_to(rolled, readout):
    flight, photos, model = rolled
    whole = reconstructed(flown(0.0)[0])
    found, what = correct(model, photos, Settings(readout=readout))
    before, ideal = (one.compute_mean_reprojection_error() for one in (model, whole))
    after = found.compute_mean_reprojection_error()
    assert before > ideal + 0.2, "what is lost without"
    assert after < ideal + 0.02
    assert shape_error(flight, found) < 1.2 * shape_error(flight, whole) + 0.02 < shape_error(flight, model)
    [lens] = what.lenses.values()
    assert lens.estimate_ms[0] == pytest.approx(1000 * READOUT_S, rel=0.04 if readout == "auto" else 0.1)
    assert lens.source == ("--readout" if readout != "auto" else "estimated from the photographs")
    assert not what.doubts() and set(what.motions) == set(flight.names)
    speed = np.array(what.motions[flight.names[4]].share) * 60 / READOUT_S
    assert np.linalg.norm(speed[:2]) == pytest.approx(8, rel=0.25) and abs(speed[2]) < 1


def test_a_global_shutter_is_left_alone(tmp_path):
    flight, photos = flown(0.0)
    model = reconstructed(flight)
    found, what = correct(model, photos, Settings())
    assert found is model and not what.motions
    assert what.why in (
        "the photographs show no rolling shutter",
        "correcting it does not make the photographs agree better",
    )
    assert abs(what.lenses["1"].estimate_ms[0]) < 5


def test_of_many_photographs_some_tell_the_readout_time_and_all_are_corrected(rolled, monkeypatch):
    flight, photos, model = rolled
    looked = []

    class Watched(row_adjustment.RowAdjustment):
        def __init__(self, part, *rest):
            looked.append(sorted(part.image(number).name for number in part.reg_image_ids()))
            super().__init__(part, *rest)

    monkeypatch.setattr(rolling_shutter, "RowAdjustment", Watched)
    monkeypatch.setattr(rolling_shutter, "MAX_SEARCHED", 14)
    found, what = correct(model, photos, Settings())
    some, everyone = looked
    assert len(flight.names) > 18 and some == sorted(flight.names)[(len(flight.names) - 14) // 2 :][:14]
    assert everyone == sorted(flight.names) == sorted(what.motions)
    assert what.lenses["1"].estimate_ms[0] == pytest.approx(1000 * READOUT_S, rel=0.1)
    assert found.compute_mean_reprojection_error() < model.compute_mean_reprojection_error() - 0.15
    assert model.num_reg_images() == len(flight.names), "the model itself is whole"


def test_adjustments_are_told_as_they_are_done(rolled, monkeypatch):
    """Each takes long where there are thousands of photographs."""
    _, photos, model = rolled
    left = iter([model] * 7)
    monkeypatch.setattr(row_adjustment, "adjust", lambda *_: next(left, None))
    with listening(Progress) as told:
        search = row_adjustment.RowAdjustment(model, photos, Settings())
        search.estimate(dict.fromkeys(model.cameras))
        assert search.final(dict.fromkeys(model.cameras, READOUT_S)) is None
    looked = [Progress("looking for a rolling shutter", done, 5) for done in range(1, 6)]
    assert told == [*looked, *(Progress("correcting the rolling shutter", done, 5) for done in (1, 2, 5))]


def test_a_drone_of_known_readout_time_that_stops_is_left_alone():
    flight, photos = flown(0.0)  # as it stops for each photograph, all rows see from one place
    model = reconstructed(flight)
    known = {name: replace(photo, exif=replace(photo.exif, camera="DJI FC220")) for name, photo in photos.items()}
    found, what = correct(model, known, Settings())
    assert found is model and what.why == "correcting it makes the photographs agree less"
    _, what = correct(model, photos, Settings(readout=64.0))
    assert any("did the drone stop for each photograph" in doubt for doubt in what.doubts())


def test_off_returns_the_model_as_it_is(rolled, tmp_path):
    _, photos, model = rolled
    found, what = correct_once(model, photos, Settings(readout="off"), tmp_path / "rolling")
    assert found is model and what == RollingShutter(why="--readout off") and not (tmp_path / "rolling").exists()


def test_what_was_corrected_is_kept(rolled, tmp_path, monkeypatch):
    _, photos, model = rolled
    settings = Settings(readout=1000 * READOUT_S)
    found, what = correct_once(model, photos, settings, tmp_path / "rolling")
    monkeypatch.setattr("surfkit.apps.sfm.rolling_shutter.correct", None)
    again, same = correct_once(model, photos, settings, tmp_path / "rolling")
    assert same == what
    one, other = (np.stack([point.xy for point in each.image(3).points2D]) for each in (found, again))
    assert np.array_equal(one, other)


def test_a_wrong_readout_time_is_told(rolled):
    _, photos, model = rolled
    [doubt, *_] = correct(model, photos, Settings(readout=40.0))[1].doubts()
    assert re.search(r"of MADE BY US fit a readout time of (9|10)\d \+- \d ms better than 40 ms \(--readout\)", doubt)


def test_photographs_without_times(rolled):
    _, photos, model = rolled
    timeless = {name: replace(photo, exif=replace(photo.exif, taken=None)) for name, photo in photos.items()}
    with pytest.raises(
        BadInput, match="--readout 30 needs to know .*, and EXIF has no times of the photographs; write"
    ):
        refuse_timeless(list(timeless.values()), Settings(readout=30.0))
    refuse_timeless(list(photos.values()), Settings(readout=30.0))
    with pytest.raises(BadInput, match="--readout 30 needs to know .* no two photographs were taken within 15 s"):
        correct(model, timeless, Settings(readout=30.0))
    found, what = correct(model, timeless, Settings())
    assert found is model and what.why == "EXIF has no times of photographs within 15 s of each other"
    nowhere = {name: replace(photo, exif=replace(photo.exif, position=None)) for name, photo in photos.items()}
    assert correct(model, nowhere, Settings())[1].why == "cameras of unknown readout time have no known speed"


@pytest.mark.parametrize("readout", [0.5, 0.0, 700.0])
def test_no_camera_reads_so_fast_or_slowly(readout):
    with pytest.raises(BadInput, match="--readout .*: milliseconds from the first row to the last, 1 to 500"):
        Settings(readout=readout)


def test_known_readout_times():
    def photo(camera, size=(4032, 3024)):
        return Photo("a", (0, 0), size=size, exif=Exif(camera=camera))

    assert known_readout(photo("DJI FC220")).ms == 64
    assert known_readout(photo("DJI FC8482")).ms == 21
    assert known_readout(photo("DJI FC8482", (8064, 6048))).ms == 58
    assert known_readout(photo("DJI FC8482", (1000, 1000))) is None, "of no size that somebody measured"
    assert known_readout(photo(None)) is None and known_readout(photo("DJI FC6310")) is None


def test_speeds_of_xmp_and_times_of_exif():
    xmp = {"FlightXSpeed": 3.0, "FlightYSpeed": -4.0, "FlightZSpeed": 0.0}
    assert facts({}, {}, {}, xmp, (10, 10)).speed == 5
    assert facts({}, {}, {}, {"FlightXSpeed": 3.0}, (10, 10)).speed is None
    assert seconds("2024:05:01 12:00:01.25") - seconds("2024:05:01 11:59:59") == 2.25
    assert seconds("0000:00:00 00:00:00") is None and seconds(None) is None


def test_speeds_of_the_path_and_of_xmp():
    flight, photos = flown(0.0)
    twice = {name: 2 * centre for name, centre in zip(flight.names, flight.centres, strict=True)}
    motion = motion_of(twice, photos)
    assert motion.unit == pytest.approx(0.5, rel=1e-3) and motion.speed == pytest.approx(8, rel=0.1)
    hover = {name: replace(photo, exif=replace(photo.exif, speed=0.0)) for name, photo in photos.items()}
    assert not any(each.vector.any() for each in motion_of(twice, hover).velocities.values()), "it stops for each"


def test_marks_go_where_the_middle_row_would_have_seen_them():
    motion = RowMotion((0.03, 0.0, 0.0), ((1.0,) * 12,) * 9)
    camera = load_engine().Camera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2, 0.0], camera_id=1
    )
    model = type("Model", (), {"images": {1: type("Image", (), {"name": "a.jpg", "camera": camera})}})
    point = GroundControlPoint("P", (0.0, 0.0, 0.0), {"a.jpg": (100.0, HEIGHT), "b.jpg": (1.0, 2.0)})
    ground = GroundControl([point], MapProjection("EPSG:32633", (0, 0, 0)), np.zeros((1, 3)), "EPSG:32633")
    rolling = RollingShutter({"1": LensReadout(None, 30.0, "")}, {"a.jpg": motion})
    [moved] = still(ground, model, rolling).points
    assert moved.marks["a.jpg"] == pytest.approx((100 + 0.015 * FOCAL, HEIGHT)) and moved.marks["b.jpg"] == (1.0, 2.0)


def test_a_photograph_becomes_that_of_a_global_shutter():
    params = [FOCAL, WIDTH / 2, HEIGHT / 2, -0.05]
    camera = load_engine().Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    share = np.array([0.02, -0.03, 0.005])  # of a plane at depth 1: up to 3 px
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.column_stack([x.ravel(), y.ravel()])

    def taken(motion):
        own = (pixels[:, 1:] / HEIGHT - 0.5) * motion
        rays = np.column_stack([camera.cam_from_img(pixels), np.ones(len(pixels))])
        ground = own + rays * (1 - own[:, 2:])  # where the ray of each row meets the plane
        value = 128 + 60 * np.sin(30 * ground[:, 0]) * np.cos(24 * ground[:, 1])
        return np.repeat(value.reshape(HEIGHT, WIDTH, 1), 3, 2).round().astype(np.uint8)

    rng = np.random.default_rng(0)
    spots = rng.uniform((0, 0), (WIDTH, HEIGHT), (300, 2))
    motion = RowMotion.fitted(share * 50, spots, np.full(300, 50.0), (WIDTH, HEIGHT))
    wanted = undistorted(taken(np.zeros(3)), camera, None).astype(float)[8:-8, 8:-8]
    made = undistorted(taken(share), camera, motion).astype(float)[8:-8, 8:-8]
    left = undistorted(taken(share), camera, None).astype(float)[8:-8, 8:-8]
    assert made.shape == wanted.shape and np.abs(made - wanted).mean() < 0.6 and np.abs(made - wanted).max() < 4
    assert np.abs(left - wanted).mean() > 4
    back = motion.seen_at_once(motion.sources(np.array([[0.3, -0.2], [-0.4, 0.3]]), camera), camera)
    assert back == pytest.approx(camera.img_from_cam(np.array([[0.3, -0.2, 1], [-0.4, 0.3, 1]])), abs=1e-3)


def moved_right(picture, other, top):
    """By how many pixels a band of 30 rows of a picture is to the right of that of another, by least squares."""
    shifts = np.arange(-6, 7)
    middle = np.arange(20, 210)
    costs = [((picture[top : top + 30, middle + s] - other[top : top + 30, middle]) ** 2).mean() for s in shifts]
    best = int(np.clip(np.argmin(costs), 1, len(shifts) - 2))
    before, here, after = costs[best - 1 : best + 2]
    return shifts[best] + 0.5 * (before - after) / (before - 2 * here + after)


def test_prepared_photographs_are_those_of_global_shutters(tmp_path):
    names = [f"{number}.jpg" for number in range(7)]
    angles = 0.16 * np.arange(7)
    poses = [looking((15 * np.cos(a), 15 * np.sin(a), 11)) for a in angles]
    root, still_pictures = tmp_path / "photos", {}
    for number, (name, pose, angle) in enumerate(zip(names, poses, angles, strict=True)):
        motion = 0.3 * np.array([-np.sin(angle), np.cos(angle), 0])  # 2.4 m/s for 125 ms: 4 px
        still_pictures[name] = picture(pose)
        taken = f"2024:05:01 12:00:{10 + number:02}"
        write_exif(save(root / name, picture(pose, motion=motion)), camera={TAKEN_TAG: taken})

    def prepared(readout):
        scene = tmp_path / f"scene {readout}"
        given = ["--max-features", "1500", "--readout", readout, "--out", str(scene)]
        assert main(["prepare", "photos", str(root), *given]) == 0
        shears = []
        for name in names:
            made = np.asarray(Image.open(scene / "images" / name).convert("L"), np.float64)
            wanted = still_pictures[name][..., 0].astype(np.float64)
            shears.append(abs(moved_right(made, wanted, 30) - moved_right(made, wanted, 120)))
        return json.loads((scene / "report.json").read_text())["models"][0]["rolling_shutter"], np.mean(shears)

    plain, left = prepared("off")
    assert plain["corrected"] == 0 and plain["why_not"] == "--readout off"
    facts, made = prepared("125")
    assert facts["corrected"] == 7 and 3 < facts["first_to_last_row_px"] < 5
    assert facts["lenses"][0]["ms"] == 125 and facts["lenses"][0]["source"] == "--readout"
    assert left > 1.7 and made < 0.4, "of 2.3 px between two bands, half the height apart"
