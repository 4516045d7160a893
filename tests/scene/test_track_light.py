from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.scene import response
from surfkit.scene.camera import Camera
from surfkit.scene.light_spread import LightSpread
from surfkit.scene.observations import Observations, Observations2D
from surfkit.scene.response import curved
from surfkit.scene.scene import View
from surfkit.scene.srgb import from_linear, linear
from surfkit.scene.track_colors import TrackColors, axes_of, rows_of, sensor_axes, track_colors
from surfkit.scene.track_light import MIN_SEEN, fit_light

PHOTOS, POINTS = 30, 400
CORNER, BALANCE = 0.5, 0.15


def fitted(colors, taken_by):
    """A fit in which directions of sights are not known."""
    return fit_light(colors, taken_by, np.zeros((len(taken_by), 3, 2)))


def world(curves=((0.0, 0.0, 0.0),), seed=0):
    """Colours of points in photographs that each show a part of them, and the truth: (V, 3) stops, (V,) cameras."""
    draw = np.random.default_rng(seed)
    light = linear(draw.uniform(0.15, 0.6, (POINTS, 3)))
    stops = draw.uniform(-1.2, 1.2, (PHOTOS, 1)) + np.log2(draw.uniform(1 - BALANCE, 1 + BALANCE, (PHOTOS, 3)))
    taken_by = np.arange(PHOTOS) % len(curves)
    seen = draw.random((PHOTOS, POINTS)) < 0.3
    photo, point = np.nonzero(seen)
    place = draw.uniform(-0.7, 0.7, (len(photo), 2))
    left = 1 - (1 - CORNER) * (place**2).sum(1)
    encoded = from_linear((light[point] * 2 ** stops[photo] * left[:, None]).clip(0, 1))
    color = curved(encoded, np.array(curves)[taken_by[photo]].T[..., None])
    return TrackColors(photo, point, place, color), stops - stops.mean(0), taken_by


def corner_light(camera):
    r2 = np.linspace(0, 1, 21)
    return 2 ** -(camera[0] * r2 + camera[1] * r2**2 + camera[2] * r2**3) - (1 - (1 - CORNER) * r2)


def test_exposure_balance_and_vignetting_are_found():
    colors, stops, taken_by = world()
    light = fitted(colors, taken_by)
    assert np.abs(light.stops - stops).max() < 0.01  # 0.7 % of the light
    assert np.abs(corner_light(light.cameras[0])).max() < 0.01
    assert not light.cameras[0, 5:].any() and np.abs(light.cameras[0, 3:5]).max() < 0.01
    assert light.deviation < 0.005 and (light.seen > 50).all()


def test_corners_are_those_of_the_picture_wherever_the_vignetting_is_centred():
    values = np.array([0.5, 0.3, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert response.corner_light(values) == pytest.approx(0.5)
    values = np.array([-0.7, 0.23, 0.0, -0.8, -0.5, 0.0, 0.0, 0.0])
    x, y = np.mgrid[-1:1:200j, -1:1:200j]
    ring = np.abs(np.hypot(x, y) - 1) < 0.01
    r2 = (x + 0.8) ** 2 + (y + 0.5) ** 2
    light = 0.7 * r2 - 0.23 * r2**2
    assert response.corner_light(values) == pytest.approx(2 ** (light[ring].mean() - light[100, 100]), rel=0.02)


def test_a_quarter_of_wrong_sights_and_noise_change_little():
    colors, stops, taken_by = world()
    draw = np.random.default_rng(1)
    color = (colors.color + draw.normal(0, 0.02, colors.color.shape)).clip(0, 1)
    wrong = draw.random(len(color)) < 0.25
    color[wrong] = draw.random((wrong.sum(), 3))
    light = fitted(TrackColors(colors.photo, colors.point, colors.place, color), taken_by)
    assert np.sqrt(((light.stops - stops) ** 2).mean()) < 0.03
    assert np.abs(corner_light(light.cameras[0])).max() < 0.03
    assert 0.01 < light.deviation < 0.08


def test_curves_of_two_cameras_are_told_apart():
    one, other = (0.3, -0.1, 0.05), (-0.3, 0.1, -0.05)
    colors, _, taken_by = world((one, other))
    light = fitted(colors, taken_by)
    at = np.linspace(0.05, 0.9, 20)
    for curve, truth in zip(light.cameras[:, 5:], (one, other), strict=True):
        assert np.abs(curved(at, curve) - curved(at, truth)).max() < 0.02
    assert np.abs(light.cameras[:, 5:].mean(0)).max() < 1e-3
    assert light.deviation < 0.005
    spread = LightSpread.of(light)
    assert spread.curve == pytest.approx(np.abs(curved(at, one) - at).max(), abs=0.02)
    assert "response curves of 2 cameras by" in str(spread)


def test_noise_passes_for_no_response_curve_where_cameras_share_little():
    """As those of a drone in the morning and of another one in the afternoon, each over its part of the ground."""
    side, draw = 12, np.random.default_rng(0)
    spots = draw.uniform(0, side, (3_000, 2))
    steps = np.stack(np.meshgrid(range(-2, 2), range(-2, 2)), -1).reshape(-1, 2)
    near = (spots.astype(int)[:, None] + steps).reshape(-1, 2)
    point, inside = np.repeat(np.arange(len(spots)), len(steps)), ((near >= 0) & (near < side)).all(1)
    point, photo = point[inside], near[inside] @ (side, 1)
    stops = draw.normal(0, 0.3, (side * side, 3))
    light = linear(draw.uniform(0.2, 0.6, (len(spots), 3)))[point] * 2 ** stops[photo]
    color = from_linear(light.clip(0, 1)) + draw.normal(0, 0.02, light.shape)
    place = (spots[point] - np.stack([photo // side, photo % side], 1)) / 4
    light = fitted(TrackColors(photo, point, place, color.clip(0, 1)), np.arange(side * side) * 3 // side**2)
    error = light.stops - stops
    assert (error - error.mean(0)).std() < 0.05 and LightSpread.of(light).curve < 0.015


@pytest.mark.parametrize("seed", [2, 5])
def test_shine_passes_for_no_vignetting_that_is_off_the_middle(seed):
    """As of a facade: all sights lie in a band across the picture, and colours depend on the direction a little."""
    draw, count = np.random.default_rng(seed), 10
    spots, light = draw.uniform([-0.6, -0.25], [0.6, 0.25], (700, 2)), linear(draw.uniform(0.15, 0.6, (700, 3)))
    photo, point = np.nonzero(draw.random((count, 700)) < 0.45)
    place = spots[point] + np.stack([np.linspace(-0.15, 0.15, count), draw.uniform(-0.08, 0.08, count)], 1)[photo]
    shine = draw.normal(0, 0.4, count)[photo] * place[:, 1]  # stops
    stops = draw.uniform(-0.6, 0.6, count)
    left = 1 - (1 - CORNER) * (place**2).sum(1)
    color = from_linear((light[point] * (2 ** (stops[photo] + shine) * left)[:, None]).clip(0, 1))
    color = (color + draw.normal(0, 0.01, color.shape)).clip(0, 1)
    found = fitted(TrackColors(photo, point, place, color), np.zeros(count, np.int64))
    assert np.abs(found.cameras[0, 3:5]).max() < 0.05  # 0.9 and 1.2 where the centre is free by 0.1
    assert np.sqrt(np.square(found.stops - (stops - stops.mean())[:, None]).mean()) < 0.04  # 0.11 and 0.08
    assert response.corner_light(found.cameras[0]) == pytest.approx(CORNER, abs=0.2)


def test_a_lens_that_is_off_the_middle_is_found_where_points_tell():
    colors, stops, taken_by = world()
    seen = TrackColors(colors.photo, colors.point, colors.place + [0.08, -0.05], colors.color)
    light = fitted(seen, taken_by)
    assert np.abs(light.cameras[0, 3:5] - [0.08, -0.05]).max() < 0.01
    assert np.abs(light.stops - stops).max() < 0.02


def flight(lines, photographs, slope=0.0, sensor=0.0, exposures=0.0, seed=0):
    """Flat ground from above, in lines there and back; pictures are 1.2 wide and 0.9 high, at a height of 1.

    Args:
        slope: Stops that the light of all ground gains with each unit that it is seen from further west.
        sensor: Stops that every picture gains from its left to its right, for each unit.
        exposures: Standard deviation of them, stops.

    Returns:
        Colours, the true (V,) stops, axes, and (V, 2) places of the cameras.
    """
    draw, size, parts, axes, middles = np.random.default_rng(seed), np.array([1.2, 0.9]), [], [], []
    step = size * [0.25, 0.5]
    ground = draw.uniform(0, step * [photographs, lines] + size, (150 * lines * photographs, 2))
    light = linear(draw.uniform(0.25, 0.6, (len(ground), 3)))
    stops = draw.normal(0, exposures, lines * photographs)
    for number in range(lines * photographs):
        line, along = divmod(number, photographs)
        there = 1 if line % 2 == 0 else -1
        middles.append(size / 2 + step * [along, line])
        away = ground - middles[-1]
        rows = np.flatnonzero((np.abs(away) < size / 2).all(1))
        place = there * away[rows] * 2 / np.hypot(*size)
        change = stops[number] + slope * away[rows, 0] + sensor * there * away[rows, 0]
        color = from_linear((light[rows] * 2 ** change[:, None]).clip(0, 1))
        color = (color + draw.normal(0, 0.01, color.shape)).clip(0, 1)
        parts.append((np.full(len(rows), number), rows, place, color))
        axes.append(sensor_axes(np.diag([there, there, 1.0]), (1.0, 1.0), 2 / np.hypot(*size)))
    colors = TrackColors(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    return colors, stops - stops.mean(), np.stack(axes), np.array(middles)


def test_a_bright_side_towards_the_sun_is_no_drift_of_the_exposures():
    """0.15 stops across each picture: by differences of neighbours alone, 3 stops from one end to the other."""
    colors, _, axes, _ = flight(1, 80, slope=0.125)
    light = fit_light(colors, np.zeros(80, np.int64), axes)
    assert np.ptp(light.stops, axis=0).max() < 0.3 and not LightSpread.of(light).is_uneven
    np.testing.assert_allclose(light.slope[:, 0], 0.105, atol=0.01)  # held a little
    assert np.abs(light.slope[:, 1:]).max() < 0.01 and np.abs(light.cameras[0, 3:5]).max() < 0.01


def test_two_exposures_are_no_bright_side():
    colors, stops, axes, _ = flight(1, 2, exposures=0.5, seed=1)
    off = fit_light(colors, np.zeros(2, np.int64), axes).stops - stops[:, None]
    assert np.abs(stops).min() > 0.1 and np.abs(off).max() < 0.05 * np.abs(stops).max()


def test_exposures_are_found_beside_a_bright_side_up_to_a_trend_over_the_ground():
    """What is left of the error is linear in the place: over flat ground, that cannot be told from a slope."""
    colors, stops, axes, middles = flight(3, 20, slope=0.125, exposures=0.5)
    light = fit_light(colors, np.zeros(len(axes), np.int64), axes)
    off = light.stops - stops[:, None]
    trend = np.column_stack([middles, np.ones(len(middles))])
    left = off - trend @ np.linalg.lstsq(trend, off, rcond=None)[0]
    assert np.abs(left).max() < 0.02 and np.ptp(off, axis=0).max() < 0.6  # of 2.3 stops
    one = np.linalg.lstsq(trend, off, rcond=None)[0][:2].T  # and the slope makes up for it
    np.testing.assert_allclose(light.slope[:, :2] - one, [[0.125, 0]] * 3, atol=0.01)


def test_what_no_number_explains_does_not_add_up_along_a_line():
    """A slope as above, of photographs whose directions are not known."""
    colors, stops, _, _ = flight(1, 60, slope=0.125)
    assert np.ptp(fitted(colors, np.zeros(60, np.int64)).stops, axis=0).max() < 1.5  # 2.3 without
    colors, stops, _, _ = flight(1, 60, exposures=0.5)
    off = fitted(colors, np.zeros(60, np.int64)).stops - stops[:, None]
    assert np.abs(off).max() < 0.2, "a change of the light that is there stays"


def test_axes_turn_places_on_the_sensor_into_directions():
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn * np.sign(np.linalg.det(turn)), [0.3, -1.0, 2.0]
    camera = Camera(torch.from_numpy(pose), 400.0, 410.0, 310.0, 250.0, 640, 480)
    points = camera.centre.numpy() + (np.random.default_rng(4).uniform(-1, 1, (6, 3)) + [0, 0, 4]) @ pose[:3, :3]
    local = points @ pose[:3, :3].T + pose[:3, 3]
    pixels = local[:, :2] / local[:, 2:] * (400, 410) + (310, 250)
    place = (pixels - (310, 250)) * response.sensor_scale(camera)
    aside = place @ axes_of([View("a", camera, Path("a"))])[0].T
    sights = (points - camera.centre.numpy()) / local[:, 2:]
    np.testing.assert_allclose(aside, sights - pose[2, :3], atol=1e-12)


def test_photographs_that_share_too_little_are_known_by_their_count():
    colors, stops, taken_by = world()
    few = np.flatnonzero(colors.photo == 4)[MIN_SEEN - 4 :]
    kept = np.setdiff1d(np.arange(len(colors.photo)), [*few, *np.flatnonzero(colors.photo == 9)])
    light = fitted(TrackColors(*(each[kept] for each in vars(colors).values())), taken_by)
    assert (
        light.seen[4] < MIN_SEEN
        and light.seen[9] == 0
        and light.stops[9] == pytest.approx(light.stops[9].mean(), abs=0.2)
    )
    others = np.setdiff1d(np.arange(PHOTOS), [4, 9])
    off = (light.stops - stops)[others]
    assert np.abs(off - off.mean(0)).max() < 0.02
    spread = LightSpread.of(light)
    low, high = np.percentile(stops[others].mean(1), [10, 90])
    assert spread.stops == pytest.approx(high - low, abs=0.05) and spread.corner == pytest.approx(CORNER, abs=0.01)
    low, high = np.percentile(stops[others][:, [0, 2]] - stops[others][:, 1:2], [10, 90], axis=0)
    assert spread.balance == pytest.approx(2 ** (high - low).max() - 1, abs=0.02) and spread.is_uneven
    assert f"differ by {spread.stops:.1f} stops" in str(spread) and "have 50% of the light" in str(spread)


@pytest.mark.parametrize(
    ("figures", "uneven"),
    [
        ((0.49, 0.09, 0.81, 0.029), False),
        ((0.5, 0.0, 1.0, 0.0), True),
        ((0.0, 0.1, 1.0, 0.0), True),
        ((0.0, 0.0, 0.8, 0.0), True),
        ((0.0, 0.0, 1.0, 0.03), True),
    ],
)
def test_light_is_uneven_from_stated_limits_on(figures, uneven):
    assert LightSpread(*figures).is_uneven == uneven


def test_a_photograph_that_shows_a_point_twice_is_compared_with_no_other():
    """As tracks of COLMAP do, where features were matched twice."""
    draw = np.random.default_rng(0)
    point, place = np.repeat(np.arange(40), 2), draw.uniform(-0.7, 0.7, (80, 2))
    alone = TrackColors(np.zeros(80, int), point, place, draw.uniform(0.2, 0.8, (80, 3)))
    light = fitted(alone, np.zeros(1, int))
    assert light.seen.tolist() == [0] and not light.stops.any() and not light.cameras.any()
    colors, _, taken_by = world()
    twice = TrackColors(*(np.concatenate([each, each[:50]]) for each in vars(colors).values()))
    assert np.array_equal(fitted(twice, taken_by).seen, fitted(colors, taken_by).seen)


def test_nothing_seen_changes_nothing():
    empty = TrackColors(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 3)))
    light = fitted(empty, np.zeros(3, int))
    assert not light.stops.any() and not light.cameras.any() and not light.seen.any()


def test_the_same_twice():
    colors, _, taken_by = world()
    one, other = (fitted(colors, taken_by) for _ in range(2))
    assert np.array_equal(one.stops, other.stops) and np.array_equal(one.cameras, other.cameras)


def test_colours_are_read_where_the_points_are(tmp_path):
    ramp = np.stack(np.meshgrid(np.arange(300) / 299, np.arange(200) / 199), 2)
    pixels = np.dstack([ramp, np.full((200, 300), 0.4)])
    camera = Camera(torch.eye(4, dtype=torch.float64), 90.0, 90.0, 70.0, 52.0, 150, 100)
    views = []
    for name in ("a.png", "b.png", "gone.png"):
        views.append(View(name, camera, tmp_path / name, taken_by=name[0]))
        if name != "gone.png":
            Image.fromarray((pixels * 255).round().astype(np.uint8)).save(tmp_path / name)
    at = np.array([[0.25, 0.5], [0.8, 0.3], [0.5, 0.9]])
    seen = {"a.png": Observations2D(np.array([5, 2, 9]), at), "b.png": Observations2D(np.array([9, 5]), at[:2])}
    seen["gone.png"] = Observations2D(np.array([5, 2]), at[:2])
    found = track_colors(views, Observations(np.zeros((12, 3)), np.zeros(12), seen))
    assert found.photo.tolist() == [0, 0, 0, 1, 1] and found.point.tolist() == [1, 0, 2, 2, 1]
    assert np.allclose(found.color[:3, :2], at, atol=0.01) and np.allclose(found.color[:, 2], 0.4, atol=0.01)
    half = np.hypot(150, 100) / 2
    assert np.allclose(found.place[0], [(0.25 * 150 - 70) / half, (0.5 * 100 - 52) / half])
    again = Observations2D(np.array([5, 2, 9, 2]), at[[0, 1, 2, 2]])
    alone = track_colors(views[:1], Observations(np.zeros((12, 3)), np.zeros(12), {"a.png": again}))
    assert not len(alone.photo), "one photograph shows no point twice"
    assert rows_of([*views, views[0]]).tolist() == [0, 1, 2, 0]
    assert Path(views[0].path).exists()
