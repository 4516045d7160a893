"""Few values, or few rows of values, that stand for many."""

from __future__ import annotations

import numpy as np

BINS = 1 << 16
"""Of the histogram that single values are counted in."""
COARSE = 1 << 11
"""Of the histogram that the codes begin with."""
ROUNDS = 30
"""Passes of Lloyd's algorithm over single values."""
PASSES = 6
"""Passes of Lloyd's algorithm over rows."""
SAMPLE = 64
"""Rows for each code that is learned; the others are only assigned."""
BLOCK = 1 << 22
"""Distances in memory."""


def codebook(values: np.ndarray, size: int) -> np.ndarray:
    """The values that others are rounded to with the least squared error: 1-D k-means on a histogram.

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
    bins = np.minimum((values - low) * (BINS / (high - low)), BINS - 1).astype(np.int64)
    count, total = (np.bincount(bins, weight, BINS) for weight in (None, values))
    coarse = count.reshape(COARSE, -1).sum(1) ** (1 / 3)  # how dense the best codes lie, if they are many
    spread, edges = np.concatenate([[0], np.cumsum(coarse)]), np.linspace(low, high, COARSE + 1)
    codes = np.interp((np.arange(size) + 0.5) / size * spread[-1], spread, edges)
    used = count > 0
    count, total = count[used], total[used]
    centre = total / count
    counts, totals = (np.concatenate([[0], np.cumsum(each)]) for each in (count, total))
    for _ in range(ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(centre, (codes[1:] + codes[:-1]) / 2), [len(centre)]])
        inside = np.diff(counts[ends])
        codes = np.where(inside > 0, np.diff(totals[ends]) / np.maximum(inside, 1), codes)
    return np.sort(codes).astype(np.float32)


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
    if len(rows) <= size:
        return rows.copy(), np.arange(len(rows), dtype=np.int32)
    draw = np.random.default_rng(0)
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
    free = size - len(members)
    shares = 1 + np.floor(free * weight / weight.sum()).astype(int)
    return np.minimum(shares, np.maximum(count, 1)).tolist()


def _lloyd(rows: np.ndarray, size: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(K, D) codes learned on a sample, and the code of each row."""
    if len(rows) <= size:
        return rows.copy(), np.arange(len(rows), dtype=np.int32)
    sample = rows[np.sort(draw.choice(len(rows), min(len(rows), SAMPLE * size), replace=False))]
    codes = sample[np.sort(draw.choice(len(sample), size, replace=False))]
    for _ in range(PASSES):
        label = _assigned(sample, codes)
        order = np.argsort(label, kind="stable")
        there, starts = np.unique(label[order], return_index=True)
        count = np.diff([*starts, len(sample)])[:, None]
        codes[there] = np.add.reduceat(sample[order], starts, axis=0) / count
    return codes, _assigned(rows, codes)


def _assigned(rows: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """(N,) the nearest code of each row, int32."""
    half, label, step = (codes**2).sum(1) / 2, np.empty(len(rows), np.int32), max(1, BLOCK // len(codes))
    for start in range(0, len(rows), step):
        label[start : start + step] = (half - rows[start : start + step] @ codes.T).argmin(1)
    return label
