"""Gains of photographs, and what becomes of colours near white, against gains and curves that are known."""

import numpy as np
import pytest

from surfkit.apps.texture.candidates import NO_PHOTO, Candidates
from surfkit.apps.texture.photo_gains import GAIN_SIGMA, KNEE, MAX_GAIN, exposed, exposure_gains, levelled


def strip(exposures, slope=0.0, each=60):
    """Triangles between photographs in a row: each shows those of its two neighbours too, brighter on its left side by
    a factor than on its right."""
    draw, count = np.random.default_rng(0), len(exposures)
    true = draw.uniform(0.2, 0.6, (each * (count - 1), 1, 3))
    one = np.repeat(np.arange(count - 1), each)
    shown = np.stack([one, one + 1], axis=1)
    sides = np.exp([-slope / 2, slope / 2])[None, :, None]  # the right side of the first, the left one of the second
    color = np.rint(255 * true * np.asarray(exposures)[shown][:, :, None] * sides).astype(np.uint8)
    return shown, color


def test_gains_bring_all_to_the_median_exposure():
    exposures = np.array([1.0, 0.7, 1.0, 1.3, 1.0, 0.75, 1.0, 1.0, 1.25])
    gains = exposure_gains(*strip(exposures), len(exposures))
    assert np.abs(gains * exposures[:, None] - 1).max() < 0.04
    most = exposure_gains(*strip(np.r_[exposures, 0.3]), 10)  # one that is out of all bounds moves no other
    assert np.abs(most[:9] / gains - 1).max() < 0.08 and most.max() <= MAX_GAIN


def test_a_slope_in_every_photograph_does_not_add_up_along_a_strip():
    """4 % from side to side: by ratios alone, the last of 40 photographs would be brightened 4.7 times as the first."""
    gains = exposure_gains(*strip(np.ones(40), slope=0.04), 40)
    assert np.abs(np.log(gains)).max() < GAIN_SIGMA and np.abs(np.log(gains[10:30])).max() < 0.02


def test_photographs_that_share_nothing_stay_as_they_are():
    shown, color = strip([0.8, 1.0, 1.25])
    gains = exposure_gains(np.where(shown == 2, NO_PHOTO, shown), color, 4)
    assert (gains[2:] == 1).all() and np.allclose(gains[0] / gains[1], 1.25, rtol=0.02)


@pytest.mark.parametrize("gain", [0.5, 0.7, 1.0, 1.2, 1.6, 2.0])
def test_colours_are_multiplied_but_near_white(gain):
    color = np.linspace(0, 1, 2001)
    found = exposed(color[:, None], np.full(1, gain))[:, 0]
    linear = color <= KNEE / max(gain, 1)
    np.testing.assert_allclose(found[linear], gain * color[linear], atol=1e-12)
    assert (np.diff(found) > 0).all() and found[0] == 0 and found[-1] == pytest.approx(1, abs=1e-12)
    assert np.abs(np.diff(found, 2)).max() < 2e-5, "no corner"
    white = 250 / 255
    assert abs((found >= white).mean() - (color >= white).mean()) < 0.012
    if gain == 1:
        np.testing.assert_allclose(found, color, atol=1e-12)


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
