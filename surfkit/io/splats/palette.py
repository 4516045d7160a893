"""Few values, or few rows of values, that stand for many."""

from __future__ import annotations

import numpy as np

VALUE_BINS = 1 << 12
"""Of the histogram that single values are counted in."""
UNIFORM_SHARE_DIVISOR = 4
"""One of so many codes for single values is spent on even distances, so that rare ones, such as the scales of large
splats, are off by at most EVEN / size of the span; the others follow the density of the values."""
LLOYD_PASSES = 6
"""Passes of Lloyd's algorithm over rows."""
SAMPLES_PER_CODE = 64
"""Rows for each code that is learned; the others are only assigned."""
MAX_DISTANCES = 1 << 22
"""Distances in memory."""


def codebook(values: np.ndarray, size: int) -> np.ndarray:
    """The values that others are rounded to.

    Args:
        values: Finite numbers, any shape.
        size: Of the result.

    Returns:
        (size,) float32 in increasing order; where there are fewer different values, these, and the last one repeated.
    """
    values = values.reshape(-1).astype(np.float64)
    if not len(values):
        return np.zeros(size, np.float32)
    few = np.unique(values[: 64 * size])
    if len(few) <= size and len(few := np.unique(values)) <= size:
        return np.pad(few, (0, size - len(few)), "edge").astype(np.float32)
    low, high = float(values.min()), float(values.max())
    bins = np.minimum((values - low) * (VALUE_BINS / (high - low)), VALUE_BINS - 1).astype(np.int64)
    count, total = (np.bincount(bins, weight, VALUE_BINS) for weight in (None, values))
    dense = count ** (1 / 3)  # the density of the codes with the least mean error, where they are many
    share = np.cumsum(dense / dense.sum() * (1 - 1 / UNIFORM_SHARE_DIVISOR) + 1 / UNIFORM_SHARE_DIVISOR / VALUE_BINS)
    codes = np.interp(
        (np.arange(size) + 0.5) / size, share, low + (np.arange(VALUE_BINS) + 1) * (high - low) / VALUE_BINS
    )
    label = nearest(low + (np.arange(VALUE_BINS) + 0.5) * (high - low) / VALUE_BINS, codes)
    inside, sums = (np.bincount(label, weight, size) for weight in (count, total))
    return np.sort(np.where(inside > 0, sums / np.maximum(inside, 1), codes)).astype(np.float32)


def nearest(values: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """The index of the nearest of at most 256 increasing codes for each value, uint8."""
    return np.searchsorted((codes[1:] + codes[:-1]) / 2, values).astype(np.uint8)


def palette(rows: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows that stand for many, by k-means in two levels: the square root of `size` groups, each with codes of its own.

    Args:
        rows: (N, D) float32.
        size: Most codes.

    Returns:
        (K, D) float32 codes, K at most `size`, and the (N,) int32 code of each row.
    """
    draw = np.random.default_rng(0)
    _, first, label = np.unique(rows @ draw.normal(size=rows.shape[1]), return_index=True, return_inverse=True)
    if len(first) <= size and np.array_equal(rows[first][label], rows):
        return rows[first], label.astype(np.int32)
    groups = max(1, round(size**0.5))
    _, group = _lloyd(rows, groups, draw)
    order = np.argsort(group, kind="stable")
    ends = np.searchsorted(group[order], np.arange(groups + 1))
    members = [order[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]
    codes, labels, start = [], np.empty(len(rows), np.int32), 0
    for member, share in zip(members, _shares(rows, members, size), strict=True):
        if len(member):
            found, label = _lloyd(rows[member], share, draw)
            codes.append(found)
            labels[member] = label + start
            start += len(found)
    return np.concatenate(codes), labels


def _shares(rows: np.ndarray, members: list[np.ndarray], size: int) -> list[int]:
    """How many codes each group gets: more where there are more rows and where they differ more."""
    error = np.array([float(rows[member].var(0).sum()) if len(member) else 0.0 for member in members])
    count = np.array([len(member) for member in members])
    weight = count * np.sqrt(error) + 1e-12 * count
    wanted = (size - len(members)) * weight / weight.sum()
    shares = 1 + np.floor(wanted).astype(int)
    shares[np.argsort(wanted % -1, kind="stable")[: size - shares.sum()]] += 1  # what rounding down left over
    return np.minimum(shares, np.maximum(count, 1)).tolist()


def _lloyd(rows: np.ndarray, size: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(K, D) codes learned on a sample, and the code of each row."""
    if len(rows) <= size:
        return rows.copy(), np.arange(len(rows), dtype=np.int32)
    sample = rows[np.sort(draw.choice(len(rows), min(len(rows), SAMPLES_PER_CODE * size), replace=False))]
    codes = sample[np.sort(draw.choice(len(sample), size, replace=False))]
    length = (sample**2).sum(1)
    for _ in range(LLOYD_PASSES):
        label, value = _assigned(sample, codes)
        order = np.argsort(label, kind="stable")
        there, starts = np.unique(label[order], return_index=True)
        count = np.diff([*starts, len(sample)])[:, None]
        codes[there] = np.add.reduceat(sample[order], starts, axis=0) / count
        if len(there) < size:  # codes of no row begin again at the rows that are farthest from theirs
            unused = np.setdiff1d(np.arange(size), there)
            codes[unused] = sample[np.argsort(-(length + 2 * value), kind="stable")[: len(unused)]]
    return codes, _assigned(rows, codes)[0]


def _assigned(rows: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the nearest code of each row, int32, and half of its squared distance but for the length of the row."""
    half, step = (codes**2).sum(1) / 2, max(1, MAX_DISTANCES // len(codes))
    label, value = np.empty(len(rows), np.int32), np.empty(len(rows), np.float32)
    for start in range(0, len(rows), step):
        some = half - rows[start : start + step] @ codes.T
        label[start : start + step] = best = some.argmin(1)
        value[start : start + step] = np.take_along_axis(some, best[:, None], 1)[:, 0]
    return label, value
