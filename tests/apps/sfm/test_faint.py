"""Features of faint photographs, as those under water or in haze."""

import numpy as np
import pytest
import torch

from surfkit.apps.sfm.sift import SIFT, stretched


def picture(contrast, middle=64.0, seed=0):
    """(3, 200, 300) uint8: blobs of several sizes, with so much contrast, in grey levels, about a middle."""
    draw, (rows, columns) = np.random.default_rng(seed), np.mgrid[:200, :300]
    grey = np.zeros((200, 300))
    spots = draw.uniform((0, 0, 2), (300, 200, 6), (150, 3))
    for (x, y, size), sign in zip(spots, draw.choice([-1, 1], 150), strict=True):
        grey += sign * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * size**2))
    grey = middle + contrast * grey / np.abs(grey).max()
    grey += draw.normal(0, contrast / 100, grey.shape)
    return torch.from_numpy(np.repeat(grey.round().clip(0, 255).astype(np.uint8)[None], 3, 0))


def test_a_faint_photograph_has_as_many_features_in_the_same_places():
    find = SIFT().opened(5000, torch.device("cpu"))
    faint, plain = (find(picture(*how)).keypoints for how in ((14, 40), (120, 128)))
    assert len(faint) > 0.7 * len(plain) > 50
    away = np.linalg.norm(faint[:, None, :2] - plain[None, :, :2], axis=2).min(1)
    assert np.mean(away < 1) > 0.8


def test_a_photograph_of_some_contrast_is_left_as_it_is():
    grey = picture(120, 128)[0].float().numpy()
    assert stretched(grey) is grey


def test_stretching_keeps_the_order_and_fills_the_range():
    grey = picture(14, 40)[0].float().numpy()
    found = stretched(grey)
    assert np.ptp(found) > 150 and (np.diff(found.ravel()[np.argsort(grey.ravel())]) >= 0).all()
    assert stretched(np.full((5, 5), 30, np.float32)) == pytest.approx(127.5), "one colour has no contrast"
    steps = np.resize([30.0, 31.0], (20, 20)).astype(np.float32)
    assert np.ptp(stretched(steps)) <= 8, "the steps of 8 bits are no features"
