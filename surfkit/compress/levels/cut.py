"""Cuts points into boxes of as many points each, the halves of the halves of their bounding box."""

from __future__ import annotations

import math

import numpy as np


def depth_for(count: int, most: int) -> int:
    """How often `count` points are halved until no part has more than `most`."""
    return max(0, math.ceil(math.log2(count / most))) if count > most else 0


def cut(means: np.ndarray, depth: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Halve points `depth` times, each part at the median of the axis along which it is longest.

    Args:
        means: (N, 3) places, N at least 2^depth.
        depth: How often.

    Returns:
        (N,) the points in their new order, and for each depth from 0 the (2^depth + 1,) bounds of its parts in it.
        Parts of a part are neighbours. Equal coordinates keep their order, so that the same points give the same cut.
    """
    order, bounds = np.arange(len(means)), [np.array([0, len(means)])]
    for _ in range(depth):
        halves = [0]
        for first, last in zip(bounds[-1][:-1], bounds[-1][1:], strict=True):
            rows = order[first:last]
            places = means[rows]
            axis = int(np.argmax(places.max(0) - places.min(0)))
            order[first:last] = rows[np.argsort(places[:, axis], kind="stable")]
            halves += [first + (last - first + 1) // 2, last]
        bounds.append(np.array(halves))
    return order, bounds
