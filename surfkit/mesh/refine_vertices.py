"""Vertices moved to where the depth maps have them, and smoothed where these say little; edges stay sharp."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from surfkit.mesh.base import Mesh
from surfkit.mesh.view_observations import ViewObservations, boxes_of, for_all
from surfkit.raster.native import kernels

ADJUSTMENT_ROUNDS = 2
"""How often vertices are looked for in the views."""
MOVES_PER_ROUND = 3
"""How often they are moved each time."""
MIN_NORMAL_COSINE = 0.3
"""Cosine between the normals of a face before and after, below which its corners stay where they were."""
NORMAL_FILTER_PASSES = 3
"""How often normals are averaged in each round."""
NORMAL_SIGMA = 0.35
"""Difference of two unit normals at which one counts little for the mean of the other: about 20 degrees."""


def adjusted(sights: ViewObservations, mesh: Mesh, reach: float, near: float, smooth: float) -> Mesh:
    """The same surface, nearer to what the views see, with how many confirm each vertex and how far they lie apart.

    Each vertex is drawn along its normal to the planes that the pixels show which it falls on (mean with Tukey's
    weights), and to the planes of the faces around it, whose normals are averaged with those of their neighbours that
    differ little (Sun et al. 2007): what is flat gets flatter, edges stay.

    Args:
        sights: What the views see.
        mesh: Local frame.
        reach: Distance along the normal beyond which a depth does not count, local units.
        near: Depth up to which pixels count fully, local units: beyond, they are larger than what is told apart.
        smooth: Weight of the faces around, where 1 is that of a pixel that is fully trusted.

    Returns:
        With the value `views`, and `error`: the standard deviation of the depths that count from the vertex, along its
        normal, local units; NaN where there are none.
    """
    places, faces = mesh.vertices.astype(np.float64), mesh.faces
    for _ in range(ADJUSTMENT_ROUNDS):
        seen = VertexTargets.of(sights, places, vertex_normals(places, faces), reach, near)
        before = face_normals(places, faces)[0]
        level = filtered(before, faces)
        share = (seen.weights / (seen.weights + smooth))[:, None]
        moved = places
        for _ in range(MOVES_PER_ROUND):
            moved = moved + share * (seen.wanted - moved) + (1 - share) * to_planes(moved, faces, level)
        places = without_folds(places, moved, faces, before)
    seen = VertexTargets.of(sights, places, vertex_normals(places, faces), reach, near)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(np.where(seen.weights > 0, seen.squares / seen.weights, np.nan))
    values = {"views": seen.views, "error": error.astype(np.float32)}
    return replace(mesh, vertices=places.astype(np.float32), values=values)


@dataclass(frozen=True)
class VertexTargets:
    """Where the views have the vertices of a surface.

    Attributes:
        wanted: (V, 3) float64 mean of where they have each; where it is, if none has it.
        weights: (V,) float32 sum of the weights of these.
        squares: (V,) float32 sum of the squared distances by these weights.
        views: (V,) float32 number of views.
    """

    wanted: np.ndarray
    weights: np.ndarray
    squares: np.ndarray
    views: np.ndarray

    @staticmethod
    def of(
        sights: ViewObservations, places: np.ndarray, normals: np.ndarray, reach: float, near: float
    ) -> VertexTargets:
        """Look at (V, 3) places, whose unit normals are (V, 3), in all views; the lengths are those of `adjusted`."""
        sums, weights, squares, views = np.zeros((4, len(places)), np.float32)
        at = places.astype(np.float32)
        native, threads = kernels(), torch.get_num_threads()
        job = at, boxes_of(at), normals.astype(np.float32), reach, near, sums, weights, squares, views
        for_all(sights, "adjusting", lambda sight: native.pull(*job, *sight.native, threads))
        wanted = places + normals * (sums / np.maximum(weights, 1e-6))[:, None]
        return VertexTargets(wanted, weights, squares, views)


def without_folds(places: np.ndarray, moved: np.ndarray, faces: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(V, 3) moved places, but for the corners of faces that would turn over: these stay.

    Args:
        places: (V, 3) before.
        moved: (V, 3) after.
        faces: (F, 3).
        before: (F, 3) unit normals at the places before.
    """
    moved = moved.copy()
    while len(turned := faces[(face_normals(moved, faces)[0] * before).sum(1) < MIN_NORMAL_COSINE]):
        if (moved[turned] == places[turned]).all():
            break
        moved[turned] = places[turned]
    return moved


def to_planes(places: np.ndarray, faces: np.ndarray, level: np.ndarray) -> np.ndarray:
    """(V, 3) mean step to the planes of the faces around each vertex, of unit normals (F, 3)."""
    middles = places[faces].mean(1)
    step = np.zeros(places.shape)
    for k in range(3):
        along = ((middles - places[faces[:, k]]) * level).sum(1)
        for axis in range(3):
            step[:, axis] += np.bincount(faces[:, k], along * level[:, axis], len(places))
    return step / np.maximum(np.bincount(faces.ravel(), minlength=len(places)), 1)[:, None]


def face_normals(places: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) unit normals and (F,) areas."""
    a, b, c = places[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    sizes = np.linalg.norm(normals, axis=1)
    return normals / np.maximum(sizes, 1e-30)[:, None], sizes / 2


def vertex_normals(places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) unit normals: means of the faces around, by area."""
    normals, areas = face_normals(places, faces)
    sums = np.zeros(places.shape)
    for axis in range(3):
        for k in range(3):
            sums[:, axis] += np.bincount(faces[:, k], normals[:, axis] * areas, len(places))
    return sums / np.maximum(np.linalg.norm(sums, axis=1), 1e-30)[:, None]


def filtered(normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) unit normals, averaged over faces that share an edge and lie at little of an angle."""
    a, b = beside(faces)
    found = normals
    for _ in range(NORMAL_FILTER_PASSES):
        apart = ((found[a] - found[b]) ** 2).sum(1)
        weight = np.exp(-apart / (2 * NORMAL_SIGMA**2))[:, None]
        total = found.copy()
        for axis in range(3):
            total[:, axis] += np.bincount(a, weight[:, 0] * found[b, axis], len(found))
            total[:, axis] += np.bincount(b, weight[:, 0] * found[a, axis], len(found))
        found = total / np.maximum(np.linalg.norm(total, axis=1), 1e-30)[:, None]
    return found


def beside(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs of faces that share an edge, as two (E,) int64."""
    a, b = faces.astype(np.int64), np.roll(faces, -1, 1).astype(np.int64)
    keys = (np.minimum(a, b) << 32 | np.maximum(a, b)).ravel()
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    return order[same] // 3, order[same + 1] // 3
