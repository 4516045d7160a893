"""Triangles that collapsing edges has laid on one another, and edges that have got a third triangle by it."""

from __future__ import annotations

import numpy as np

from surfkit.mesh.base import Mesh
from surfkit.mesh.holes import areas_of
from surfkit.scene.same_places import first_in_place
from surfkit.scene.set_membership import is_among


def unfolded(mesh: Mesh, before: Mesh) -> Mesh:
    """The mesh with one triangle over three places, none whose corners share one, and no crowded edges that are new.

    An edge is crowded if it has more than two triangles; vertices in one place are taken for one. Of triangles over the
    same places, the one stays that agrees best with its neighbours on which side is outside. At crowded edges, such
    triangles go first, then the smallest, until there are no more crowded edges than `before` had: where walls meet,
    they are meant.

    Args:
        mesh: Simplified.
        before: What it was made of.
    """
    faces = _by_place(mesh)
    a, b, c = faces.T
    rows, folded = _one_of_each(faces, np.flatnonzero((a != b) & (b != c) & (c != a)))
    names = _edges(faces[rows])
    if len(crowded := _crowded(names)):
        near = np.flatnonzero(is_among(names.ravel(), crowded).reshape(-1, 3).any(1))  # all triangles of crowded edges
        order = np.lexsort((areas_of(mesh.vertices, mesh.faces[rows[near]]), ~folded[near]))
        rows = np.delete(rows, near[_too_many(names[near], order, len(_crowded(_edges(_by_place(before)))))])
    if len(rows) == len(faces):
        return mesh
    used, at = np.unique(mesh.faces[rows], return_inverse=True)
    return mesh.take(used, at.reshape(-1, 3).astype(np.int32))


def _by_place(mesh: Mesh) -> np.ndarray:
    """(F, 3) int64 first vertices in the places of the corners."""
    stands_for = first_in_place(mesh.vertices)
    return (mesh.faces if stands_for is None else stands_for[mesh.faces]).astype(np.int64)


def _edges(faces: np.ndarray) -> np.ndarray:
    """(F, 3) names of the edges from each corner to the next: lower vertex << 32 | higher one."""
    ends = np.roll(faces, -1, axis=1)
    return np.minimum(faces, ends) << 32 | np.maximum(faces, ends)


def _crowded(names: np.ndarray) -> np.ndarray:
    """(E,) those that are there more than twice, in order."""
    ordered = np.sort(names.ravel())
    return np.unique(ordered[2:][ordered[2:] == ordered[:-2]])


def _one_of_each(faces: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows that stay, so that no two have the same corners, in order; (R,) bool, which of these others lay on."""
    low, middle, high = np.sort(faces[rows], axis=1).T
    order = np.lexsort((high, middle, low))
    corners = np.stack([low, middle, high], 1)[order]
    number = np.empty(len(rows), np.int64)
    number[order] = np.cumsum((np.diff(corners, axis=0, prepend=-1) != 0).any(1)) - 1
    shared = np.bincount(number)[number] > 1
    alone, those = rows[~shared], rows[shared]
    # How many neighbours pass an edge of it the other way, as they should, less those that pass it the same way.
    passed = np.sort((faces[alone] << 32 | np.roll(faces[alone], -1, axis=1)).ravel())
    forth = faces[those] << 32 | np.roll(faces[those], -1, axis=1)
    back = np.roll(faces[those], -1, axis=1) << 32 | faces[those]
    agree = (_counts(passed, back) - _counts(passed, forth)).sum(1)
    best = np.lexsort((-agree, number[shared]))
    first = np.diff(number[shared][best], prepend=-1) != 0
    stays = ~shared
    stays[np.flatnonzero(shared)[best[first]]] = True
    return rows[stays], shared[stays]


def _counts(ordered: np.ndarray, values: np.ndarray) -> np.ndarray:
    """How often each value is among some in order."""
    return np.searchsorted(ordered, values, "right") - np.searchsorted(ordered, values, "left")


def _too_many(names: np.ndarray, order: np.ndarray, most: int) -> np.ndarray:
    """Rows of triangles to leave out, so that at most `most` edges have more than two.

    Args:
        names: (F, 3) of their edges; where one is crowded, all of its triangles are among these.
        order: Their rows, those that go first before others.
        most: Crowded edges that may be left.
    """
    edge = np.unique(names.ravel(), return_inverse=True)[1].reshape(-1, 3)
    rank = np.empty(len(edge), np.int64)
    rank[order] = np.arange(len(edge))
    left = np.ones(len(edge), bool)
    while True:
        crowded = np.bincount(edge[left].ravel(), minlength=edge.max() + 1) > 2
        if int(crowded.sum()) <= most:
            return np.flatnonzero(~left)
        first = np.full(len(crowded), len(edge))
        np.minimum.at(first, edge[left].ravel(), np.repeat(rank[left], 3))
        # one that is first at all its crowded edges: the very first is, so that this ends
        at = crowded[edge] & left[:, None]
        left &= ~(at.any(1) & ((first[edge] == rank[:, None]) | ~at).all(1))
