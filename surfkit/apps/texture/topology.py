"""Which triangles of a mesh meet along an edge, and triangles that are small enough to be seen whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surfkit.mesh.base import Mesh

NO_FACE = -1
MAX_EDGE_HALVINGS = 12
"""Halvings of an edge at most."""


def neighbours(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) int32 triangles beyond the edges from each corner to the next, NONE at borders and where more than two
    triangles meet; (F, 3) int8 which of its edges that is there."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1).astype(np.int64)
    key = edges[:, 0] << 32 | edges[:, 1]
    order = np.argsort(key, kind="stable")
    key = key[order]
    same = np.concatenate([key[1:] == key[:-1], [False]])
    before = np.concatenate([[False], same[:-1]])
    after = np.concatenate([same[1:], [False]])
    first = np.flatnonzero(same & ~before & ~after)  # of exactly two
    one, other = order[first], order[first + 1]
    beyond, edge = np.full(len(order), NO_FACE, np.int32), np.zeros(len(order), np.int8)
    beyond[one], beyond[other] = other // 3, one // 3
    edge[one], edge[other] = other % 3, one % 3
    return beyond.reshape(-1, 3), edge.reshape(-1, 3)


def with_short_edges(mesh: Mesh, longest: float) -> Mesh:
    """The same surface without edges longer than `longest`, local units: they are halved until they are not.

    Both triangles of an edge get its middle, so no cracks arise. A large triangle is hardly ever seen whole.
    """
    vertices, faces, colors = mesh.vertices, mesh.faces, mesh.colors
    for _ in range(MAX_EDGE_HALVINGS):
        ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
        lengths = np.linalg.norm(vertices[ends[..., 0]] - vertices[ends[..., 1]], axis=2)
        long = lengths > longest
        if not long.any():
            break
        cut, number = np.unique(ends[long], axis=0, return_inverse=True)
        middle = np.full(faces.shape, NO_FACE, np.int64)
        middle[long] = len(vertices) + number.ravel()
        vertices = np.concatenate([vertices, vertices[cut].mean(1)]).astype(np.float32)
        if colors is not None:
            colors = np.concatenate([colors, np.rint(colors[cut].mean(1)).astype(np.uint8)])
        faces = _divided(faces, middle)
    return replace(mesh, vertices=vertices, faces=faces.astype(np.int32), colors=colors)


def _divided(faces: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Triangles in 2, 3 or 4, by the middles of the edges that are cut; NONE for those that are not."""
    cuts = (middle != NO_FACE).sum(1)
    parts = [faces[cuts == 0]]
    for count in (1, 2, 3):
        rows = np.flatnonzero(cuts == count)
        # turned so that the edge from a to b is cut, and, of two cuts, the one from b to c
        there = middle[rows] != NO_FACE
        first = there.argmax(1) if count != 2 else np.where(there[:, 0] & there[:, 2], 2, there.argmax(1))
        turn = (first[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[rows], turn, 1).T
        ab, bc, ca = np.take_along_axis(middle[rows], turn, 1).T
        made = {
            1: ((a, ab, c), (ab, b, c)),
            2: ((a, ab, bc), (ab, b, bc), (a, bc, c)),
            3: ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)),
        }[count]
        parts += [np.stack(part, axis=1) for part in made]
    return np.concatenate(parts)
