"""Fewer points, evenly: one for each voxel that has any, from blocks of points of any number."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import Blocks

VOXEL_INDEX_BITS = 21
"""Of a voxel's index along each axis, so that all three fit into one integer."""
MERGE_AT = 1 << 20
"""Voxels that wait to be merged, at least."""
COARSE_VOXELS, MAX_SPARSE_SHARE = 512, 0.2
"""Voxels along the diagonal by which the area of a large cloud is estimated; larger ones where more than such a share
of the points has a voxel of its own."""


def thin(blocks: Iterable[np.ndarray], voxel: float, origin: np.ndarray) -> np.ndarray:
    """(M, 3) float64 mean of the points in each voxel.

    Never more in memory than a few blocks and a few times the result.

    Args:
        blocks: (n, 3) positions each.
        voxel: Edge.
        origin: (3,) corner of a voxel; every point must be less than 2^20 voxels from it.
    """
    keys, sums = np.empty(0, np.int64), np.empty((0, 4))
    waiting: list[tuple[np.ndarray, np.ndarray]] = []
    for block in blocks:
        waiting.append(_grouped(_keys(block, voxel, origin), np.column_stack([block - origin, np.ones(len(block))])))
        if sum(len(part) for part, _ in waiting) > max(len(keys), MERGE_AT):
            keys, sums = _merged([(keys, sums), *waiting])
            waiting = []
    keys, sums = _merged([(keys, sums), *waiting])
    return sums[:, :3] / sums[:, 3:] + origin


def bounds(blocks: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(3,) least and (3,) greatest coordinates."""
    ends = [(block.min(0), block.max(0)) for block in blocks if len(block)]
    return np.min([low for low, _ in ends], axis=0), np.max([high for _, high in ends], axis=0)


def voxel_for(blocks: Blocks, most: int) -> float:
    """Edge of voxels of which about `most` would have points: a surface fills them with the inverse square of it."""
    low, high = bounds(blocks())
    coarse = max(float(np.linalg.norm(high - low)) / COARSE_VOXELS, 1e-12)
    count = sum(len(block) for block in blocks())
    while (filled := len(thin(blocks(), coarse, low))) > max(1, MAX_SPARSE_SHARE * count):
        coarse *= 2
    return coarse * (filled / most) ** 0.5


def _keys(points: np.ndarray, voxel: float, origin: np.ndarray) -> np.ndarray:
    at = np.floor((points - origin) / voxel)
    if len(at) and np.abs(at).max() >= 1 << (VOXEL_INDEX_BITS - 1):
        raise BadInput(f"voxels of {voxel:g} are too small for points that lie {np.ptp(points, axis=0).max():g} apart")
    at = at.astype(np.int64) + (1 << (VOXEL_INDEX_BITS - 1))
    return (at[:, 0] << 2 * VOXEL_INDEX_BITS) | (at[:, 1] << VOXEL_INDEX_BITS) | at[:, 2]


def _grouped(keys: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each key once, in order, and the sum of its rows."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=keys[:1] - 1)) if len(keys) else np.empty(0, np.intp)
    return keys[first], np.add.reduceat(values[order], first) if len(first) else values


def _merged(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    return _grouped(np.concatenate([keys for keys, _ in parts]), np.concatenate([sums for _, sums in parts]))
