"""Leaving out what is no surface: broken triangles, small loose clusters, and what lies outside a crop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from surfkit.core.check import BadInput
from surfkit.mesh.base import Mesh
from surfkit.mesh.holes import areas_of, close_holes
from surfkit.scene.same_places import first_in_place


@dataclass(frozen=True)
class CleaningReport:
    """What cleaning did, and what is left.

    Attributes:
        not_finite: Triangles dropped because of a vertex that is not finite.
        degenerate: Triangles dropped that have no area.
        cropped: Triangles outside the crop.
        clusters: Groups of triangles before the small ones were dropped; see `clusters`.
        clusters_kept: Those that stayed.
        clustered: Triangles dropped with small clusters.
        triangles: Left.
        vertices: Left.
        boundaries: Closed runs of edges with one triangle: holes, and the rim of the mesh.
        longest_boundary: Length of the longest of them, local units; of open ground it is mostly the rim.
        boundary_share: Share of all edges that have one triangle only.
        holes_closed: Small holes that were filled.
    """

    not_finite: int
    degenerate: int
    cropped: int
    clusters: int
    clusters_kept: int
    clustered: int
    triangles: int
    vertices: int
    boundaries: int
    longest_boundary: float
    boundary_share: float
    holes_closed: int = 0


Inside = Callable[[np.ndarray], np.ndarray]
"""Which of (M, 3) local positions lie in a crop."""


def clean(
    mesh: Mesh, most: int, least: int, inside: Inside | None = None, hole_edges: int = 0, gap: float = 0.0
) -> tuple[Mesh, CleaningReport]:
    """The mesh without what is no surface, and what was left out.

    Args:
        mesh: Any.
        most: Clusters that are larger than one which is dropped; with fewer clusters, none is dropped for its rank.
        least: Triangles that a cluster must have to stay; if none has, the largest stays.
        inside: The crop; a triangle stays if its middle does.
        hole_edges: Holes of up to so many edges are filled.
        gap: See `clusters`.

    Raises:
        BadInput: Nothing is left.
    """
    if not len(mesh.faces):
        raise BadInput("the mesh has no triangles")
    finite = np.isfinite(mesh.vertices).all(1)
    mesh, not_finite = _keep(mesh, finite[mesh.faces].all(1))
    mesh = _welded(mesh)
    mesh, degenerate = _keep(mesh, areas_of(mesh.vertices, mesh.faces) > 0)
    cropped = 0
    if inside is not None:
        mesh, cropped = _keep(mesh, inside(mesh.vertices[mesh.faces].mean(1, dtype=np.float64)))
    if not len(mesh.faces):
        what = "all lie outside the crop or area: is it in the frame of the input?" if cropped else "none is whole"
        raise BadInput(f"no triangle of the mesh is left: {what}")
    mesh = _referenced(mesh)  # those of what was dropped are neither finite nor near
    labels, sizes = clusters(mesh, gap)
    large = large_enough(sizes, most, least)
    mesh, clustered = _keep(mesh, large[labels])
    mesh, closed = close_holes(_referenced(mesh), hole_edges)
    dropped = (not_finite, degenerate, cropped, len(sizes), int(large.sum()), clustered)
    return mesh, CleaningReport(*dropped, len(mesh.faces), len(mesh.vertices), *boundaries(mesh), closed)


def large_enough(sizes: np.ndarray, most: int, least: int) -> np.ndarray:
    """(C,) which clusters of so many triangles stay; see `clean`."""
    ranked = np.sort(sizes)[::-1]
    bound = max(least, ranked[most - 1] if len(sizes) >= most else 0)
    return sizes >= min(bound, ranked[0])


def clusters(mesh: Mesh, gap: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """(F,) number of the cluster of each triangle, and (C,) triangles of each cluster; a shared vertex connects.

    Args:
        mesh: Any.
        gap: Also what lies in touching cells of a grid connects, in median lengths of an edge: a wall that few views
            see at an angle comes in pieces with gaps of a voxel, which are no loose parts. 0 has no grid.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    node, near = _cells(mesh, gap) if gap else (np.arange(len(mesh.vertices)), np.zeros((0, 2), np.int64))
    a, b, c = node[mesh.faces.T]
    sides = [np.stack([x[x != y], y[x != y]], 1) for x, y in ((a, b), (b, c))]  # most of them lie within one cell
    ends = np.concatenate([*sides, near])
    links = coo_matrix((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(int(node.max()) + 1,) * 2)
    _, parts = connected_components(links, directed=False)
    part = parts[a]
    counts = np.bincount(part)
    used = counts > 0
    return (np.cumsum(used) - 1)[part], counts[used]


def _cells(mesh: Mesh, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """(V,) number of the cell of each vertex, and (L, 2) the pairs of cells in use that touch."""
    places = mesh.vertices.astype(np.float64)
    places -= places.min(0)
    edge = np.median(np.linalg.norm(places[mesh.faces[:, 0]] - places[mesh.faces[:, 1]], axis=1))
    side = max(gap * edge, places.max() / 2**20)  # so that the numbers of cells fit 64 bits
    cells = (places / side).astype(np.int64) + 1
    _, rows, columns = cells.max(0) + 2  # none beyond touches one at the other end
    used, node = np.unique((cells[:, 0] * rows + cells[:, 1]) * columns + cells[:, 2], return_inverse=True)
    near = []
    for x, y, z in product((-1, 0, 1), repeat=3):
        if (step := (x * rows + y) * columns + z) > 0:
            at = np.minimum(np.searchsorted(used, used + step), len(used) - 1)
            found = np.flatnonzero(used[at] == used + step)
            near.append(np.stack([found, at[found]], 1))
    return node, np.concatenate(near)


def boundaries(mesh: Mesh) -> tuple[int, float, float]:
    """Connected runs of edges that have one triangle only, the length of the longest, and their share of all edges."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    corners = mesh.faces.astype(np.int64)
    others = np.roll(corners, -1, 1)
    sides = np.sort((np.minimum(corners, others) << 32 | np.maximum(corners, others)).ravel())
    differs = np.ones(len(sides) + 1, bool)
    differs[1:-1] = sides[1:] != sides[:-1]
    rim = sides[differs[:-1] & differs[1:]]
    if not len(rim):
        return 0, 0.0, 0.0
    ends = np.stack([rim >> 32, rim & 0xFFFFFFFF], 1)
    points, at = np.unique(ends, return_inverse=True)
    at = at.reshape(-1, 2)
    links = coo_matrix((np.ones(len(at), bool), (at[:, 0], at[:, 1])), shape=(len(points),) * 2)
    count, parts = connected_components(links, directed=False)
    places = mesh.vertices[points].astype(np.float64)
    lengths = np.linalg.norm(places[at[:, 0]] - places[at[:, 1]], axis=1)
    share = len(rim) / int(differs[1:].sum())
    return int(count), float(np.bincount(parts[at[:, 0]], lengths).max()), share


def _keep(mesh: Mesh, faces: np.ndarray) -> tuple[Mesh, int]:
    """The mesh with some of its faces, and how many went."""
    return replace(mesh, faces=mesh.faces[faces]), int((~faces).sum())


def _referenced(mesh: Mesh) -> Mesh:
    """The mesh without vertices that no face has."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.faces] = True
    place = (np.cumsum(used) - 1).astype(np.int32)
    return mesh.take(used, place[mesh.faces])


def _welded(mesh: Mesh) -> Mesh:
    """The mesh with vertices in the same place made one; the first of them gives colour and values."""
    stands_for = first_in_place(mesh.vertices)
    return mesh if stands_for is None else _referenced(replace(mesh, faces=stands_for[mesh.faces]))
