"""Surfaces that touch themselves, taken apart: an edge has two triangles at most, a vertex one fan of them.

After "Cutting and stitching: converting sets of polygons to manifold surfaces" (Gueziec, Taubin, Lazarus, Horn 2001).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from surfkit.mesh.base import Mesh

SEPARATION_SHARE = 0.01
"""By how much vertices in one place are moved apart, as a share of the way to their neighbours."""
MERGE_SHARE = 2.0**-20
"""Places that are nearer than this are one, as a share of the extent."""
SEPARATION_ROUNDS = 20
"""Of moving apart."""


def separated(mesh: Mesh) -> Mesh:
    """The mesh with vertices doubled, so that an edge has one triangle, or two, one each way, and a vertex one fan.

    Where more triangles share an edge, those side by side stay together.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = mesh.faces.size
    start, end, pairs, crowded = _half_edges(mesh)
    pairs = pairs[start[pairs[:, 0]] == end[pairs[:, 1]]]
    after = np.roll(np.arange(count).reshape(-1, 3), -1, 1).ravel()
    more = [pair for some in crowded for pair in _side_by_side(mesh, some, start, end)]
    pairs = np.concatenate([pairs, np.array(more, np.int64).reshape(-1, 2)])
    # A half-edge from a to b and one from b to a: the corners at a are of one fan, and so are those at b.
    one = np.concatenate([pairs[:, 0], after[pairs[:, 0]]])
    other = np.concatenate([after[pairs[:, 1]], pairs[:, 1]])
    links = coo_matrix((np.ones(len(one), bool), (one, other)), shape=(count, count))
    fans = connected_components(links, directed=False)[1]
    _, row, at = np.unique(start << 32 | fans, return_index=True, return_inverse=True)  # in the order of the vertices
    mesh = mesh.take(mesh.faces.ravel()[row], at.reshape(-1, 3).astype(np.int32))
    for _ in range(SEPARATION_ROUNDS):
        if not (halves := _half_edges(mesh))[3]:
            break
        mesh = _halved(mesh, halves)
    return mesh


Halves = tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]


def _half_edges(mesh: Mesh) -> Halves:
    """(H,) vertices where each half-edge starts and ends; (P, 2) those that two make an edge; and those of edges with
    more. Half-edge 3 f + k goes from corner k of triangle f to the next."""
    start, end = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, 1).ravel().astype(np.int64)
    names = np.minimum(start, end) << 32 | np.maximum(start, end)
    order = np.argsort(names, kind="stable")
    first = np.flatnonzero(np.diff(names[order], prepend=-1))
    sizes = np.diff(np.append(first, len(names)))
    pairs = order[first[sizes == 2][:, None] + [0, 1]].reshape(-1, 2)
    crowded = [order[at : at + size] for at, size in zip(first[sizes > 2], sizes[sizes > 2], strict=True)]
    return start, end, pairs, crowded


def _halved(mesh: Mesh, halves: Halves) -> Mesh:
    """The mesh with new vertices in the middle of crowded edges, of all but one of the surfaces that pass there.

    Two surfaces may have both ends of an edge in common, as their triangles go around from one to the other; then
    doubling vertices does not part them. Triangles with two such edges are left for the next time.
    """
    start, end, _, crowded = halves
    faces = mesh.faces.copy()
    made: list[tuple[int, int, int]] = []
    ends: list[tuple[int, int]] = []
    touched: set[int] = set()
    for some in crowded:
        pairs = list(_side_by_side(mesh, some, start, end))
        paired = {half for pair in pairs for half in pair}
        sheets = pairs + [(half,) for half in some.tolist() if half not in paired]
        for sheet in sheets[1:]:
            triangles = {half // 3 for half in sheet}
            if triangles & touched:
                continue
            touched |= triangles
            middle = len(mesh.vertices) + len(ends)
            ends.append((start[sheet[0]], end[sheet[0]]))
            for half in sheet:
                face, k = divmod(half, 3)
                made.append((middle, *(faces[face, (k + turn) % 3] for turn in (1, 2))))
                faces[face, (k + 1) % 3] = middle
    low, high = np.array(ends, np.int64).reshape(-1, 2).T
    rows = np.concatenate([np.arange(len(mesh.vertices)), low])
    found = mesh.take(rows, np.concatenate([faces, np.array(made, np.int32).reshape(-1, 3)]))
    found.vertices[len(mesh.vertices) :] = (mesh.vertices[low] + mesh.vertices[high]) / 2
    return found


def _side_by_side(mesh: Mesh, some: np.ndarray, start: np.ndarray, end: np.ndarray) -> Iterator[tuple[int, int]]:
    """Pairs, one each way, of the half-edges of one edge: those whose triangles are next to each other around it."""
    low, high = sorted((int(start[some[0]]), int(end[some[0]])))
    a, axis = mesh.vertices[low].astype(np.float64), mesh.vertices[high].astype(np.float64) - mesh.vertices[low]
    axis /= np.linalg.norm(axis)
    aside = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    opposite = mesh.faces[some // 3, (some + 2) % 3]
    out = mesh.vertices[opposite] - a
    angles = np.arctan2(out @ np.cross(axis, aside), out @ aside)
    left: list[int] = []
    for edge in some[np.argsort(angles, kind="stable")].tolist():
        if left and start[left[-1]] != start[edge]:
            yield left.pop(), edge
        else:
            left.append(edge)


def apart(mesh: Mesh) -> Mesh:
    """The mesh with no two vertices in one place: programs that read files make them one, and edges crowded again.

    All but one of those in a place, also as files with 32 bits round it, are moved a little towards the middle of their
    own neighbours.
    """
    vertices = mesh.vertices.copy()
    low, step = vertices.min(0), max(float(np.ptp(vertices, axis=0).max()) * MERGE_SHARE, 1e-30)
    for turn in range(SEPARATION_ROUNDS):
        cells = ((vertices - low) / step).astype(np.int64)
        _, first = np.unique(cells[:, 0] << 42 | cells[:, 1] << 21 | cells[:, 2], return_index=True)
        double = np.ones(len(vertices), bool)
        double[first] = False
        if not double.any():
            break
        corners = mesh.faces[double[mesh.faces].any(1)]
        towards, counts = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
        for one, other in ((0, 1), (1, 2), (2, 0)):
            np.add.at(towards, corners[:, one], vertices[corners[:, other]])
            np.add.at(counts, corners[:, one], 1)
            np.add.at(towards, corners[:, other], vertices[corners[:, one]])
            np.add.at(counts, corners[:, other], 1)
        way = towards[double] / counts[double, None] - vertices[double]
        lengths = np.linalg.norm(way, axis=1)
        way[lengths == 0] = [1, 0, 0]
        # where triangles are tiny, farther each time, and not all as far
        least = step * (1 + turn) * (1 + np.flatnonzero(double) % 8)
        share = np.maximum(SEPARATION_SHARE, least / np.where(lengths > 0, lengths, 1))
        vertices[double] += (share[:, None] * way).astype(np.float32)
    return replace(mesh, vertices=vertices)
