"""How the triangles of a mesh hang together: edges that one triangle has, or more than two, and loose parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surfkit.evaluate.geometry.surface_file import BLOCK_POINTS
from surfkit.evaluate.mesh.whole import WholeMesh


@dataclass(frozen=True)
class Connections:
    """What the edges of a mesh tell.

    Attributes:
        edges: Pairs of vertices that are sides of a triangle.
        boundary_edges: Edges with one triangle: of holes and of the rim.
        non_manifold_edges: Edges with more than two triangles.
        components: Parts without a common vertex.
    """

    edges: int
    boundary_edges: int
    non_manifold_edges: int
    components: int


def connections(mesh: WholeMesh) -> Connections:
    """Count edges and parts; 3 F numbers of 64 bits are sorted, which is most of the memory.

    Args:
        mesh: Any.
    """
    ends = sorted_sides(mesh.faces)
    is_next = ends[1:] == ends[:-1]  # the same edge as the side before
    is_first = np.concatenate([[True], ~is_next])
    is_last = np.concatenate([~is_next, [True]])
    boundary = int((is_first & is_last).sum())
    non_manifold = int((is_first[:-2] & is_next[:-1] & is_next[1:]).sum())
    del is_last, is_next
    ends = ends[is_first]
    return Connections(len(ends), boundary, non_manifold, _components(ends, mesh.faces))


def boundary_edges(mesh: WholeMesh) -> tuple[np.ndarray, int]:
    """(E, 2) int64 vertices of the edges that have one triangle, and the number of all edges.

    Args:
        mesh: Any.
    """
    ends = sorted_sides(mesh.faces)
    differs = np.concatenate([[True], ends[1:] != ends[:-1], [True]])
    rim = ends[differs[:-1] & differs[1:]]
    return np.stack([rim >> 32, rim & 0xFFFFFFFF], axis=1), int(differs[1:].sum())


def sorted_sides(faces: np.ndarray) -> np.ndarray:
    """(3 F,) int64 sides of (F, 3) faces in order: the lower vertex in the upper 32 bits, the higher in the lower."""
    found = np.empty(3 * len(faces), np.int64)
    for start in range(0, len(faces), BLOCK_POINTS):
        corners = faces[start : start + BLOCK_POINTS].astype(np.int64)
        others = np.roll(corners, -1, 1)
        sides = np.minimum(corners, others) << 32 | np.maximum(corners, others)
        found[3 * start : 3 * start + sides.size] = sides.ravel()
    found.sort()
    return found


def _components(ends: np.ndarray, faces: np.ndarray) -> int:
    """Parts of the graph of edges, without vertices that no face has."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    count = int(faces.max()) + 1
    used = np.zeros(count, bool)
    used[faces.ravel()] = True
    starts = np.zeros(count + 1, np.int32)
    np.cumsum(np.bincount(ends >> 32, minlength=count), out=starts[1:])
    columns = (ends & 0xFFFFFFFF).astype(np.int32)
    links = csr_matrix((np.ones(len(ends), bool), columns, starts), shape=(count, count))
    return int(connected_components(links, directed=False)[0]) - int(count - used.sum())
