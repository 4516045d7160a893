"""One photograph for each triangle: a good one, and the same as its neighbours have.

An energy of a graph of triangles, as in Lempitsky and Ivanov, Seamless Mosaicing of Image-Based Texture Maps (CVPR
2007): a triangle costs what its photograph lacks in quality, and an edge between two photographs costs the more, the
more their colours differ there (Kwatra et al., Graphcut Textures, SIGGRAPH 2003): seams run where they do not show. It
is lowered by min-sum belief propagation (Felzenszwalb and Huttenlocher, Efficient Belief Propagation for Early Vision,
IJCV 2006), which messages of 20 rounds make a local search; then connected triangles with the same photograph take
that of a neighbour together, where this lowers it.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from surfkit.apps.texture.candidates import NO_PHOTO, Candidates
from surfkit.apps.texture.topology import NO_FACE as NO_FACE
from surfkit.core.events import Progress, emit
from surfkit.scene.one_light import OneLight

SEAM_COST, SEAM_DIFFERENCE = 2.0, 0.04
"""Cost of an edge between two photographs where colours differ so much, of 1, and in proportion elsewhere; that of a
triangle is the share of the best quality that it lacks."""
LEAST_SEAM, MOST_SEAM = 0.25, 4.0
"""Bounds of that cost, in `SEAM_COST`."""
MESSAGE_ROUNDS = 20
"""Of messages between neighbours."""
DAMPING = 0.5
"""Share of a message that stays as it was."""
CHANGE_ROUNDS = 16
"""Rounds of changes of connected triangles, each of about half of them: neighbours must not change together."""
UNSEEN_COST = 1e3
"""Cost of a photograph that does not show the triangle."""
PART = 1 << 17
"""Triangles at once."""


def choose_views(found: Candidates, light: OneLight, beyond: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """(F,) int32 number of the photograph of each triangle; NONE where none shows it.

    Args:
        found: What can be chosen.
        light: Of the photographs.
        beyond: (F, 3) triangles beyond the edges, see `neighbours`.
        edge: (F, 3) edges of theirs.
    """
    best = found.quality.max(1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        cost = np.where(found.view != NO_PHOTO, 1 - found.quality / best, UNSEEN_COST).astype(np.float32)
    seam = seam_costs(found.differences(light), beyond)
    message = np.zeros((*beyond.shape, found.view.shape[1]), np.float32)
    for turn in range(MESSAGE_ROUNDS):
        total = cost + message.sum(1)
        after = np.empty_like(message)
        for at in range(0, len(cost), PART):
            part = slice(at, at + PART)
            for side in range(3):
                after[part, side] = _messages(found.view, total, message, seam, beyond, edge, part, side)
        message *= DAMPING  # in place: it is the largest array of all
        after *= 1 - DAMPING
        message += after
        emit(Progress("choosing photographs", turn + 1, MESSAGE_ROUNDS))
    slot = (cost + message.sum(1)).argmin(1)
    chosen = np.where(found.view.max(1) == NO_PHOTO, NO_PHOTO, found.view[np.arange(len(slot)), slot]).astype(np.int32)
    draw = np.random.default_rng(0)
    for _ in range(CHANGE_ROUNDS):
        chosen = _changed(chosen, found.view, cost, seam, beyond, draw)
    return chosen


def seam_costs(difference: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    """(F, 3) float32 cost of a seam along each edge: small where photographs show the same colours.

    Args:
        difference: (F,) of the photographs of each triangle, see `Candidates.differences`.
        beyond: (F, 3) triangles beyond the edges.
    """
    both = (difference[:, None] + np.where(beyond == NO_FACE, 0, difference[beyond])) / 2
    return (SEAM_COST * (both / SEAM_DIFFERENCE).clip(LEAST_SEAM, MOST_SEAM)).astype(np.float32)


def _messages(
    view: np.ndarray,
    total: np.ndarray,
    message: np.ndarray,
    seam: np.ndarray,
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
    found = np.broadcast_to(least + seam[part, side, None], theirs.shape).copy()
    for slot in range(view.shape[1]):
        same = (view[part] == view[there, slot][:, None]) & (view[part] != NO_PHOTO)
        found = np.where(same, np.minimum(found, theirs[:, slot, None]), found)
    found -= least
    found[(there == NO_FACE) | (view[there].max(1) == NO_PHOTO)] = 0
    return found


def _changed(
    chosen: np.ndarray,
    view: np.ndarray,
    cost: np.ndarray,
    seam: np.ndarray,
    beyond: np.ndarray,
    draw: np.random.Generator,
) -> np.ndarray:
    """The same after connected triangles took the photograph of a neighbour, where that lowers the energy most."""
    face, edge = np.nonzero((beyond != NO_FACE) & (chosen != NO_PHOTO)[:, None])
    there = beyond[face, edge]
    same = chosen[face] == chosen[there]
    graph = coo_matrix((np.ones(same.sum(), bool), (face[same], there[same])), (len(chosen), len(chosen)))
    part = connected_components(graph, directed=False)[1].astype(np.int64)
    size, stride = np.bincount(part), int(view.max()) + 2
    # what each part saves by the photograph of a neighbour: its seams with it, and what its triangles cost now
    cut = np.flatnonzero(~same & (chosen[there] != NO_PHOTO))
    wanted, kind = np.unique(part[face[cut]] * stride + chosen[there[cut]], return_inverse=True)
    if not len(wanted):
        return chosen
    own = np.where(view == chosen[:, None], cost, UNSEEN_COST).min(1)
    now = np.bincount(part, own)
    row, slot = np.nonzero(view != NO_PHOTO)
    key = part[row] * stride + view[row, slot]
    at = np.searchsorted(wanted, key).clip(max=len(wanted) - 1)
    hit = wanted[at] == key
    then = np.bincount(at[hit], cost[row[hit], slot[hit]], len(wanted))
    shown = np.bincount(at[hit], minlength=len(wanted))
    owner, label = np.divmod(wanted, stride)
    change = then - now[owner] - np.bincount(kind.reshape(-1), seam[face[cut], edge[cut]], len(wanted))
    usable = np.flatnonzero((shown == size[owner]) & (change < -1e-6))
    usable = usable[np.lexsort((change[usable], owner[usable]))]
    usable = usable[np.diff(owner[usable], prepend=-1) > 0]  # the best of each part
    usable = usable[draw.random(len(usable)) < 0.5]
    to = np.full(len(size), NO_PHOTO, np.int64)
    to[owner[usable]] = label[usable]
    return np.where(to[part] != NO_PHOTO, to[part], chosen).astype(np.int32)
