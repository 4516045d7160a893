"""Outlines of the blocks that a run was cut into, as lines in space."""

from __future__ import annotations

import numpy as np

from surfkit.partition.base import Cells, Contraction

PIECES_PER_SIDE = 24
"""Pieces of a side of a block: sides are bent where the ground is contracted."""


def block_outlines(cells: Cells, positions: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes of all cells, from the lowest to the highest of the positions, cut off where the positions end.

    Args:
        cells: Of the blocks.
        positions: (N, 3) local, of the model.
        up: (3,) unit vector, local frame.

    Returns:
        (S, 2, 3) segments, (S,) the block of each, and (B, 3) a place for the name of each block, above its middle.
    """
    axes = cells.ground.axes.numpy()
    axes[2] *= 1.0 if axes[2] @ up >= 0 else -1.0
    places = positions @ axes.T
    low, high = np.percentile(places, [0.5, 99.5], axis=0)
    segments, owner, names = [], [], np.zeros((cells.count, 3))
    for box, block in zip(cells.boxes, cells.blocks, strict=True):
        ring = outline(box, cells.contraction, low[:2], high[:2])
        top, bottom = (np.column_stack([ring, np.full(len(ring), height)]) for height in (high[2], low[2]))
        corners = slice(0, None, PIECES_PER_SIDE)
        found = [np.stack([level, np.roll(level, -1, axis=0)], axis=1) for level in (top, bottom)]
        found.append(np.stack([top[corners], bottom[corners]], axis=1))
        segments += found
        owner += [block] * sum(map(len, found))
        names[block] = top.mean(0)
    return np.concatenate(segments) @ axes, np.array(owner), names @ axes


def outline(
    box: tuple[float | None, ...], contraction: Contraction | None, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """(4 SIDE, 2) places on the ground around a box, within bounds."""
    ends = (low, high) if contraction is None else (np.zeros(2), np.ones(2))
    x0, y0 = (end if value is None else value for value, end in zip(box[:2], ends[0], strict=True))
    x1, y1 = (end if value is None else value for value, end in zip(box[2:], ends[1], strict=True))
    steps = np.arange(PIECES_PER_SIDE) / PIECES_PER_SIDE
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    sides = np.roll(corners, -1, axis=0) - corners
    ring = (corners[:, None] + steps[:, None] * sides[:, None]).reshape(-1, 2)
    return np.clip(ring if contraction is None else spread_out(contraction, ring), low, high)


def spread_out(contraction: Contraction, places: np.ndarray) -> np.ndarray:
    """(N, 2) places on the ground of places in the unit square: the inverse of `Contraction.contracted`."""
    at = 4 * (np.clip(places, 1e-6, 1 - 1e-6) - 0.5)
    size = np.abs(at).max(1, keepdims=True)
    at = np.where(size > 1, at / np.maximum(size, 1e-12) / np.maximum(2 - size, 1e-12), at)
    low, high = np.asarray(contraction.low), np.asarray(contraction.high)
    return at * (high - low) / 2 + (low + high) / 2
