"""Which faces of a surface the views confirm."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.mesh.adjust import beside
from surfkit.mesh.sights import Sights, for_all
from surfkit.native import module


def supported(
    sights: Sights, points: np.ndarray, faces: np.ndarray, side: float, least_views: int, guesses: float
) -> np.ndarray:
    """(F,) bool: faces whose middle enough views confirm, and those less than `guesses` cells from one on the surface.

    Args:
        sights: What the views see.
        points: (P, 3) local.
        faces: (F, 3) rows of points.
        side: Of a cell, local units.
        least_views: That confirm a face: each has a depth within half a cell of it.
        guesses: See above.
    """
    native, threads = module(), torch.get_num_threads()
    corners = points[faces]
    middles = corners.mean(1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    views = np.zeros(len(faces), np.float32)
    at = middles.astype(np.float32), normals.astype(np.float32)
    for_all(sights, "confirming", lambda s: native.confirm(*at, 0.5 * side, views, *s.native, threads))
    distance = np.where(views >= least_views, 0.0, np.inf)
    a, b = beside(faces)
    open_ = (distance[a] > 0) | (distance[b] > 0)
    a, b = a[open_], b[open_]
    apart = np.linalg.norm(middles[a] - middles[b], axis=1)
    while True:
        before = distance.copy()
        np.minimum.at(distance, a, before[b] + apart)
        np.minimum.at(distance, b, before[a] + apart)
        distance[distance > guesses * side] = np.inf
        if (distance == before).all():
            return np.isfinite(distance)
