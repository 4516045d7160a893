"""How far a simplified mesh lies from its original, against closed forms."""

import numpy as np
import pytest

from surfkit.apps.texture.level_error import level_error, spread
from surfkit.mesh.base import Mesh


def grid(height, side=10.0, count=41, low=0.0):
    x, y = np.meshgrid(*[np.linspace(low, low + side, count)] * 2, indexing="ij")
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))]).astype(np.int32)
    return Mesh(np.stack([x, y, height(x, y)], -1).reshape(-1, 3).astype(np.float32), faces)


def flat(x, y):
    return 0 * x


def both(one, other):
    faces = np.concatenate([one.faces, other.faces + len(one.vertices)])
    return Mesh(np.concatenate([one.vertices, other.vertices]), faces)


def test_places_are_spread_evenly():
    places, normals, apart = spread(grid(flat))
    counts = np.histogram2d(*places[:, :2].T, 10, [[0, 10]] * 2)[0]
    assert counts.min() > 0.9 * 1000 and counts.max() < 1.1 * 1000 and apart == pytest.approx(10 / np.sqrt(100_000))
    assert np.abs(normals[:, 2]) == pytest.approx(1)


def test_the_same_surface_in_fewer_triangles_is_no_error():
    assert level_error(grid(flat), grid(flat, count=2)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("away", [0.03, 0.7])
def test_a_surface_that_moved_is_off_by_its_distance(away):
    assert level_error(grid(flat), grid(lambda x, y: 0 * x + away, count=2)) == pytest.approx(away, rel=1e-3)


def test_waves_that_are_left_out():
    """95 % of a sine lies within sin(0.95 pi / 2) of its amplitude."""
    waves = grid(lambda x, y: 0.05 * np.sin(2 * np.pi * x / 2.5), count=201)
    assert level_error(waves, grid(flat, count=2)) == pytest.approx(0.05 * np.sin(0.95 * np.pi / 2), rel=0.01)


def test_a_part_that_is_missing_counts_as_far_as_it_reaches():
    """A tenth of the fine mesh is 5 to 8 away from the rest, in the same plane."""
    whole = both(grid(flat), grid(flat, side=10 / 3, low=13.5))
    assert level_error(whole, grid(flat)) > 4
    assert level_error(grid(flat), whole) == pytest.approx(0, abs=1e-6)
