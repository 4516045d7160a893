"""Control points in the bundle adjustment: simulated blocks whose ground is known, wrong marks, wrong places, files."""

import csv
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from flight import FOCAL, HEIGHT, NOISE_PX, WIDTH, fly, reconstructed

from surfkit.apps.sfm.bundle_adjustment import adjust
from surfkit.apps.sfm.control_adjustment import adjust_to_points, adjust_to_points_once, clean_marks, said_of
from surfkit.apps.sfm.control_list import GroundControl, GroundControlPoint, read_ground, read_list
from surfkit.apps.sfm.control_marks import (
    WrongMark,
    images_of,
    mark_residuals,
    projected,
    size_ratio,
    triangulate,
    without_wrong_marks,
)
from surfkit.apps.sfm.control_report import MARK_COLUMNS, POINT_COLUMNS, point_rows, warnings_of, write_tables
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.georeference import MapProjection, centres_of
from surfkit.apps.sfm.ground_control import ControlResiduals, place_by_points
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.survey_observations import CameraPositions, SurveyedPoint, Weights, adjust_together
from surfkit.core.check import BadInput
from surfkit.io.datasets.topocentric import Similarity
from surfkit.scene.earth import from_utm

CHART = MapProjection("EPSG:32633", (500_000.0, 5_800_000.0, 0.0))
SETTINGS = Settings(gcp=Path("gcp_list.txt"), mark_sigma=NOISE_PX, checkpoint_names=("C0", "C1", "C2", "C3"))
CONTROL = [(-65, -55), (65, -55), (65, 55), (-65, 55), (0, 0), (-20, 50)]
CHECKS = [(-30, -25), (30, -20), (25, 28), (-35, 22)]


def ground(x, y):
    return np.array([x, y, 5 * np.sin(x / 25) * np.cos(y / 20)])


def listed(flight):
    """Control points and checkpoints with marks."""
    rng, points = np.random.default_rng(1), []
    for at, (x, y) in enumerate(CONTROL + CHECKS):
        name, xyz, marks = f"G{at}" if at < len(CONTROL) else f"C{at - len(CONTROL)}", ground(x, y), {}
        for photo, turn, centre in zip(flight.names, flight.turns, flight.centres, strict=True):
            ray = turn @ (xyz - centre)
            flat = ray[:2] / ray[2]
            pixel = FOCAL * flat + (WIDTH / 2, HEIGHT / 2)
            if (pixel > 0).all() and (pixel < (WIDTH, HEIGHT)).all():
                marks[photo] = tuple((pixel + rng.normal(0, NOISE_PX, 2)).tolist())
        points.append(GroundControlPoint(name, tuple((xyz + CHART.offset).tolist()), marks))
    return GroundControl(points, CHART, np.array([ground(x, y) for x, y in CONTROL + CHECKS]), "EPSG:32633")


def changed(given, name, place=(0, 0, 0), photo=None, pixels=(0, 0)):
    """The list with another place of a point, and another mark."""
    points, onto = list(given.points), given.onto.copy()
    at = next(at for at, point in enumerate(points) if point.name == name)
    onto[at] += place
    marks = dict(points[at].marks)
    if photo is not None:
        marks[photo] = tuple((np.array(marks[photo]) + pixels).tolist())
    points[at] = replace(points[at], marks=marks, xyz=tuple((onto[at] + CHART.offset).tolist()))
    return replace(given, points=points, onto=onto)


def placed(flight, model, given, settings=SETTINGS):
    """A model by the similarity of its points, where these are then, and the list without wrong marks."""
    engine = load_engine()
    model = engine.Reconstruction(model)
    clean, wrong = clean_marks(model, given, settings)
    where = place_by_points(model, clean, 0, settings.checkpoint_names)
    near = where.similarity
    model.transform(engine.Sim3d(near.scale, engine.Rotation3d(near.turn), near.move))
    return model, replace(where, wrong_marks=tuple(wrong)), clean


def off(where):
    """Root mean square of the checkpoints, metres."""
    return float(np.sqrt(np.mean([np.square(where.residuals[name]).sum() for name in where.checkpoints])))


@pytest.fixture(scope="module")
def flown():
    flight = fly(tilt_deg=2, oblique=True)
    return flight, reconstructed(flight)


def done(flight, model, given, tmp_path, settings=SETTINGS):
    model, where, clean = placed(flight, model, given, settings)
    return adjust_to_points_once(model, where, clean, flight.photos(FOCAL), settings, tmp_path / "c")


def test_positions_weigh_as_in_the_adjustment_of_pycolmap(flown):
    flight, model = flown
    sigma = np.array([0.5, 0.5, 1.02])
    onto = flight.centres + np.random.default_rng(4).normal(0, sigma, flight.centres.shape)
    model, _, _ = placed(flight, model, listed(flight))
    ours = adjust_together(
        model, [], CameraPositions(flight.names, onto, np.tile(sigma, (30, 1))), Weights(1, 1, 1, {})
    )
    engine = load_engine()
    theirs, config, priors = engine.Reconstruction(model), engine.BundleAdjustmentConfig(), []
    for number, xyz in zip(theirs.reg_image_ids(), onto, strict=True):
        config.add_image(number)
        prior = engine.PosePrior()
        prior.corr_data_id, prior.position = theirs.image(number).data_id, xyz
        prior.position_covariance = np.diag(sigma**2)
        prior.coordinate_system = engine.PosePriorCoordinateSystem.CARTESIAN
        priors.append(prior)
    options, trust = engine.BundleAdjustmentOptions(), engine.PosePriorBundleAdjustmentOptions()
    options.print_summary = False
    engine.create_pose_prior_bundle_adjuster(options, trust, config, priors, theirs).solve()
    found, wanted = centres_of(ours.model), centres_of(theirs)
    moved = centres_of(model)
    for name in flight.names:
        assert np.linalg.norm(found[name] - wanted[name]) < 0.03 < np.linalg.norm(moved[name] - wanted[name])


def test_a_place_counts_by_its_standard_deviation(flown):
    flight, model = flown
    given = listed(flight)
    model, _, _ = placed(flight, model, given)
    weights, away = Weights(NOISE_PX, NOISE_PX, 1.0, {}), []
    for sigma in (0.001, 0.05, 50.0):
        row = np.full(3, sigma)
        points = [
            SurveyedPoint(onto, onto + (0, 0, 0.2), row, p.marks)
            for p, onto in zip(given.points, given.onto, strict=True)
        ]
        points[0] = replace(points[0], place=points[0].place + (0, 0, 0.3))
        new = adjust_together(model, points, None, weights).model
        first = max(model.points3D) + 1 + len(new.points3D) - len(model.points3D) - len(points)
        away.append(float(new.points3D[first].xyz[2] - points[0].place[2]))
    assert abs(away[0]) < 0.001 and -0.25 < away[1] < -0.03 and away[2] < -0.25


def test_a_bent_block_is_straightened(tmp_path):
    flight = fly(tilt_deg=1)
    photos = flight.photos(1.05 * FOCAL)
    model = adjust(reconstructed(flight), None, photos, SETTINGS)
    model, where, clean = placed(flight, model, listed(flight))
    before = off(where)
    found, after = adjust_to_points_once(model, where, clean, photos, SETTINGS, tmp_path / "c")
    assert found is not None and before > 0.4 and off(after) < 0.3 * before
    assert len(after.control) == 6 and not after.wrong and not after.wrong_marks
    again, same = adjust_to_points_once(model, where, clean, photos, SETTINGS, tmp_path / "c")
    assert same == after and [list(c.params) for c in again.cameras.values()] == [
        list(c.params) for c in found.cameras.values()
    ]
    other, _ = adjust_to_points(model, where, clean, photos, SETTINGS)
    assert all((a == b).all() for a, b in zip(centres_of(other).values(), centres_of(found).values(), strict=True))


def test_a_wrong_mark_is_named_and_its_point_stays(flown, tmp_path):
    flight, model = flown
    given = listed(flight)
    photo = sorted(given.points[1].marks)[1]
    found, where = done(flight, model, changed(given, "G1", photo=photo, pixels=(3, -4)), tmp_path)
    (mark,) = where.wrong_marks
    assert found is not None and (mark.point, mark.photograph, mark.certain) == ("G1", photo, True)
    assert mark.pixels == pytest.approx(5, abs=1.5) and photo not in where.marks["G1"]
    assert "G1" in where.control and not where.wrong
    (line,) = warnings_of(where)
    assert f"mark of 'G1' in '{photo}' is left out" in line and f"{mark.pixels:.1f} px away" in line
    assert off(where) < 0.15


def test_a_wrong_place_is_told_from_a_wrong_mark(flown, tmp_path):
    flight, model = flown
    for move in ((0.6, 0, 0), (0, 0, -4.0)):
        found, where = done(flight, model, changed(listed(flight), "G4", place=move), tmp_path)
        assert found is not None and where.wrong == ("G4",) and not where.wrong_marks
        assert where.residuals["G4"] == pytest.approx(move, abs=0.2)
        (line,) = warnings_of(where)
        assert "1 ground control points contradict" in line and "G4" in line and "the marks of each agree" in line
        assert off(where) < 0.15


def test_checkpoints_have_no_say(flown, tmp_path):
    flight, model = flown
    first, _ = done(flight, model, listed(flight), tmp_path)
    other, where = done(flight, model, changed(listed(flight), "C1", place=(5, 0, 0)), tmp_path)
    assert all((a == b).all() for a, b in zip(centres_of(first).values(), centres_of(other).values(), strict=True))
    assert where.residuals["C1"][0] == pytest.approx(5, abs=0.2) and not where.wrong


def test_two_marks_that_contradict_each_other_both_go(flown):
    flight, model = flown
    point = listed(flight).points[4]
    names = sorted(point.marks)[:2]
    two = replace(point, marks={name: point.marks[name] for name in names})
    images = images_of(model)
    assert without_wrong_marks(images, [two], NOISE_PX) == ([two], [])
    x, y = two.marks[names[0]]
    ahead = images[names[0]].projection_center() - images[names[1]].projection_center()
    across = np.cross(images[names[0]].viewing_direction(), ahead)
    aside = images[names[0]].cam_from_world().rotation.matrix() @ across
    aside = 12 * aside[:2] / np.linalg.norm(aside[:2])
    two = replace(two, marks={**two.marks, names[0]: (x + aside[0], y + aside[1])})
    (kept,), wrong = without_wrong_marks(images, [two], NOISE_PX)
    assert not kept.marks and [mark.certain for mark in wrong] == [False, False]
    assert sum(mark.pixels for mark in wrong) == pytest.approx(12, abs=3)


def test_marks_of_smaller_photographs_are_noticed(flown):
    _, model = flown
    images, given = images_of(model), listed(flown[0])
    assert size_ratio(images, given.points) is None
    for ratio in (0.5, 0.8, 3.0):
        other = [replace(p, marks={n: (ratio * x, ratio * y) for n, (x, y) in p.marks.items()}) for p in given.points]
        assert size_ratio(images, other) == pytest.approx(ratio, rel=0.01)
        assert size_ratio(images, other[:2]) is None, "two points may fit any size by chance"
    with pytest.raises(BadInput, match=rf"about 9[56]\d x 7[12]\d.* {WIDTH} x {HEIGHT}; .*by 0.33"):
        clean_marks(model, replace(given, points=other), SETTINGS)


def test_marks_that_fit_at_no_size_are_of_these_photographs(flown):
    _, model = flown
    images, draw = images_of(model), np.random.default_rng(2)
    anywhere = [
        replace(point, marks={name: tuple(draw.uniform(0, (WIDTH, HEIGHT)).tolist()) for name in point.marks})
        for point in listed(flown[0]).points
    ]
    assert size_ratio(images, anywhere) is None


def test_marks_whose_rays_meet_behind_a_photograph_go(flown):
    """As of a point that was marked in two photographs the other way round."""
    _, model = flown
    point, images = listed(flown[0]).points[4], images_of(model)
    pairs = ({one: point.marks[other], other: point.marks[one]} for one, other in combinations(sorted(point.marks), 2))
    swapped = next(pair for pair in pairs if not mark_residuals(images, pair, triangulate(images, pair)))
    left, right = swapped
    (kept,), wrong = without_wrong_marks(images, [replace(point, marks=swapped)], NOISE_PX)
    assert not kept.marks and {mark.photograph for mark in wrong} == {left, right}
    assert not any(mark.certain for mark in wrong) and all(mark.pixels is None for mark in wrong)
    assert "contradict each other, as their rays do not meet in front" in "\n".join(warnings_of(control(wrong)))
    others = dict.fromkeys(sorted(point.marks.keys() - {left})[:2])
    three = {name: point.marks[name] for name in others} | {left: swapped[left]}
    (kept,), (mark,) = without_wrong_marks(images, [replace(point, marks=three)], NOISE_PX)
    assert kept.marks.keys() == others.keys() and mark.certain and mark.photograph == left


def control(wrong):
    """What is known where these marks are wrong."""
    return ControlResiduals(
        CHART, Similarity(1.0, np.eye(3), np.zeros(3)), {}, (), (), (), (), True, wrong_marks=tuple(wrong)
    )


def test_a_refusal_says_which_points_have_wrong_marks():
    pair = [WrongMark("G2", "a", 8.0, False), WrongMark("G2", "b", 4.0, False)]
    mistake, behind = WrongMark("G1", "a", 5000.0, True), WrongMark("G3", "b", None, False)
    assert said_of([]) == ""
    assert said_of([mistake, *pair]).endswith("'G1', 'G2'; if they are no more accurate, add --mark-sigma 6")
    assert said_of([mistake, behind]).endswith("are left out of 'G1', 'G3'"), "no accuracy explains them"
    assert said_of([replace(mark, pixels=40 * mark.pixels) for mark in pair]).endswith("'G2'")


def test_positions_of_photographs_keep_their_common_error(flown, tmp_path):
    flight, model = flown
    photos = flight.photos(FOCAL)
    rng = np.random.default_rng(2)
    for name, centre in zip(flight.names, flight.centres, strict=True):
        x, y, z = centre + CHART.offset + (2, -1, 40) + rng.normal(0, 0.5, 3)
        latitude, longitude = from_utm(np.array([x]), np.array([y]), 33, False)
        exif = replace(photos[name].exif, position=(float(latitude[0]), float(longitude[0]), float(z)))
        photos[name] = replace(photos[name], exif=exif)
    model, where, clean = placed(flight, model, listed(flight))
    _, after = adjust_to_points_once(model, where, clean, photos, SETTINGS, tmp_path / "c")
    assert after.adjustment["positions"] == 30
    assert after.adjustment["positions_offset_m"] == pytest.approx([2, -1, 40], abs=0.5)
    assert off(after) < 0.15
    _, without = adjust_to_points_once(model, where, clean, photos, replace(SETTINGS, gps=False), tmp_path / "c")
    assert without.adjustment["positions"] == 0 and without.adjustment["no_positions"] == "--no-gps"


def test_a_checkpoint_that_is_far_off_is_told(flown, tmp_path):
    flight, model = flown
    given = listed(flight)
    _, where = done(flight, model, given, tmp_path)
    assert not list(warnings_of(where))
    away = {**where.residuals, "C2": (3.0, 0.0, 4.0)}
    (line,) = warnings_of(replace(where, residuals=away))
    assert "1 checkpoints are off by more than 10 times" in line and "C2 (5.00 m)" in line


def test_tables_and_proposals(flown, tmp_path):
    flight, model = flown
    given = listed(flight)
    photo = sorted(given.points[1].marks)[1]
    gone = sorted(given.points[2].marks)[0]
    less = {name: at for name, at in given.points[2].marks.items() if name != gone}
    given = replace(given, points=[*given.points[:2], replace(given.points[2], marks=less), *given.points[3:]])
    given = changed(given, "G1", photo=photo, pixels=(3, -4))
    found, where = done(flight, model, given, tmp_path)
    write_tables(tmp_path, found, where, given)
    points = list(csv.DictReader((tmp_path / "control_points.csv").open()))
    assert tuple(points[0]) == POINT_COLUMNS and [row["role"] for row in points] == ["control"] * 6 + ["checkpoint"] * 4
    assert float(points[7]["residual_up_m"]) == pytest.approx(where.residuals["C1"][2], abs=1e-4)
    marks = list(csv.DictReader((tmp_path / "control_marks.csv").open()))
    assert tuple(marks[0]) == MARK_COLUMNS and len(marks) == sum(len(point.marks) for point in given.points)
    assert [(row["point"], row["photograph"]) for row in marks if row["used"] == "wrong"] == [("G1", photo)]
    crs, proposed = read_list(tmp_path / "proposed_marks.txt")
    assert crs == "EPSG:32633"
    marks = {point.name: point.marks for point in proposed}
    assert np.hypot(*np.subtract(marks["G2"][gone], listed(flight).points[2].marks[gone])) < 2
    assert np.hypot(*np.subtract(marks["G1"][photo], listed(flight).points[1].marks[photo])) < 2
    assert set(marks) == {"G1", "G2"}, "all other marks are there"
    rows = {row[0]: row[1:] for row in point_rows(where.facts())}
    assert set(rows) == {point.name for point in given.points} and rows["C3"][0] == "checkpoint"
    write_tables(tmp_path, found, None, None)
    assert not list(tmp_path.glob("*.csv")) and not (tmp_path / "proposed_marks.txt").exists()


def test_what_lies_behind_or_beyond_the_lens_is_not_proposed():
    camera = load_engine().Camera(model="SIMPLE_RADIAL", width=320, height=240, params=[222.0, 160, 120, -0.3])
    strong = type("Image", (), {"camera": camera, "cam_from_world": lambda self: load_engine().Rigid3d()})()
    assert projected(strong, np.array([0.3, 0.1, 1])) is not None
    assert projected(strong, np.array([2.5, 0.0, 1])) is None, "the lens folds there"
    assert projected(strong, np.array([0.3, 0.1, -1])) is None


def test_settings_and_names_that_will_not_do(tmp_path):
    with pytest.raises(BadInput, match="gcp_sigma"):
        Settings(gcp=Path("x"), gcp_sigma=0)
    with pytest.raises(BadInput, match="mark_sigma"):
        Settings(gcp=Path("x"), mark_sigma=1000)
    with pytest.raises(BadInput, match="--checkpoint-names holds back"):
        Settings(checkpoint_names=("A",))
    for alone in ({"gcp_sigma": 0.1}, {"gcp_sigma_up": 0.1}, {"mark_sigma": 1.0}):
        with pytest.raises(BadInput, match="--(gcp-sigma|gcp-sigma-up|mark-sigma) is .* which is not given"):
            Settings(**alone)
    with pytest.raises(BadInput, match="leave out one of the two"):
        Settings(gcp=Path("x"), checkpoints=1, checkpoint_names=("A",))
    lines = ["EPSG:32633", *(f"{x} {x * x} 3 4 5 {y}.jpg P{x}" for x in range(4) for y in range(2))]
    (tmp_path / "gcp.txt").write_text("\n".join(lines))
    sizes = dict.fromkeys(("0.jpg", "1.jpg"), (10, 10))
    with pytest.raises(BadInput, match="'Q' is not in --gcp .*'P0', 'P1'"):
        read_ground(tmp_path / "gcp.txt", "auto", sizes, 0, ("Q",))
    with pytest.raises(BadInput, match="2 of its 4 .* 3 are needed besides --checkpoint-names"):
        read_ground(tmp_path / "gcp.txt", "auto", sizes, 0, ("P1", "P2"))
