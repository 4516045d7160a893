"""Which faces of a surface the views confirm."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.mesh.refine_vertices import beside
from surfkit.mesh.view_observations import ViewObservations, boxes_of, for_all
from surfkit.raster.native import kernels


def supported(
    sights: ViewObservations, points: np.ndarray, faces: np.ndarray, side: float, least_views: int, guesses: float
) -> np.ndarray:
    """(F,) bool: faces whose middle enough views confirm, and those in gaps between them.

    A gap is what the closing of mathematical morphology (Serra 1982) fills, on the surface: what no disc of the width
    `guesses` that lies outside of the confirmed faces, or reaches over the end of the surface, covers. So narrow gaps
    are closed and bays at the rim are filled, and beyond the rim nothing is added.

    Args:
        sights: What the views see.
        points: (P, 3) local.
        faces: (F, 3) rows of points.
        side: Of a cell, local units.
        least_views: That confirm a face: each has a depth within half a cell of it.
        guesses: Width of the disc, cells.
    """
    native, threads = kernels(), torch.get_num_threads()
    corners = points[faces]
    middles = corners.mean(1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    views, at = np.zeros(len(faces), np.float32), middles.astype(np.float32)
    job = at, boxes_of(at), normals.astype(np.float32), 0.5 * side, views
    for_all(sights, "confirming", lambda sight: native.confirm(*job, *sight.native, threads))
    return closed(views >= least_views, middles, faces, guesses / 2 * side)


def closed(sure: np.ndarray, middles: np.ndarray, faces: np.ndarray, radius: float) -> np.ndarray:
    """(F,) bool: faces that are sure, and those that no disc outside of these covers; see `supported`.

    Distances are those along the surface, from middle to middle.

    Args:
        sure: (F,) bool.
        middles: (F, 3) of the faces.
        faces: (F, 3).
        radius: Of the disc.
    """
    a, b = beside(faces)
    neighbours = np.bincount(a, minlength=len(faces)) + np.bincount(b, minlength=len(faces))
    open_ = ~(sure[a] & sure[b])
    a, b = a[open_], b[open_]
    lengths = np.linalg.norm(middles[a] - middles[b], axis=1)
    begins = np.zeros(len(faces), bool)
    begins[a[sure[a]]] = begins[b[sure[b]]] = True
    outside = ~sure & (within(begins, a, b, lengths, radius) > radius)
    outside |= ~sure & (neighbours < 3)
    return sure | (within(outside, a, b, lengths, radius) > radius)


def within(begins: np.ndarray, a: np.ndarray, b: np.ndarray, lengths: np.ndarray, limit: float) -> np.ndarray:
    """(F,) distance from the next of the faces where `begins` (F,) is true, over pairs a, b (E,) of faces that are
    `lengths` (E,) apart; infinite beyond a limit."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    count, sources = len(begins), np.flatnonzero(begins)
    if not len(sources):
        return np.full(count, np.inf)
    ways = coo_matrix((np.maximum(lengths, 1e-30), (a, b)), shape=(count, count)).tocsr()
    return dijkstra(ways, directed=False, indices=sources, min_only=True, limit=limit)
