"""Alignments with known answers: truth that ends early, meshes that reach farther, noise, and real changes of size."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfkit.evaluate.geometry import comparison
from surfkit.evaluate.geometry.comparison import Comparison, compare, warn_of_loss
from surfkit.evaluate.geometry.scores import shares
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.evaluate.geometry.transform import apply, scale_of
from surfkit.scene.crop import Crop, write_crop

TAU = 1.0
WAYS = ("rigid", "similarity")
BOXES = ((18, 22, 16, 9, 11), (62, 28, 9, 21, 19), (41, 72, 24, 11, 7), (74, 76, 13, 12, 14))
"""Corner, two sides and height of houses."""


def town(seed, side=100.0, count=8_000, low=0.0):
    """(n, 3) points on the ground of a square town, from `low` to `side` along x and y, and on the walls and roofs of
    four houses within."""
    draw = np.random.default_rng(seed)
    parts = [np.column_stack([draw.uniform(low, side, (count, 2)), np.zeros(count)])]
    for x, y, wide, deep, high in BOXES:
        a, b = draw.uniform(size=(2, count // 30))
        parts.append(np.column_stack([x + a * wide, y + b * deep, np.full_like(a, high)]))
        for at in (y, y + deep):
            parts.append(np.column_stack([x + a * wide, np.full_like(a, at), b * high]))
        for at in (x, x + wide):
            parts.append(np.column_stack([np.full_like(a, at), y + a * deep, b * high]))
    return np.concatenate(parts)


def cloud(points):
    return SurfaceFile("given", points)


def measured(ours, truth, **settings):
    """F1 by way, and the change from the given frame by way."""
    wanted = {"crop": "none", "tau": TAU, "draws": 1, "classes": False} | settings
    outcome = compare(cloud(ours), cloud(truth), Comparison(**wanted))
    figures = {way: shares(draw.distances, outcome.tau)[2] for way, draw in outcome.others.items()}
    return figures, {way: draw.alignment.matrix for way, draw in outcome.others.items()}


@pytest.fixture
def square(tmp_path):
    """A crop volume of the whole town."""
    path = tmp_path / "crop.json"
    write_crop(path, Crop(np.array([[0, 0], [100, 0], [100, 100], [0, 100]], float), -3, 25))
    return str(path)


def test_a_truth_that_ends_early_does_not_pull_the_reconstruction(square):
    truth = town(0)
    figures, matrices = measured(town(7), truth[truth[:, 0] < 80], crop=square)
    for way in WAYS:
        assert figures[way] == pytest.approx(figures["none"], abs=0.01)
        assert abs(scale_of(matrices[way]) - 1) < 2e-3
        assert np.abs(matrices[way][:3, 3]).max() < TAU


def test_a_reconstruction_that_reaches_farther_is_not_shrunk():
    figures, matrices = measured(town(7, 130.0, low=-30.0, count=20_000), town(0))
    for way in WAYS:
        assert abs(scale_of(matrices[way]) - 1) < 5e-3
        assert figures[way] == pytest.approx(figures["none"], abs=0.01)


def known(scale):
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_rotvec([0.004, -0.006, 0.01]).as_matrix()
    matrix[:3, 3] = [0.7, -0.5, 0.4]
    return matrix


@pytest.mark.parametrize("scale", [1.0, 1.02])
@pytest.mark.parametrize("ends", [False, True])
def test_a_known_transform_is_found_also_where_the_truth_ends_early(scale, ends, square):
    truth, matrix = town(0), known(scale)
    truth = truth[truth[:, 0] < 80] if ends else truth
    ours = apply(np.linalg.inv(matrix), town(7))
    _, matrices = measured(ours, truth, crop=square)
    away = np.linalg.norm(apply(matrices["similarity"], ours) - apply(matrix, ours), axis=1)
    assert away.max() < TAU and abs(scale_of(matrices["similarity"]) / scale - 1) < 3e-3


def test_noise_does_not_shrink():
    draw, size = np.random.default_rng(3), []
    for noise in (1.0, 1.7):
        ours = town(7) + draw.normal(0, noise * TAU, (len(town(7)), 3))
        _, matrices = measured(ours, town(0))
        size.append(abs(scale_of(matrices["similarity"]) - 1))
    assert max(size) < 2e-3


def test_a_loss_by_alignment_is_told(warned):
    ours, truth = town(7, count=1_000), town(0, count=1_000)
    outcome = compare(cloud(ours), cloud(truth), Comparison(crop="none", tau=4 * TAU, draws=1))
    before = outcome.others["none"]
    worse = comparison.replace(before, distances=comparison.replace(before.distances, to_truth=np.full(99, 9.0)))
    assert not warned
    warn_of_loss(worse, before, "similarity", 4 * TAU)
    assert len(warned) == 1 and "--align similarity lowers F1 from 0.9" in warned[0] and "to 0.000" in warned[0]
