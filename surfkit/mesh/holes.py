"""Closing small holes: rings of edges with one triangle, filled with triangles of the least area (Barequet, Sharir)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from surfkit.mesh.base import Mesh

MIN_RIM_SHARE = 0.25
"""Share of the area of a connected part from which what would fill a ring shows that the ring is no hole."""
SIDE_AREA_WEIGHT = 0.05
"""Of the squared sides of a triangle, that counts as its area."""
BATCH_CORNER_PAIRS = 1_000_000
"""Pairs of corners of the rings that are filled together."""


def close_holes(mesh: Mesh, most: int) -> tuple[Mesh, int]:
    """The mesh with its small holes filled, and how many there were; vertices stay as they are.

    Args:
        mesh: Welded; triangles counter-clockwise seen from outside.
        most: Edges of a hole; longer rings stay open. So does the rim of a part that is open on one side: what would
            fill it is more than `MIN_RIM_SHARE` of the part.
    """
    if most < 3:
        return mesh, 0
    known, free = edges(mesh)
    parts = _parts(mesh)
    areas = np.bincount(parts[mesh.faces[:, 0]], areas_of(mesh.vertices, mesh.faces), parts.max(initial=0) + 1)
    made, count = [], 0
    for some in _alike(rings(free), most):
        corners, length = mesh.vertices[some].astype(np.float64), some.shape[1]
        local, first = fill(corners), length * np.arange(len(some))[:, None, None]
        faces = some.ravel()[first + local]
        spanned = areas_of(corners.reshape(-1, 3), (first + local).reshape(-1, 3)).reshape(len(some), -1).sum(1)
        fits = (spanned < MIN_RIM_SHARE * areas[parts[some[:, 0]]]) & ~_across(faces, local, length, known)
        made.append(faces[fits].reshape(-1, 3))
        count += int(fits.sum())
    if not count:
        return mesh, 0
    return replace(mesh, faces=np.concatenate([mesh.faces, *made]).astype(np.int32)), count


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


def _alike(found: Iterable[np.ndarray], most: int) -> Iterator[np.ndarray]:
    """(R, n) vertices of rings of up to `most` edges, those of one length together, not too many at once."""
    by_length = defaultdict(list)
    for ring in found:
        if 3 <= len(ring) <= most:
            by_length[len(ring)].append(ring)
    for length in sorted(by_length):
        rows, step = np.stack(by_length[length]), max(1, BATCH_CORNER_PAIRS // length**2)
        yield from (rows[first : first + step] for first in range(0, len(rows), step))


def _across(faces: np.ndarray, local: np.ndarray, count: int, known: np.ndarray) -> np.ndarray:
    """(R,) whether new triangles have an edge, beside those of their ring, that is among the edges of the mesh.

    Args:
        faces: (R, T, 3) vertices of the mesh.
        local: The same as places in a ring.
        count: Edges of a ring.
        known: (E,) names of the edges of the mesh, in order.
    """
    sides, places = (np.sort(some[:, :, [[0, 1], [1, 2], [2, 0]]], axis=3) for some in (faces, local))
    names = sides[..., 0].astype(np.int64) << 32 | sides[..., 1]
    within = ~np.isin(places[..., 1] - places[..., 0], (1, count - 1))
    there = known[np.searchsorted(known, names).clip(max=len(known) - 1)] == names
    return (within & there).any((1, 2))


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


def fill(rings: np.ndarray) -> np.ndarray:
    """(R, n - 2, 3) corners, as places in a ring, of the triangles that span rings of n edges with the least area.

    A little of the squared sides is added, so that of all that lie in a plane those with short sides are taken.

    Args:
        rings: (R, n, 3) positions.
    """
    count = rings.shape[1]
    best, split = np.zeros((len(rings), count, count)), np.zeros((len(rings), count, count), np.int64)
    for span in range(2, count):
        low = np.arange(count - span)
        between = low[:, None] + np.arange(1, span)  # corners of a triangle over the chord from low to low + span
        a, b, c = rings[:, low][:, :, None], rings[:, between], rings[:, low + span][:, :, None]
        area = np.linalg.norm(np.cross(b - a, c - a), axis=3)
        area += SIDE_AREA_WEIGHT * (((b - a) ** 2).sum(3) + ((c - b) ** 2).sum(3) + ((c - a) ** 2).sum(3))
        total = area + best[:, low[:, None], between] + best[:, between, (low + span)[:, None]]
        best[:, low, low + span] = total.min(2)
        split[:, low, low + span] = between[low, total.argmin(2)]
    faces = np.zeros((len(rings), count - 2, 3), np.int64)
    # Chords with something over them, and where in `faces` that begins.
    on, at, low, high = np.arange(len(rings)), *(np.full(len(rings), value) for value in (0, 0, count - 1))
    while len(on):
        middle = split[on, low, high]
        faces[on, at] = np.stack([low, middle, high], 1)
        left, right = middle - low > 1, high - middle > 1
        after = at + middle - low  # over the first half lie middle - low - 1 triangles
        on, at = np.concatenate([on[left], on[right]]), np.concatenate([at[left] + 1, after[right]])
        low, high = np.concatenate([low[left], middle[right]]), np.concatenate([middle[left], high[right]])
    return faces
