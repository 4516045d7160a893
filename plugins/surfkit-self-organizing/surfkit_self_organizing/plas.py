"""Sorting into a grid whose neighbours are alike: Parallel Linear Assignment Sorting (Morgenstern et al. 2024)."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from scipy.ndimage import uniform_filter1d

GROUP = 4
"""Elements that change places among one another; all their orders are compared."""
ORDERS = np.array(list(permutations(range(GROUP))))
"""(24, 4): which element goes to each of four places; the first order leaves them where they are."""
SHRINK = 0.9
"""What the radius of the filter is multiplied by from round to round."""
LEAST_GAIN = 0.005
"""A round ends when a pass lowers the sum of squared distances to the target by a smaller share than this."""
MOST_PASSES = 50
"""Passes of a round, at most."""
LEAST_BLOCK = 8
"""Places along the side of the smallest blocks."""
AT_ONCE = 8_192
"""Groups that are compared together, so that what is compared stays in the cache."""


def sorted_places(values: np.ndarray, width: int, seed: int) -> np.ndarray:
    """(N,) int64 which of N vectors is at each place of a grid, row by row, so that neighbours are alike.

    Elements begin in random order. In each round the target of a place is the grid there after a low-pass filter, whose
    radius shrinks from round to round; passes of exchanges bring elements nearer to the targets, until they hardly do.

    Args:
        values: (N, D) to compare by squared Euclidean distance.
        width: Places of a row. There are as many rows as N elements need; what is left of the last one stays empty.
        seed: Of the random draws; the same seed and values give the same places, on any number of threads.
    """
    count, draw = len(values), np.random.default_rng(seed)
    order = draw.permutation(count)
    height = -(-count // width)
    grid = values.astype(np.float32)[order]
    radius = max(width, height) / 2
    while radius >= 1 and count > 1:
        target = filtered(grid, width, int(radius))
        left = float(np.square(grid - target, dtype=np.float64).sum())
        side = max(LEAST_BLOCK, 2 * int(radius))
        for _ in range(MOST_PASSES):
            places = grouped(count, width, side, draw)
            chosen, gain = best_orders(grid, target, places)
            moved = np.take_along_axis(places, chosen, 1)
            order[places], grid[places] = order[moved], grid[moved]
            if gain <= LEAST_GAIN * left:
                break
            left -= gain
        radius *= SHRINK
    return order


def filtered(grid: np.ndarray, width: int, radius: int) -> np.ndarray:
    """(N, D) the grid after a low-pass filter, as large as what there is of it at the border.

    Two running means over 2 radius + 1 places, along rows and along columns: a filter like a pyramid. Empty places have
    no part in means.

    Args:
        grid: (N, D) by place.
        width: Places of a row.
        radius: 1 or more places.
    """
    count = len(grid)
    height = -(-count // width)
    whole = np.zeros((height * width, grid.shape[1] + 1), np.float32)
    whole[:count, :-1], whole[:count, -1] = grid, 1
    whole = whole.reshape(height, width, -1)
    for axis in (0, 1):
        for _ in range(2):
            whole = uniform_filter1d(whole, 2 * radius + 1, axis, mode="constant")
    whole = whole.reshape(height * width, -1)[:count]
    return whole[:, :-1] / whole[:, -1:]


def grouped(count: int, width: int, side: int, draw: np.random.Generator) -> np.ndarray:
    """(G, 4) int64 random groups of places, each within a block; up to three places of a block are in none.

    Args:
        count: Places that are taken, row by row.
        width: Places of a row.
        side: Of a block. Where blocks begin is random.
        draw: Random numbers.
    """
    place = np.arange(count)
    shift_x, shift_y = (int(shift) for shift in draw.integers(side, size=2))
    across = (width + shift_x) // side + 1
    block = (place // width + shift_y) // side * across + (place % width + shift_x) // side
    mixed = np.argsort(block << 32 | draw.integers(1 << 32, size=count))
    sizes = np.bincount(block)
    begin = np.cumsum(sizes) - sizes
    block = block[mixed]
    grouped = place - begin[block] < sizes[block] // GROUP * GROUP
    return mixed[grouped].reshape(-1, GROUP)


def best_orders(grid: np.ndarray, target: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, float]:
    """Of the 24 orders of each group that with the least sum of squared distances to the targets.

    The sums of squares of elements and of targets are the same in all orders, so that the scalar products decide.

    Args:
        grid: (N, D) by place.
        target: (N, D) by place.
        places: (G, 4).

    Returns:
        (G, 4) int64 from 0 to 3, which element of the group goes to each place; and by how much the sum falls.
    """
    chosen, gain = np.empty(places.shape, np.int64), 0.0
    for begin in range(0, len(places), AT_ONCE):
        some = places[begin : begin + AT_ONCE]
        product = np.einsum("gid,gjd->ijg", grid[some], target[some])
        sums = sum(product[ORDERS[:, at], at] for at in range(GROUP))  # (24, G)
        best = sums.argmax(0)
        chosen[begin : begin + AT_ONCE] = ORDERS[best]
        gain += 2 * float((sums.max(0) - sums[0]).sum(dtype=np.float64))
    return chosen, gain
