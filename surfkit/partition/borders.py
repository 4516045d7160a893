"""Where blocks meet: places along the borders between them."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.partition.base import Cells, Contraction

FINE_SIDE_PLACES = 4096
"""Places looked at along each side of a cell before they are spread evenly: the contraction bends and stretches it."""
MAX_SIDE_PLACES = 200_000
"""Places along each side of a cell."""


def border_places(cells: Cells, low: np.ndarray, high: np.ndarray, step: float) -> np.ndarray:
    """(M, 2) places along the borders between different blocks, inside a box of the ground.

    Args:
        cells: Of the blocks.
        low: (2,) least coordinates on the ground.
        high: (2,) greatest.
        step: Between places, local units.
    """
    ends = _ends(cells, low, high)
    found = []
    for box, block in zip(cells.boxes, cells.blocks, strict=True):
        for axis in (0, 1):
            if box[axis] is None:  # each border is the lower side of one of its two cells
                continue
            other = 1 - axis
            begin, end = (
                ends[at][other] if side is None else side for at, side in enumerate((box[other], box[other + 2]))
            )
            line = np.empty((FINE_SIDE_PLACES, 2))
            line[:, axis], line[:, other] = box[axis], np.linspace(begin, end, FINE_SIDE_PLACES)
            found.append(_between(cells, line, (axis, block), step))
    places = np.concatenate(found) if found else np.empty((0, 2))
    return places[((places >= low) & (places <= high)).all(1)]


def _ends(cells: Cells, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2,) each: where cells without an end are cut off, in the coordinates of their boxes."""
    if cells.contraction is None:
        return np.asarray(low, np.float64), np.asarray(high, np.float64)
    corners = torch.tensor([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])], dtype=torch.float64)
    far = float((cells.contraction.contracted(corners) - 0.5).abs().max())
    return np.full(2, 0.5 - far), np.full(2, 0.5 + far)


def _between(cells: Cells, line: np.ndarray, lower: tuple[int, int], step: float) -> np.ndarray:
    """(k, 2) places on the ground of the parts of a line beyond which another block lies, evenly spread."""
    axis, block = lower
    beyond = line.copy()
    beyond[:, axis] = np.nextafter(line[:, axis], -np.inf)
    owner = np.full(len(line), -1)
    for (x0, y0, x1, y1), of in zip(cells.boxes, cells.blocks, strict=True):
        inside = np.ones(len(line), bool)
        for at, low, high in ((0, x0, x1), (1, y0, y1)):
            inside &= (low is None or beyond[:, at] >= low) & (high is None or beyond[:, at] < high)
        owner[inside] = of
    kept = (owner >= 0) & (owner != block)
    if cells.contraction is not None:
        line = _stretched(cells.contraction, line)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    places = np.linspace(0, along[-1], min(MAX_SIDE_PLACES, int(along[-1] / step) + 2))
    spread = np.stack([np.interp(places, along, line[:, i]) for i in (0, 1)], axis=1)
    return spread[kept[np.searchsorted(along, places).clip(max=len(line) - 1)]]


def _stretched(contraction: Contraction, unit: np.ndarray) -> np.ndarray:
    """(n, 2) places on the ground of places in the unit square of a contraction."""
    low, high = (np.array(corner) for corner in (contraction.low, contraction.high))
    at = (unit - 0.5) * 4
    size = np.abs(at).max(1, keepdims=True)
    far = at / size.clip(1e-12) / (2 - size).clip(1e-9)
    return (low + high) / 2 + np.where(size > 1, far, at) * (high - low) / 2
