"""Fewer triangles of the same surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from surfkit.core.optional import needed
from surfkit.mesh.base import Mesh


def require_simplification(what: str) -> None:
    """BadInput that says what to install, where the package that simplifies meshes cannot be loaded."""
    with needed("fast_simplification", what):
        import fast_simplification  # noqa: F401


def simplify_to(mesh: Mesh, count: int) -> Mesh:
    """The mesh with at most `count` triangles, by quadric error (Garland and Heckbert 1997, in fast-simplification).

    It is for meshes of any size: 10 million triangles take half a minute and 3 GB. A vertex gets the mean colour of
    those that it stands for.

    Raises:
        BadInput: fast-simplification cannot be loaded.
    """
    if count >= len(mesh.faces):
        return mesh
    require_simplification("simplifying a mesh")
    from fast_simplification import simplify as reduced

    # its first limits are lengths: a thousandth of an edge
    unit = 1 / max(_mean_edge(mesh), 1e-30)
    middle = mesh.vertices.mean(0, dtype=np.float64)
    places, faces = reduced((mesh.vertices - middle) * unit, mesh.faces, target_count=count)
    used, corners = np.unique(faces, return_inverse=True)
    vertices = (places[used] / unit + middle).astype(np.float32)
    found = replace(mesh, vertices=vertices, faces=corners.reshape(-1, 3).astype(np.int32), colors=None)
    return found if mesh.colors is None else replace(found, colors=_mean_colors(mesh, vertices))


def _mean_edge(mesh: Mesh) -> float:
    some = mesh.faces[:: max(1, len(mesh.faces) // 100_000)]
    return float(np.linalg.norm(mesh.vertices[some[:, 1]] - mesh.vertices[some[:, 0]], axis=1).mean())


def _mean_colors(mesh: Mesh, vertices: np.ndarray) -> np.ndarray:
    """(V, 3) uint8 of fewer vertices: the mean of the vertices of the mesh that are nearest to each, or of the next."""
    tree = KDTree(vertices)
    sums, counts = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for at in range(0, len(mesh.vertices), 1 << 20):
        part = slice(at, at + (1 << 20))
        nearest = tree.query(mesh.vertices[part], workers=-1)[1]
        counts += np.bincount(nearest, minlength=len(vertices))
        for channel in range(3):
            sums[:, channel] += np.bincount(nearest, mesh.colors[part, channel], len(vertices))
    known = counts > 0
    means = sums[known] / counts[known, None]
    colors = np.empty((len(vertices), 3), np.uint8)
    colors[known] = np.rint(means)
    if not known.all():
        colors[~known] = np.rint(means[KDTree(vertices[known]).query(vertices[~known])[1]])
    return colors
