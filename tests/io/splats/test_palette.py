"""Codebooks and palettes, against scipy's k-means and against bounds."""

import numpy as np
import pytest
from scipy.cluster.vq import kmeans2

from surfkit.io.splats.palette import codebook, nearest, palette
from surfkit.scene.morton import morton_order


def test_a_palette_is_nearly_as_good_as_one_level_of_k_means():
    draw = np.random.default_rng(0)
    common = draw.laplace(size=(4000, 8)) @ draw.normal(size=(8, 9))  # many small, some large
    rows = (0.05 * common + 0.03 * draw.laplace(size=(4000, 9))).astype(np.float32)
    codes, label = palette(rows, 128)
    assert codes.shape == (128, 9) and label.min() >= 0 and label.max() < 128
    found = float(((rows - codes[label]) ** 2).sum(1).mean())
    theirs, other = kmeans2(rows.astype(np.float64), 128, iter=20, minit="++", rng=np.random.default_rng(1))
    assert found < 1.15 * float(((rows - theirs[other]) ** 2).sum(1).mean())
    again, label_again = palette(rows, 128)
    assert np.array_equal(codes, again) and np.array_equal(label, label_again), "the same rows, the same palette"


def test_rows_that_fit_are_kept_as_they_are():
    draw = np.random.default_rng(0)
    kinds = draw.normal(size=(40, 45)).astype(np.float32)
    rows = kinds[draw.integers(0, 40, 2000)]
    codes, label = palette(rows, 64)
    assert len(codes) == 40 and np.array_equal(codes[label], rows)


@pytest.mark.parametrize("tail", [1.0, 30.0])
def test_no_value_is_far_from_its_code(tail):
    """A 64th of the span at most, and as little as the density allows where most values are."""
    draw = np.random.default_rng(0)
    values = np.concatenate([draw.normal(size=5000), tail * np.array([-1.0, -0.8, 0.9, 1.0])]).astype(np.float32)
    codes = codebook(values, 256)
    error = np.abs(values - codes[nearest(values, codes)])
    assert len(codes) == 256 and (np.diff(codes) >= 0).all()
    assert error.max() <= np.ptp(values) / 64 and np.median(error) < 0.02


def test_few_values_are_kept():
    values = np.array([3.0, -1.0, 3.0, 0.25], np.float32)
    codes = codebook(values, 16)
    assert codes.tolist() == [-1, 0.25, *[3.0] * 14] and codes[nearest(values, codes)].tolist() == values.tolist()
    assert codebook(np.zeros(0), 4).tolist() == [0] * 4


def test_neighbours_in_the_order_are_neighbours_in_space():
    """The four quarters of a square, and within each again, one after the other."""
    points = np.array([(x, y, 0.0) for y in range(4) for x in range(4)])
    found = points[morton_order(points)][:, :2].astype(int).tolist()
    assert found[:4] == [[0, 0], [1, 0], [0, 1], [1, 1]] and found[4:8] == [[2, 0], [3, 0], [2, 1], [3, 1]]
    assert len(morton_order(np.zeros((0, 3)))) == 0
