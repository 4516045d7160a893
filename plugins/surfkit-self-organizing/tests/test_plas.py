"""The sorting, against assignments of scipy, filters by hand in float64, and grids whose best order is known."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from surfkit_self_organizing.plas import LEAST_BLOCK, best_orders, filtered, grouped, sorted_places

from surfkit.scene.morton import morton_order


def unlikeness(values: np.ndarray, width: int) -> float:
    """Mean distance of vectors that are neighbours in the whole rows of a grid."""
    grid = values[: len(values) // width * width].reshape(-1, width, values.shape[1])
    down, right = grid[1:] - grid[:-1], grid[:, 1:] - grid[:, :-1]
    return float(np.concatenate([np.linalg.norm(step, axis=-1).ravel() for step in (down, right)]).mean())


@pytest.mark.parametrize(
    ("count", "width"), [(1, 4), (2, 4), (3, 1), (7, 4), (100, 4), (101, 12), (300, 20), (64, 64), (97, 1)]
)
def test_every_element_has_one_place_whatever_the_size_of_the_grid(count, width):
    values = np.random.default_rng(count).normal(size=(count, 5))
    order = sorted_places(values, width, 0)
    assert np.array_equal(np.sort(order), np.arange(count))
    assert np.array_equal(order, sorted_places(values, width, 0))
    assert count < 10 or not np.array_equal(order, sorted_places(values, width, 1))


def test_elements_that_are_all_the_same_are_sorted_too():
    assert len(set(sorted_places(np.ones((50, 3)), 8, 0))) == 50


def test_random_colours_are_far_smoother_than_along_a_curve():
    width = 64
    values = np.random.default_rng(0).random((width * width, 3))
    found = unlikeness(values[sorted_places(values, width, 0)], width)
    assert found < unlikeness(values, width) / 6.5  # measured: 1 / 7.3
    assert found < unlikeness(values[morton_order(values)], width) / 2.2  # measured: 1 / 2.4
    assert found < unlikeness(values[np.lexsort(values.T)], width) / 5  # measured: 1 / 5.8


@pytest.mark.parametrize("count", [48 * 48, 48 * 48 - 31])
def test_a_smooth_grid_that_was_shuffled_is_about_as_smooth_again(count):
    y, x = np.divmod(np.arange(count), 48)
    values = np.stack([x, y], 1) / 48.0
    shuffled = np.random.default_rng(0).permutation(values)
    again = shuffled[sorted_places(shuffled, 48, 3)]
    assert unlikeness(again, 48) < 1.5 * unlikeness(values, 48)  # measured: 1.42 and 1.31; shuffled: 25


def test_groups_of_four_take_the_best_of_their_orders():
    draw = np.random.default_rng(0)
    grid, target = draw.normal(size=(2, 403, 6)).astype(np.float32)
    places = draw.permutation(403)[:400].reshape(-1, 4)
    chosen, gain = best_orders(grid, target, places)
    before = after = 0.0
    for group, order in zip(places, chosen, strict=True):
        cost = ((grid[group][:, None].astype(np.float64) - target[group]) ** 2).sum(-1)
        elements, at = linear_sum_assignment(cost)
        assert np.array_equal(order[at], elements)
        before, after = before + cost.trace(), after + cost[elements, at].sum()
    assert gain == pytest.approx(before - after, rel=1e-5)


def running(size: int, radius: int) -> np.ndarray:
    """(size, size) which places of a row are in the running sum at each; beyond the ends there is nothing."""
    place = np.arange(size)
    return (np.abs(place[:, None] - place) <= radius).astype(float)


@pytest.mark.parametrize("radius", [1, 3, 30])
def test_targets_are_means_like_a_pyramid_over_places_that_are_taken(radius):
    width, count = 9, 9 * 7 - 4
    values = np.random.default_rng(0).normal(size=(count, 2))
    y, x = np.divmod(np.arange(count), width)
    down, across = (np.linalg.matrix_power(running(size, radius), 2) for size in (7, width))
    both = down[np.ix_(y, y)] * across[np.ix_(x, x)]
    expected = both @ values / both.sum(1, keepdims=True)
    assert np.allclose(filtered(values.astype(np.float32), width, radius), expected, atol=1e-5)


def test_groups_are_within_blocks_and_leave_few_out():
    width, count, side = 23, 23 * 20 - 5, LEAST_BLOCK
    for seed in range(5):
        groups = grouped(count, width, side, np.random.default_rng(seed))
        assert groups.shape[1] == 4 and len(set(groups.ravel())) == groups.size <= count
        for along in (groups // width, groups % width):
            assert (np.ptp(along, axis=1) < side).all()
        blocks = (-(-width // side) + 1) * (-(-20 // side) + 1)
        assert count - groups.size <= 3 * blocks
    first, second = (grouped(count, width, side, np.random.default_rng(seed)) for seed in (0, 1))
    assert not np.array_equal(first, second)
