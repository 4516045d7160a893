"""One photograph for each triangle: a good one, and the same as its neighbours have.

An energy of a graph of triangles, as in Lempitsky and Ivanov, Seamless Mosaicing of Image-Based Texture Maps (CVPR
2007): a triangle costs what its photograph lacks in quality, and an edge between two photographs costs a constant. It
is lowered by min-sum belief propagation (Felzenszwalb and Huttenlocher, Efficient Belief Propagation for Early Vision,
IJCV 2006), and by single changes at the end.
"""

from __future__ import annotations

import numpy as np

from surfkit.core.events import Progress, emit
from surfkit.texture.candidates import NONE, Candidates
from surfkit.texture.topology import NONE as NO_FACE

SEAM = 0.6
"""Cost of an edge between two photographs; that of a triangle is the share of the best quality that it lacks."""
ROUNDS = 20
"""Of messages between neighbours."""
DAMPING = 0.5
"""Share of a message that stays as it was."""
CHANGES = 8
"""Rounds of single changes, each of half of the triangles."""
LARGE = 1e3
"""Cost of a photograph that does not show the triangle."""
PART = 1 << 17
"""Triangles at once."""


def choose_views(found: Candidates, beyond: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(F,) int32 number of the photograph of each triangle; NONE where none shows it.

    Args:
        found: What can be chosen.
        beyond: (F, 3) triangles beyond the edges, see `neighbours`.
        edge: (F, 3) edges of theirs.
    """
    best = found.quality.max(1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = np.where(found.view != NONE, 1 - found.quality / best, LARGE).astype(np.float32)
    message = np.zeros((*beyond.shape, found.view.shape[1]), np.float32)
    for turn in range(ROUNDS):
        total = cost + message.sum(1)
        after = np.empty_like(message)
        for at in range(0, len(cost), PART):
            part = slice(at, at + PART)
            for side in range(3):
                after[part, side] = _messages(found.view, total, message, beyond, edge, part, side)
        message = DAMPING * message + (1 - DAMPING) * after
        emit(Progress("choosing photographs", turn + 1, ROUNDS))
    slot = (cost + message.sum(1)).argmin(1)
    chosen = np.where(found.view.max(1) == NONE, NONE, found.view[np.arange(len(slot)), slot]).astype(np.int32)
    return _changed(chosen, found.view, cost, beyond)


def _messages(
    view: np.ndarray,
    total: np.ndarray,
    message: np.ndarray,
    beyond: np.ndarray,
    edge: np.ndarray,
    part: slice,
    side: int,
) -> np.ndarray:
    """(n, K) what the triangles beyond one edge of some triangles say to the photographs of these."""
    there = beyond[part, side]
    # what the neighbour would cost with each of its photographs, without what it was told from here
    theirs = total[there] - message[there, edge[part, side]]
    least = theirs.min(1, keepdims=True)
    found = np.broadcast_to(least + np.float32(SEAM), theirs.shape).copy()
    for slot in range(view.shape[1]):
        same = (view[part] == view[there, slot][:, None]) & (view[part] != NONE)
        found = np.where(same, np.minimum(found, theirs[:, slot, None]), found)
    found -= least
    found[(there == NO_FACE) | (view[there].max(1) == NONE)] = 0
    return found


def _changed(chosen: np.ndarray, view: np.ndarray, cost: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    """The same after changes of single triangles that lower the energy; neighbours seldom change at the same time."""
    draw = np.random.default_rng(0)
    padded = np.append(chosen, NONE)  # what lies beyond no edge
    for _ in range(CHANGES):
        for at in range(0, len(chosen), PART):
            part = slice(at, at + PART)
            around = padded[beyond[part]]
            differ = (around[:, :, None] != view[part][:, None, :]) & (around != NONE)[:, :, None]
            total = cost[part] + np.float32(SEAM) * differ.sum(1)
            slot = total.argmin(1)
            rows = np.arange(len(slot))
            now = (view[part] == padded[part][: len(slot), None]).argmax(1)
            change = (total[rows, slot] < total[rows, now] - 1e-6) & (draw.random(len(slot)) < 0.5)
            padded[:-1][part][change] = view[part][rows[change], slot[change]]
    return padded[:-1]
