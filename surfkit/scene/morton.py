"""The order of points along a Z-order curve (Morton 1966)."""

from __future__ import annotations

import numpy as np

AT_ONCE = 2**18
"""Positions whose places along the curve are computed together: of all, they would take more memory than the order."""


def morton_order(means: np.ndarray, cubes: bool = False) -> np.ndarray:
    """(N,) indices that sort (N, 3) positions along a Z-order curve: neighbours in space are near one another.

    Each axis is divided alike, whatever its extent; with `cubes`, into the same lengths, so that points of flat ground
    are not sorted by their heights.
    """
    if not len(means):
        return np.zeros(0, np.int64)
    low, high = means.min(0), means.max(0)
    extent = np.full(3, (high - low).max(), means.dtype) if cubes else high - low
    code = np.zeros(len(means), np.uint64)
    for begin in range(0, len(means), AT_ONCE):
        some = slice(begin, begin + AT_ONCE)
        code[some] = morton_codes(
            ((means[some] - low) / np.where(extent > 0, extent, 1) * (2**21 - 1)).astype(np.uint64)
        )
    return np.argsort(code, kind="stable")


def morton_codes(cells: np.ndarray) -> np.ndarray:
    """(N,) uint64 places along a Z-order curve of (N, 3) uint64 cells below 2^21: x has the lowest bits."""
    return _spread(cells[:, 0]) | _spread(cells[:, 1]) << np.uint64(1) | _spread(cells[:, 2]) << np.uint64(2)


def _spread(values: np.ndarray) -> np.ndarray:
    """21 bits of uint64 with two zeros after each."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values
