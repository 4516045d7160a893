"""The focal length of EXIF and the heights of positions against photographs, on flights whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from flight import ALTITUDE, FOCAL, fly, reconstructed

from surfkit.apps.sfm.bundle_adjustment import adjust
from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.focal import Focal, height_stretch, weighed
from surfkit.apps.sfm.map_choice import readings
from surfkit.apps.sfm.positions import Positions
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.sfm_pipeline import SfmPreparation
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.earth import from_utm

CORNER = np.array([512_000.0, 5_800_000.0, 90.0])


def focal_of(model):
    return model.cameras[1].mean_focal_length()


def placed(flight, focal_px, folder, sigma=(2.0, 2.0, 4.0), stated=None):
    """What `surfkit prepare photos` makes of a flight: the model on the map, and what became of the focal length."""
    alone = reconstructed(flight)
    (folder / "model").mkdir()
    alone.write_binary(folder / "model")
    seen = flight.centres + np.random.default_rng(1).normal(0, 1, flight.centres.shape) * sigma + CORNER
    latitude, longitude = from_utm(seen[:, 0], seen[:, 1], 33, False)
    positions = np.column_stack([latitude, longitude, seen[:, 2]])
    photos = [
        replace(photo, exif=replace(photo.exif, position=tuple(place), accuracy_m=stated))
        for photo, place in zip(flight.photos(focal_px).values(), positions.tolist(), strict=True)
    ]
    preparation, given = SfmPreparation(folder, folder / "scene", Settings()), Positions(photos)
    with collect_notes():
        [(model, _, found, _)] = preparation._place([folder / "model"], given, readings(given, "auto"))
    return alone, model, found


def test_a_nadir_flight_keeps_the_focal_length_of_exif(tmp_path, capsys):
    """By the photographs alone it drifts, and heights with it."""
    flight = fly(tilt_deg=0.1, bent=0.05)
    alone, model, found = placed(flight, FOCAL, tmp_path, sigma=(0.5, 0.5, 1.0))
    assert abs(focal_of(alone) / FOCAL - 1) > 0.08, "the case is one"
    assert focal_of(model) == pytest.approx(FOCAL, rel=0.02)
    heights = CORNER[2] + ALTITUDE - np.array([point.xyz[2] for point in model.points3D.values()])
    truth = ALTITUDE - flight.points[flight.rows(model), 2]
    assert np.median(heights) / np.median(truth) == pytest.approx(1, abs=0.05)
    [lens] = found.facts()["focal_lengths_px"]
    assert lens["exif"] == FOCAL and lens["photographs_alone"] == focal_of(alone)
    by = focal_of(alone) / focal_of(model) * found.heights
    assert by == pytest.approx(1, abs=0.05), "heights move as the focal length does"
    said = capsys.readouterr().err
    assert (
        "look the same way" in said and "known from EXIF only, to 3%" in said and "the focal length in EXIF" not in said
    )


@pytest.mark.parametrize("wrong", [0.7, 1.3])
def test_a_wrong_focal_length_in_exif_is_told(wrong, tmp_path, capsys):
    _, model, _ = placed(fly(tilt_deg=1.5, climb=1.0), wrong * FOCAL, tmp_path)
    said = capsys.readouterr().err
    assert f"EXIF of 30 photographs is {wrong * FOCAL:.0f} px" in said
    assert abs(focal_of(model) / FOCAL - 1) < abs(wrong - 1), "the photographs have a say"


def test_exact_heights_of_positions_contradict_a_wrong_focal_length_and_win(tmp_path, capsys):
    """All photographs look straight down, so that nothing else can tell."""
    rtk = (0.02, 0.02, 0.03)
    _, model, found = placed(fly(climb=4.0), 0.7 * FOCAL, tmp_path, rtk, rtk)
    assert found.stretch[0] == pytest.approx(1 / 0.7, rel=0.05)
    assert "heights by GPS differ 1.4" in capsys.readouterr().err
    assert focal_of(model) == pytest.approx(FOCAL, rel=0.03)


@pytest.mark.parametrize("lens", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_oblique_photographs_outweigh_exif(lens):
    flight = fly(tilt_deg=1.0, oblique=True)
    alone = reconstructed(flight, lens)
    right = adjust(alone, None, flight.photos(FOCAL), Settings())
    off = adjust(alone, None, flight.photos(0.9 * FOCAL), Settings())
    assert focal_of(off) == pytest.approx(FOCAL, rel=0.01)
    assert focal_of(right) == pytest.approx(FOCAL, rel=0.005)
    assert len(off.images) == len(alone.images) and off.num_points3D() == alone.num_points3D()
    assert off.num_reg_frames() == alone.num_reg_frames()
    assert (
        weighed(alone, off, flight.photos(0.9 * FOCAL), None).doubts()[0].startswith("the focal length in EXIF of 30")
    )
    assert weighed(alone, right, flight.photos(FOCAL), None).doubts() == []


def test_without_exif_positions_do_not_draw_the_focal_length_away(tmp_path, capsys):
    alone, model, found = placed(fly(tilt_deg=0.1, bent=0.05), None, tmp_path)
    assert focal_of(model) == pytest.approx(focal_of(alone), rel=0.03)
    assert "it is a guess, as EXIF has none" in capsys.readouterr().err
    assert found.facts()["focal_lengths_px"][0]["exif"] is None


def test_the_weight_of_exif_is_that_of_its_standard_deviation():
    """Two measurements of one number: their mean lies between them as their variances say."""
    flight = fly(tilt_deg=1.0)
    alone = reconstructed(flight)
    moved = {exif: focal_of(adjust(alone, None, flight.photos(exif), Settings())) for exif in (200.0, 210.0, 240.0)}
    shares = [(focal_of(alone) - moved[exif]) / (focal_of(alone) - exif) * exif**2 for exif in moved]
    odds = [share / (exif**2 - share) * exif**2 for share, exif in zip(shares, moved, strict=True)]
    np.testing.assert_allclose(odds, np.mean(odds), rtol=0.1)  # t^2 / s^2, of s in pixels


def test_when_two_sources_contradict_each_other():
    assert not Focal(222, 246, 222.5, 1).contradicts, "the photographs hardly know it"
    assert Focal(222, 246, 245.5, 1).contradicts and Focal(155, 222, 190, 1).contradicts
    assert not Focal(222, 228, 227, 1).contradicts and not Focal(None, 246, 342, 1).contradicts
    assert Focal(None, 246, 342, 1).drifts and not Focal(None, 246, 250, 1).drifts


def test_heights_of_positions_against_those_of_cameras():
    rng = np.random.default_rng(2)
    truth = np.column_stack([rng.uniform(-80, 80, (40, 2)), 60 + rng.normal(0, 5, 40)])
    low = truth * (1, 1, 0.8) + (0, 0, 7) + truth[:, :1] * (0, 0, 0.02)  # and turned
    sigma = np.full(40, 0.5)
    found = [height_stretch(low, truth + rng.normal(0, 0.5, truth.shape) * (0, 0, 1), sigma, 60.0) for _ in range(200)]
    values = np.array(found)
    assert values[:, 0].mean() == pytest.approx(1.25, abs=0.01)
    assert values[:, 0].std() == pytest.approx(values[:, 1].mean(), rel=0.2)
    level = truth * (1, 1, 0) + (0, 0, 60) + truth[:, :1] * (0, 0, 0.1)
    assert height_stretch(level, level, sigma, 60.0) is None, "a plane, level or not, says nothing"


def test_an_adjustment_leaves_the_model_it_was_given():
    flight = fly(tilt_deg=1.0)
    alone = reconstructed(flight)
    before = load_engine().Reconstruction(alone)
    adjust(alone, None, flight.photos(0.9 * FOCAL), Settings())
    assert (alone.cameras[1].params == before.cameras[1].params).all() and len(alone.images) == len(before.images)
    assert all((point.xyz == before.points3D[number].xyz).all() for number, point in alone.points3D.items())


def test_where_photographs_cannot_tell_exif_is_held(tmp_path, capsys):
    """Straight down but for a degree, with a principal point that is not in the middle, as the model has it."""
    flight = fly(tilt_deg=1.0)
    flight = replace(flight, seen=[(rows, pixels + 10) for rows, pixels in flight.seen])
    alone, model, found = placed(flight, FOCAL, tmp_path, sigma=(0.5, 0.5, 1.0))
    assert abs(focal_of(alone) / FOCAL - 1) > 0.3, "the case is one"
    assert focal_of(model) == pytest.approx(FOCAL, rel=0.01)
    assert found.focals[0].held and "as all photographs look the same way and cannot tell it" in capsys.readouterr().err
    assert found.above_ground == pytest.approx(ALTITUDE, rel=0.05)
    assert not any("above the start" in line for line in found.doubts())
    assert any("heights are 1.5" in line for line in replace(found, above_start=found.above_ground / 1.5).doubts())
