"""Photographs in one light, and what becomes of colours near white, against light and curves that are known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from flown_ground import flown_ground
from needs import needs

from surfkit.apps.texture.candidates import Candidates
from surfkit.apps.texture.prefetch_photos import PrefetchedPhotos
from surfkit.apps.texture.seam_levelling import levelled
from surfkit.apps.texture.texture_mesh import local_mesh, look_at_all
from surfkit.scene.camera import Camera
from surfkit.scene.one_light import KNEE, MAX_GAIN, OneLight, exposed, sensor_places
from surfkit.scene.response import curved
from surfkit.scene.scene import View
from surfkit.scene.srgb import from_linear, linear
from surfkit.scene.track_colors import TrackColors
from surfkit.scene.track_light import fit_light

needs("fast_simplification")


def strip(exposures, slope=0.0, each=60, seed=0):
    """Places between photographs in a row: each shows those of its two neighbours too, brighter on its left side by a
    factor than on its right."""
    draw, count = np.random.default_rng(seed), len(exposures)
    true = draw.uniform(0.05, 0.3, (each * (count - 1), 1, 3))
    shown = np.repeat(np.arange(count - 1), each)[:, None] + [0, 1]
    sides = np.exp([-slope / 2, slope / 2])[:, None]  # the right side of the first, the left one of the second
    light = true * np.asarray(exposures, float)[shown].reshape(*shown.shape, -1) * sides
    color = np.rint(255 * from_linear(light.clip(0, 1))).astype(np.uint8).reshape(-1, 3)
    return TrackColors(shown.ravel(), np.arange(len(shown)).repeat(2), np.zeros((shown.size, 2)), color / 255)


def gains_of(shared, views):
    """(V, 3) what the light of photographs is to be multiplied by."""
    return 2.0 ** -fit_light(shared, np.zeros(views, np.int64), np.zeros((views, 3, 2))).stops


def test_gains_make_all_alike_and_the_mean_photograph_stays():
    exposures = np.array([1.0, 0.7, 1.0, 1.3, 1.0, 0.75, 1.0, 1.0, 1.25])[:, None] * [1.0, 1.1, 0.9]
    gains = gains_of(strip(exposures), 9)
    error = gains * exposures
    assert np.abs(error / error.mean(0) - 1).max() < 0.05
    np.testing.assert_allclose(np.log(gains).mean(0), 0, atol=1e-9)


def test_most_places_decide():
    """A quarter of what one photograph shows of the places, such as shadows that have moved, is half as bright."""
    shared = strip([1.0, 1.2, 1.0], each=200)
    moved = (shared.photo == 1) & (np.random.default_rng(1).random(len(shared.photo)) < 0.25)
    shared.color[moved] = from_linear(0.5 * linear(shared.color[moved]))
    gains = gains_of(shared, 3)
    assert np.abs(gains[1] / gains[0] * 1.2 - 1).max() < 0.03


def test_white_and_black_do_not_vote():
    shared = strip([1.0, 1.0, 1.2], each=200)
    plain = gains_of(shared, 3)
    shared.color[np.random.default_rng(2).random(len(shared.photo)) < 0.3] = np.divide([255, 120, 120], 255)
    shared.color[np.random.default_rng(3).random(len(shared.photo)) < 0.3] = np.divide([120, 3, 120], 255)
    assert np.abs(gains_of(shared, 3) / plain - 1).max() < 0.02


def test_a_slope_in_every_photograph_does_not_add_up_along_a_strip():
    """9 % from side to side: by ratios alone, the last of 40 photographs would be brightened 33 times as the first.
    Where they look is not known."""
    gains = gains_of(strip(np.ones(40), slope=0.09), 40)
    assert np.abs(np.log(gains)).max() < 0.9  # 1.75 without


def joined(*parts):
    """Surveys that share no place, one after the other."""
    photo = np.cumsum([0, *(part.photo.max() + 1 for part in parts)])
    point = np.cumsum([0, *(part.point.max() + 1 for part in parts)])
    return TrackColors(
        np.concatenate([part.photo + at for part, at in zip(parts, photo, strict=False)]),
        np.concatenate([part.point + at for part, at in zip(parts, point, strict=False)]),
        np.concatenate([part.place for part in parts]),
        np.concatenate([part.color for part in parts]),
    )


def test_photographs_with_few_places_keep_their_exposure():
    shared = joined(strip([0.8, 1.25], each=300), strip([1.0, 2.0], each=1))
    camera = Camera(torch.eye(4, dtype=torch.float64), 500.0, 500, 400, 300, 800, 600)
    light = OneLight.of([View(str(at), camera, Path(str(at))) for at in range(5)], shared)
    assert not light.stops[2:].any()
    gains = 2.0**-light.stops
    assert np.abs(gains[0] / gains[1] * 0.8 / 1.25 - 1).max() < 0.02


def test_each_group_keeps_its_own_brightness():
    """Two flights; five places that both show, wrongly, tie them to no other brightness."""
    one, other = strip([0.5, 0.6, 0.5], each=200), strip([1.0, 1.2, 1.0], each=200, seed=1)
    draw, shared = np.random.default_rng(5), joined(one, other)
    color = np.stack([draw.integers(60, 80, (5, 3)), draw.integers(160, 200, (5, 3))], 1).reshape(-1, 3) / 255
    wrong = TrackColors(np.tile([1, 4], 5), shared.point.max() + 1 + np.arange(5).repeat(2), np.zeros((10, 2)), color)
    both = zip(vars(shared).values(), vars(wrong).values(), strict=True)
    gains = gains_of(TrackColors(*map(np.concatenate, both)), 6)
    for group in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(np.log(gains[group]).mean(0), 0, atol=0.03)
        assert np.abs(gains[group][1] / gains[group][0] * 1.2 - 1).max() < 0.02


@pytest.mark.parametrize("seed", [0, 1])
def test_light_of_a_survey_is_found_again(tmp_path, seed):
    """Exposures of one stop up and down, white balance of 15 %, and corners of 0.6."""
    made = flown_ground(tmp_path, seed=seed)
    cameras = [view.camera for view in made.views]
    _, light, _ = look_at_all(local_mesh(made.surface, made.frame), PrefetchedPhotos(made.views, 10**8), 1000)
    error = np.log2(made.gain) - light.stops
    error -= error.mean(0)
    assert np.abs(error).max() < 0.045 and made.gain.max() / made.gain.min() > 3  # 3 % of the light
    centres = np.stack([camera.centre.numpy()[:2] for camera in cameras])
    trend = np.column_stack([centres, np.ones(len(centres))])  # a slope would make it too
    left = error - trend @ np.linalg.lstsq(trend, error, rcond=None)[0]
    assert np.abs(left).max() < 0.008
    assert np.abs(light.corners - made.corner).max() < 0.01
    # the mean of the logarithm over each picture is that of its exposure
    row, column = np.mgrid[:120, :160] + 0.5
    x, y = column.ravel(), row.ravel()
    whole = linear(light.even(np.full((x.size, 3), from_linear(np.array(0.01))), 3, cameras[3], x, y)) / 0.01
    np.testing.assert_allclose(np.log2(whole).mean(0), -light.stops[3], atol=2e-3)


def test_a_camera_is_known_at_any_size():
    wide = Camera(torch.eye(4, dtype=torch.float64), 500.0, 500, 400, 300, 800, 600)
    x, y = np.array([0.0, 400.0, 700.0]), np.array([0.0, 300.0, 10.0])
    found = sensor_places(wide.resized(200, 150), x / 4, y / 4)
    np.testing.assert_allclose(found, sensor_places(wide, x, y), atol=1e-12)
    np.testing.assert_allclose(found[:2], [[-0.8, -0.6], [0, 0]], atol=1e-12)


def test_colours_are_those_that_a_camera_changed():
    """Exposure, slope over the sensor, vignetting around a centre off the middle, and a response curve, put on and
    taken off."""
    draw = np.random.default_rng(7)
    cameras = np.array([[0.6, 0.1, 0.0, 0.1, -0.05, 0.3, -0.1, 0.05], np.zeros(8)])
    stops, tilt, kept = draw.normal(0, 0.3, (3, 3)), draw.normal(0, 0.2, (3, 2, 3)), draw.random(3)
    light = OneLight(stops, tilt, kept, np.array([0, 1, 0]), cameras)
    scene, photo, place = draw.uniform(0.02, 0.12, (50, 3)), draw.integers(0, 3, 50), draw.uniform(-0.5, 0.5, (50, 2))
    shown = np.empty((50, 3))
    for at, (number, (x, y)) in enumerate(zip(photo, place, strict=True)):
        a, b, _, u, v, *curve = cameras[light.taken_by[number]]
        square = (x - u) ** 2 + (y - v) ** 2
        stops = light.stops[number] + x * light.tilt[number, 0] + y * light.tilt[number, 1]
        stops = stops - a * square - b * square**2 + light.kept[number]
        shown[at] = curved(from_linear(scene[at] * 2**stops), np.array(curve))
    np.testing.assert_allclose(linear(light.even_at(shown, photo, place)), scene, rtol=2e-3)


@pytest.mark.parametrize("gain", [0.25, 0.5, 0.7, 1.0, 1.2, 2.0, 4.0])
def test_light_is_multiplied_but_near_white(gain):
    light = np.linspace(0, 1, 4001)
    found = linear(exposed(from_linear(light)[:, None], np.full(1, gain))[:, 0])
    below = light <= KNEE / max(gain, 1)
    np.testing.assert_allclose(found[below], gain * light[below], atol=1e-9)
    assert (np.diff(found) > 0).all() and found[0] == 0 and found[-1] == pytest.approx(1, abs=1e-9)
    assert np.abs(np.diff(found, 2)).max() < 2e-5, "no corner"
    white = linear(np.array(250 / 255))
    assert (found >= white).mean() < (1.5 if gain <= 2 else 2) * (light >= white).mean()
    if gain == 1:
        np.testing.assert_allclose(found, light, atol=1e-9)


def test_what_is_added_at_seams_makes_nothing_white_or_black():
    color = np.linspace(0, 1, 256)[:, None].repeat(3, 1)
    for added in (-0.25, 0.25):
        found = levelled(color, np.full(3, added)).astype(float)[:, 0]
        middle = (color[:, 0] > 0.25) & (color[:, 0] < 0.75)
        np.testing.assert_allclose(found[middle], 255 * (color[middle, 0] + added), atol=0.5 + 1e-6)
        assert found[0] == 0 and found[-1] == 255


def test_a_photograph_that_shows_a_triangle_white_counts_less():
    found = Candidates(2)
    found.view[:, :2], found.quality[:, :2] = [0, 1], [2.0, 1.0]
    found.color[:, 0], found.color[:, 1] = [[200, 255, 255], [200, 200, 200]], 150
    found.shun_clipped()
    assert found.quality[:, :2].argmax(1).tolist() == [1, 0] and (found.view[:, 0] == 0).all()


def test_no_light_is_changed_by_more_than_two_stops():
    light = OneLight(
        np.full((2, 3), [[-5.0], [5.0]]), np.zeros((2, 2, 3)), np.zeros(2), np.zeros(2, np.int64), np.zeros((1, 8))
    )
    found = linear(light.even_at(np.full((2, 3), from_linear(np.array(0.1))), np.arange(2), np.zeros((2, 2))))
    np.testing.assert_allclose(found, 0.1 * np.array([[MAX_GAIN], [1 / MAX_GAIN]]).repeat(3, 1))


def test_gains_that_are_told_are_those_that_are_applied():
    stops, zeros = np.array([[0.5, 0.5, 0.5], [-3.0, -3.0, -3.0]]), np.zeros(2)
    light = OneLight(stops, np.zeros((2, 2, 3)), zeros, zeros.astype(np.int64), np.zeros((1, 8)))
    assert light.gains == pytest.approx((2**-0.5, MAX_GAIN))
    dark = from_linear(np.full((1, 3), 0.01))
    for photo, gain in enumerate(light.gains):
        even = light.even_at(dark, np.array([photo]), np.zeros((1, 2)))
        np.testing.assert_allclose(linear(even) / 0.01, gain, rtol=1e-6)
