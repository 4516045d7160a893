"""Cuts points into boxes of as many points each, the halves of the halves of their bounding box."""

from __future__ import annotations

import math

import numpy as np


def depth_for(count: int, most: int) -> int:
    """How often `count` points are halved until no part has more than `most`."""
    return max(0, math.ceil(math.log2(count / most))) if count > most else 0


def halves(ends: np.ndarray) -> np.ndarray:
    """(2B + 1,) bounds of the halves of B parts, whose own are (B + 1,); of an odd part the first half is larger."""
    found = np.empty(2 * len(ends) - 1, np.int64)
    found[::2], found[1::2] = ends, ends[:-1] + (np.diff(ends) + 1) // 2
    return found


def cut(means: np.ndarray, depth: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Halve points `depth` times, each part at the median of the axis along which it is longest.

    All parts of a depth are sorted together: a million points down to pairs take seconds.

    Args:
        means: (N, 3) places, N at least 2^depth.
        depth: How often.

    Returns:
        (N,) the points in their new order, and for each depth from 0 the (2^depth + 1,) bounds of its parts in it.
        Parts of a part are neighbours. Equal coordinates keep their order, so that the same points give the same cut.
    """
    order, bounds = np.arange(len(means)), [np.array([0, len(means)])]
    for _ in range(depth):
        places, starts = means[order], bounds[-1][:-1]
        longest = (np.maximum.reduceat(places, starts) - np.minimum.reduceat(places, starts)).argmax(1)
        part = np.repeat(np.arange(len(starts)), np.diff(bounds[-1]))
        along = np.take_along_axis(places, longest[part][:, None], axis=1)[:, 0]
        order = order[np.lexsort((along, part))]
        bounds.append(halves(bounds[-1]))
    return order, bounds
