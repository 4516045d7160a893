"""Reconstructions on the map: zones, systems, wrong positions, and what determines no place."""

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.georeference import MapProjection, NoSimilarity, Placement, chart_of, place, to_chart
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.core.check import BadInput
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.earth import from_utm

EAST, NORTH = 372_000.0, 5_810_000.0


def survey(onto, noise=0.0, accuracy=None):
    """Cameras in a frame of their own, and photographs with positions in zone 33."""
    turn = Rotation.from_rotvec([1.0, 0.4, -0.7]).as_matrix()
    shots = {f"{at}.jpg": 0.02 * turn @ xyz + (1, 2, 3) for at, xyz in enumerate(onto)}
    seen = onto + np.random.default_rng(0).normal(0, noise, onto.shape)
    latitude, longitude = from_utm(seen[:, 0] + EAST, seen[:, 1] + NORTH, 33, False)
    at = np.column_stack([latitude, longitude, seen[:, 2]]).tolist()
    photos = [
        Photo(name, (0, 0), exif=Exif(position=tuple(p), accuracy_m=accuracy))
        for name, p in zip(shots, at, strict=True)
    ]
    return shots, photos


def grid(count=25, height=90.0):
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(-80, 80, (count, 2)), height + rng.uniform(-5, 5, count)])


def placed(onto, **kwargs):
    shots, photos = survey(onto, **kwargs)
    return place(shots, photos, chart_of(np.array([photo.exif.position for photo in photos]), "auto"))


def test_cameras_come_to_their_positions():
    onto = grid()
    found = placed(onto)
    assert found.chart == MapProjection("EPSG:32633", (EAST, NORTH, 0.0)) and found.fit.inside.all()
    shots, _ = survey(onto)
    np.testing.assert_allclose(found.similarity.points(np.stack(list(shots.values()))), onto, atol=1e-3)
    assert found.similarity.scale == pytest.approx(50, rel=1e-6)


def test_a_photograph_500_m_off_is_named_and_has_no_say():
    onto = grid()
    shots, photos = survey(onto, noise=3.0)
    wrong = photos[7].exif.position
    photos[7] = Photo("7.jpg", (0, 0), exif=Exif(position=(wrong[0] + 500 / 111e3, wrong[1], wrong[2])))
    chart = chart_of(np.array([photo.exif.position for photo in photos]), "auto")
    found = place(shots, photos, chart)
    assert [name for name, good in zip(found.names, found.fit.inside, strict=True) if not good] == ["7.jpg"]
    assert np.linalg.norm(found.fit.residuals[7]) == pytest.approx(500, abs=12)
    away = found.similarity.points(np.stack(list(shots.values()))) - onto
    assert np.linalg.norm(away.mean(0)) < 2 * 3 * np.sqrt(3 / 25)


def test_a_strip_that_a_receiver_without_corrections_put_a_metre_off_is_no_mistake():
    onto = grid(18)
    off = onto + np.where(np.arange(18)[:, None] % 3 == 0, (0.8, 0.8, 0.0), 0.0)
    shots, photos = survey(off, noise=0.1)
    shots = survey(onto)[0]
    chart = chart_of(np.array([photo.exif.position for photo in photos]), "auto")
    found = place(shots, photos, chart)
    assert found.fit.inside.all() and found.drifting == 6, "which is told"
    away = found.similarity.points(np.stack(list(shots.values()))) - onto
    np.testing.assert_allclose(away.mean(0), (0.8 / 3, 0.8 / 3, 0), atol=0.1)
    assert (found.sigma[:, :2] > 0.3).all(), "as exact as they agree"


def test_one_position_two_metres_off_is_still_left_out():
    onto = grid(18)
    off = onto.copy()
    off[7, 0] += 2
    shots, photos = survey(off, noise=0.1)
    shots = survey(onto)[0]
    found = place(shots, photos, chart_of(np.array([photo.exif.position for photo in photos]), "auto"))
    assert [name for name, good in zip(found.names, found.fit.inside, strict=True) if not good] == ["7.jpg"]
    assert found.drifting == 0


def test_a_line_determines_no_turn():
    found = placed(np.column_stack([np.linspace(0, 300, 12), np.linspace(0, 100, 12), np.full(12, 60.0)]), noise=0.5)
    assert isinstance(found, NoSimilarity) and "along a line" in found.reason


@pytest.mark.parametrize(
    "onto, noise, said", [(grid(), 80.0, "too large"), (grid(8) / 100, 2.0, "too large"), (grid(3), 0.0, "3 of 3")]
)
def test_what_is_refused(onto, noise, said):
    found = placed(onto, noise=noise)
    assert isinstance(found, NoSimilarity) and said in found.reason


def test_rtk_positions_are_believed():
    found = placed(grid(), noise=0.02, accuracy=(0.02, 0.02, 0.04))
    assert isinstance(found, Placement) and found.fit.sigma.max() < 0.05


def test_positions_that_state_an_accuracy_among_others_that_state_none():
    """Six of a receiver with corrections, at 0.02 m, and others that are 3 m off and do not say so."""
    onto = grid(40)
    shots, photos = survey(onto, noise=3.0)
    _, exact = survey(onto, noise=0.02, accuracy=(0.02, 0.02, 0.04))
    photos = [exact[at] if at % 7 == 0 else photo for at, photo in enumerate(photos)]
    found = place(shots, photos, chart_of(np.array([photo.exif.position for photo in photos]), "auto"))
    rtk = np.arange(40) % 7 == 0
    assert found.fit.inside[rtk].all()
    away = found.similarity.points(np.stack(list(shots.values()))) - onto
    assert np.linalg.norm(away, axis=1).max() < 0.1
    np.testing.assert_allclose(found.sigma[rtk], np.tile((0.02, 0.02, 0.04), (rtk.sum(), 1)))
    assert (found.sigma[~rtk] > 2).all() and (found.sigma[~rtk] < 4.5).all(), "by their residuals"


@pytest.mark.parametrize("count", [5, 20])
def test_a_receiver_that_gave_one_position_only_determines_nothing(count):
    shots, photos = survey(grid(count))
    photos = [Photo(photo.name, (0, 0), exif=photos[0].exif) for photo in photos]
    found = place(shots, photos, MapProjection("EPSG:32633", (EAST, NORTH, 0.0)))
    assert isinstance(found, NoSimilarity) and f"{count} of {count} positions are one place" in found.reason


@pytest.mark.parametrize("crs", ["auto", "EPSG:2180"])
@pytest.mark.parametrize("wrong", [(90.0, 0.0, 10.0), (0.0, -75.0, 10.0), (-52.0, -164.0, 10.0)])
def test_a_position_beyond_the_map_is_named_and_left_out(crs, wrong, capsys):
    onto = grid()
    shots, photos = survey(onto)
    photos[7] = Photo("7.jpg", (0, 0), exif=Exif(position=wrong))
    with collect_notes():
        found = place(shots, photos, chart_of(np.array([photo.exif.position for photo in photos]), crs))
    left = [name for name, good in zip(found.names, found.fit.inside, strict=True) if not good]
    assert "7.jpg" in left or "'7.jpg'" in capsys.readouterr().err
    assert np.isfinite(found.onto).all() and np.abs(found.onto).max() < 1e8 and found.fit.inside.sum() == 24


def test_positions_on_both_sides_of_180_degrees():
    corner = np.array([180_240.0, 8_140_100.0, 0.0])  # zone 1 south, 30 m from its western border
    onto = grid()
    latitude, longitude = from_utm(onto[:, 0] + corner[0], onto[:, 1] + corner[1], 1, True)
    longitude = (longitude + 180) % 360 - 180
    assert (longitude > 0).any() and (longitude < 0).any()
    at = np.column_stack([latitude, longitude, onto[:, 2]])
    chart = chart_of(at, "auto")
    assert chart.crs == "EPSG:32701" and abs(chart.offset[0] - corner[0]) <= 100
    np.testing.assert_allclose(to_chart(chart, at) + chart.offset, onto + corner, atol=1e-3)


@pytest.mark.parametrize(
    "place, zone", [((52.0, 16.0), 32633), ((-33.9, 151.2), 32756), ((0.1, -180.0), 32601), ((1, 179.9), 32660)]
)
def test_the_zone_of_utm(place, zone):
    chart = chart_of(np.array([[*place, 10.0]] * 3), "auto")
    assert chart.crs == f"EPSG:{zone}" and chart.metres == 1
    assert np.abs(to_chart(chart, np.array([[*place, 10.0]]))[0, :2]).max() <= 50


def test_other_systems_agree_with_proj():
    positions = np.array([[52.75, 16.87, 120.0], [52.751, 16.873, 118.0]])
    known = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:2180", always_xy=True)
    wanted = np.stack(known.transform(positions[:, 1], positions[:, 0]), 1)
    chart = chart_of(positions, "EPSG:2180")
    np.testing.assert_allclose(to_chart(chart, positions)[:, :2] + chart.offset[:2], wanted, atol=1e-6)
    utm = chart_of(positions, "auto")
    proj = pyproj.Transformer.from_crs("EPSG:4326", utm.crs, always_xy=True)
    wanted = np.stack(proj.transform(positions[:, 1], positions[:, 0]), 1)
    np.testing.assert_allclose(to_chart(utm, positions)[:, :2] + utm.offset[:2], wanted, atol=1e-3)
    feet = chart_of(np.array([[40.7, -74.0, 30.48]]), "EPSG:2263+6360")  # New York, US survey feet, heights too
    assert feet.metres == pytest.approx(0.3048, rel=1e-3)
    assert to_chart(feet, np.array([[40.7, -74.0, 1219.2]]))[0, 2] == pytest.approx(4000, abs=0.01)


@pytest.mark.parametrize(
    "crs, said",
    [
        ("EPSG:4326", "EPSG:4326: .*degrees"),
        ("EPSG:1", "--crs: .*'EPSG:1'"),
        ("nonsense", "--crs: .*'nonsense'"),
        ("EPSG:32755", "--crs EPSG:32755: it does not reach 52.0000, 16.0000"),
    ],
)
def test_systems_that_will_not_do(crs, said):
    with pytest.raises(BadInput, match=said):
        chart_of(np.array([[52.0, 16.0, 100.0]]), crs)


def test_a_group_without_positions_is_refused_on_every_map():
    shots, _ = survey(grid(5))
    for crs in ("EPSG:32633", "EPSG:2180"):
        found = place(shots, [Photo(name, (0, 0)) for name in shots], MapProjection(crs, (0.0, 0.0, 0.0)))
        assert isinstance(found, NoSimilarity) and "0 of 5 placed photographs have a position" in found.reason


def test_at_the_pole_a_system_must_be_named():
    with pytest.raises(BadInput, match="--crs"):
        chart_of(np.array([[88.0, 16.0, 100.0]]), "auto")
