"""Light of photographs, and what becomes of colours near white, against light and curves that are known."""

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
from surfkit.scene.radiometry import (
    KNEE,
    MAX_GAIN,
    VIGNETTING_TERMS,
    SharedPlaces,
    camera_numbers,
    estimate,
    exposed,
    vignetting_terms,
)
from surfkit.scene.srgb import from_linear, linear

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
    terms = np.zeros((shown.size, VIGNETTING_TERMS))
    return SharedPlaces(np.arange(len(shown)).repeat(2), shown.ravel(), color, terms)


def fitted(shared, views):
    return estimate(shared, np.zeros(views, np.int64))


def test_gains_make_all_alike_and_the_mean_photograph_stays():
    exposures = np.array([1.0, 0.7, 1.0, 1.3, 1.0, 0.75, 1.0, 1.0, 1.25])[:, None] * [1.0, 1.1, 0.9]
    gains = fitted(strip(exposures), 9).gain
    error = gains * exposures
    assert np.abs(error / error.mean(0) - 1).max() < 0.05
    np.testing.assert_allclose(np.log(gains).mean(0), 0, atol=1e-9)


def test_most_places_decide():
    """A quarter of what one photograph shows of the places, such as shadows that have moved, is half as bright."""
    shared = strip([1.0, 1.2, 1.0], each=200)
    moved = (shared.photo == 1) & (np.random.default_rng(1).random(len(shared.photo)) < 0.25)
    shared.color[moved] = np.rint(255 * from_linear(0.5 * linear(shared.color[moved] / 255)))
    gains = fitted(shared, 3).gain
    assert np.abs(gains[1] / gains[0] * 1.2 - 1).max() < 0.03


def test_white_and_black_do_not_vote():
    shared = strip([1.0, 1.0, 1.2], each=200)
    plain = fitted(shared, 3).gain
    shared.color[np.random.default_rng(2).random(len(shared.photo)) < 0.3] = [255, 120, 120]
    shared.color[np.random.default_rng(3).random(len(shared.photo)) < 0.3] = [120, 3, 120]
    assert np.abs(fitted(shared, 3).gain / plain - 1).max() < 0.02


def test_a_slope_in_every_photograph_does_not_add_up_along_a_strip():
    """9 % from side to side: by ratios alone, the last of 40 photographs would be brightened 33 times as the first."""
    gains = fitted(strip(np.ones(40), slope=0.09), 40).gain
    assert np.abs(np.log(gains)).max() < 0.4 and np.abs(np.log(gains[10:30])).max() < 0.04


def test_photographs_with_few_places_stay_near_one_and_those_without_are_one():
    few, two = strip([1.0, 2.0], each=1), strip([0.8, 1.25], each=300)
    shared = SharedPlaces(
        np.r_[two.place, two.place.max() + 1 + few.place],
        np.r_[two.photo, 2 + few.photo],
        np.r_[two.color, few.color],
        np.r_[two.terms, few.terms],
    )
    gains = fitted(shared, 5).gain
    assert (gains[4] == 1).all() and np.abs(gains[2:4] - 1).max() < 0.2
    assert np.abs(gains[0] / gains[1] * 0.8 / 1.25 - 1).max() < 0.02


def test_each_group_keeps_its_own_brightness():
    """Two flights; five places that both show, wrongly, tie them to no other brightness."""
    one, other = strip([0.5, 0.6, 0.5], each=200), strip([1.0, 1.2, 1.0], each=200, seed=1)
    draw = np.random.default_rng(5)
    color = np.stack([draw.integers(60, 80, (5, 3)), draw.integers(160, 200, (5, 3))], 1).reshape(-1, 3)
    apart = one.place.max() + 1
    shared = SharedPlaces(
        np.r_[one.place, apart + other.place, apart + other.place.max() + 1 + np.arange(5).repeat(2)],
        np.r_[one.photo, 3 + other.photo, np.tile([1, 4], 5)],
        np.r_[one.color, other.color, color.astype(np.uint8)],
        np.zeros((len(one.photo) + len(other.photo) + 10, VIGNETTING_TERMS)),
    )
    gains = fitted(shared, 6).gain
    for group in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(np.log(gains[group]).mean(0), 0, atol=1e-9)
        assert np.abs(gains[group][1] / gains[group][0] * 1.2 - 1).max() < 0.02


@pytest.mark.parametrize("seed", [0, 1])
def test_light_of_a_survey_is_found_again(tmp_path, seed):
    """Exposures of one stop up and down, white balance of 15 %, and corners of 0.6."""
    made = flown_ground(tmp_path, seed=seed)
    cameras = [view.camera for view in made.views]
    _, light, _ = look_at_all(local_mesh(made.surface, made.frame), PrefetchedPhotos(made.views, 10**8), 1000)
    error = light.gain * made.gain
    error /= np.exp(np.log(error).mean(0))
    assert np.abs(error - 1).max() < 0.02 and made.gain.max() / made.gain.min() > 3
    assert np.abs(light.corners(cameras) - made.corner).max() < 0.01
    # the mean of the logarithm over each picture is that of its gain
    row, column = np.mgrid[:120, :160] + 0.5
    whole = np.log(light.gains_at(3, cameras[3], column.ravel(), row.ravel())).mean(0)
    np.testing.assert_allclose(whole, np.log(light.gain[3]), atol=2e-3)


def test_a_camera_is_known_at_any_size():
    pose = torch.eye(4, dtype=torch.float64)
    wide, long = Camera(pose, 500.0, 500, 400, 300, 800, 600), Camera(pose, 800.0, 800, 400, 300, 800, 600)
    numbers = camera_numbers([wide, long, wide.resized(333, 250), long.resized(80, 60)])
    assert numbers.tolist() in ([0, 1, 0, 1], [1, 0, 1, 0])
    x, y = np.array([0.0, 400.0, 700.0]), np.array([0.0, 300.0, 10.0])
    small = wide.resized(200, 150)
    np.testing.assert_allclose(vignetting_terms(wide, x, y), vignetting_terms(small, x / 4, y / 4), atol=1e-12)


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


def test_no_gain_is_out_of_bounds():
    gains = fitted(strip([1.0, 1.0, 0.05, 1.0], each=200), 4).gain
    assert gains.max() == MAX_GAIN and np.ptp(gains[[0, 1, 3]]) < 0.2, "one that is far out moves no other from others"
