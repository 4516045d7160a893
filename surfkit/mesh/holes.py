"""Closing small holes: rings of edges with one triangle, filled with triangles of the least area (Barequet, Sharir)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surfkit.mesh.base import Mesh
from surfkit.scene.sets import is_among

RIM = 0.25
"""Share of the area of a connected part from which what would fill a ring shows that the ring is no hole."""
EVEN = 0.05
"""Of the squared sides of a triangle, that counts as its area."""


def close_holes(mesh: Mesh, most: int) -> tuple[Mesh, int]:
    """The mesh with its small holes filled, and how many there were; vertices stay as they are.

    Args:
        mesh: Welded; triangles counter-clockwise seen from outside.
        most: Edges of a hole; longer rings stay open. So does the rim of a part that is open on one side: what would
            fill it is more than `RIM` of the part.
    """
    if most < 3:
        return mesh, 0
    known, free = edges(mesh)
    parts = _parts(mesh)
    areas = np.bincount(parts[mesh.faces[:, 0]], areas_of(mesh.vertices, mesh.faces), parts.max(initial=0) + 1)
    made = []
    for ring in rings(free):
        if 3 <= len(ring) <= most:
            faces = fill(mesh.vertices[ring].astype(np.float64), ring)
            if areas_of(mesh.vertices, faces).sum() < RIM * areas[parts[ring[0]]] and not _across(faces, ring, known):
                made.append(faces)
    if not made:
        return mesh, 0
    return replace(mesh, faces=np.concatenate([mesh.faces, *made]).astype(np.int32)), len(made)


def edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The edges of a mesh, and those with triangles on one side only.

    Returns:
        (E,) int64 lower vertex << 32 | higher one, each once and in order; and (B, 2) int64 the vertices of an edge as
        a triangle passes it, of all triangles of edges that none passes the other way; in the order of the edges.
    """
    start, end = mesh.faces[:, [0, 1, 2]].ravel().astype(np.int64), mesh.faces[:, [1, 2, 0]].ravel().astype(np.int64)
    # One sort for both: the direction is the last bit, and vertices are less than 2^30.
    passed = np.sort(np.minimum(start, end) << 33 | np.maximum(start, end) << 1 | (start > end))
    names = passed >> 1
    first = np.flatnonzero(np.diff(names, prepend=-1))
    last = np.append(first[1:], len(names)) - 1
    one_way = (passed[first] & 1) == (passed[last] & 1)
    counts = last - first + 1
    found = passed[np.repeat(one_way, counts)]
    ends = np.stack([found >> 33, found >> 1 & 0xFFFFFFFF], 1)
    back = (found & 1).astype(bool)
    ends[back] = ends[back, ::-1]
    return names[first], ends


def rings(free: np.ndarray) -> list[np.ndarray]:
    """Vertices of each closed chain of edges that have one triangle, in the order in which what fills it passes them.

    Chains through a vertex where several meet are left out.

    Args:
        free: (B, 2) such edges, as a triangle passes them.
    """
    _, at, counts = np.unique(free, return_inverse=True, return_counts=True)
    once = (counts[at.reshape(-1, 2)] == 2).all(1)  # one edge comes, one goes
    return _rings({b: a for a, b in free[once].tolist()})


def _across(faces: np.ndarray, ring: np.ndarray, known: np.ndarray) -> bool:
    """Whether new triangles have an edge, beside those of the ring, that is among the edges of the mesh, in order."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    around = np.sort(np.stack([ring, np.roll(ring, -1)], 1), axis=1)
    names, own = (pairs[:, 0] << 32 | pairs[:, 1] for pairs in (sides, around))
    names = names[~is_among(names, own)]
    return bool((known[np.searchsorted(known, names).clip(max=len(known) - 1)] == names).any())


def _rings(follows: dict[int, int]) -> list[np.ndarray]:
    """The closed ones of the chains, each vertex at most once."""
    rings, left = [], dict(follows)
    for start in follows:
        ring = []
        at = start
        while (to := left.pop(at, None)) is not None:
            ring.append(at)
            at = to
        if ring and at == start:
            rings.append(np.array(ring))
    return rings


def _parts(mesh: Mesh) -> np.ndarray:
    """(V,) number of the connected part of each vertex."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = mesh.faces[:, :2].ravel(), mesh.faces[:, 1:].ravel()
    links = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(len(mesh.vertices),) * 2)
    return connected_components(links, directed=False)[1]


def areas_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) float64 areas, axis by axis: with numpy's cross product of rows it takes more than twice as long."""
    a, b, c = (np.ascontiguousarray(corners) for corners in faces.T)
    (ux, vx), (uy, vy), (uz, vz) = ((x[b] - x[a], x[c] - x[a]) for x in vertices.T.astype(np.float64, "C"))
    return np.sqrt((uy * vz - uz * vy) ** 2 + (uz * vx - ux * vz) ** 2 + (ux * vy - uy * vx) ** 2) / 2


def fill(ring: np.ndarray, names: np.ndarray) -> np.ndarray:
    """(n - 2, 3) names of the corners of the triangles that span a ring of (n, 3) positions with the least area.

    A little of the squared sides is added, so that of all that lie in a plane those with short sides are taken.
    """
    count = len(ring)
    best, split = np.zeros((count, count)), np.zeros((count, count), np.int64)
    for span in range(2, count):
        low = np.arange(count - span)
        between = low[:, None] + np.arange(1, span)  # corners of a triangle over the chord from low to low + span
        a, b, c = ring[low][:, None], ring[between], ring[low + span][:, None]
        area = np.linalg.norm(np.cross(b - a, c - a), axis=2)
        area += EVEN * (((b - a) ** 2).sum(2) + ((c - b) ** 2).sum(2) + ((c - a) ** 2).sum(2))
        total = area + best[low[:, None], between] + best[between, (low + span)[:, None]]
        chosen = total.argmin(1)
        best[low, low + span] = total[low, chosen]
        split[low, low + span] = between[low, chosen]
    faces, left = [], [(0, count - 1)]
    while left:
        low, high = left.pop()
        if high - low < 2:
            continue
        middle = int(split[low, high])
        faces.append((low, middle, high))
        left += [(low, middle), (middle, high)]
    return names[np.array(faces)]
