"""Which faces of a surface the views confirm."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.mesh.refine_vertices import beside
from surfkit.mesh.view_observations import ViewObservations, boxes_of, for_all
from surfkit.raster.native import kernels

LARGE_CELLS = 16.0
"""Cells along the longest edge, from which a face is confirmed only if several places on it are: its middle alone may
happen to lie on the ground."""
INNER_PLACES = ((4, 1, 1), (1, 4, 1), (1, 1, 4), (1, 2.5, 2.5), (2.5, 1, 2.5), (2.5, 2.5, 1))
"""Of a large face, beside its middle: weights of its corners, in sixths."""


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
        least_views: That confirm a face: each has a depth within half a cell of its middle, and of further places on
            large ones.
        guesses: Width of the disc, cells.
    """
    corners = points[faces]
    middles = corners.mean(1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    large = np.flatnonzero(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1) > LARGE_CELLS * side)
    inner = np.einsum("fkc,pk->pfc", corners[large], np.array(INNER_PLACES) / 6).reshape(-1, 3)
    owners = np.concatenate([np.arange(len(faces)), np.tile(large, len(INNER_PLACES))])
    there = np.concatenate([middles, inner])
    views = np.full(len(faces), np.inf)
    np.minimum.at(views, owners, confirming(sights, there, normals[owners], side))
    return closed(views >= least_views, middles, faces, guesses / 2 * side)


def confirming(sights: ViewObservations, places: np.ndarray, normals: np.ndarray, side: float) -> np.ndarray:
    """(F,) float32, how many views have a depth within half a cell of (F, 3) places with (F, 3) unit normals."""
    native, threads = kernels(), torch.get_num_threads()
    views, at = np.zeros(len(places), np.float32), places.astype(np.float32)
    job = at, boxes_of(at), normals.astype(np.float32), 0.5 * side, views
    for_all(sights, "confirming", lambda sight: native.confirm(*job, *sight.native, threads))
    return views


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
