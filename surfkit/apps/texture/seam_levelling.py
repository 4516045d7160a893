"""Corrections of the colours on both sides of a seam, so that it vanishes, fading away from it.

Lempitsky and Ivanov, Seamless Mosaicing of Image-Based Texture Maps, CVPR 2007, section 4: a value is added at every
vertex of every photograph's part of the surface; where parts meet, the corrected colours of both are equal, and within
a part the values change little from vertex to vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import cg

from surfkit.apps.texture.candidates import NO_PHOTO
from surfkit.apps.texture.prefetch_photos import PrefetchedPhotos, by_photograph
from surfkit.apps.texture.topology import NO_FACE as NO_FACE
from surfkit.core.events import Progress, emit
from surfkit.scene.one_light import OneLight

SAMPLES_PER_EDGE = 5
"""Along each edge of a seam."""
SMOOTHNESS_WEIGHT = 0.3
"""Weight of the change along an edge within a part, to that of the difference at a seam."""
VALUE_WEIGHT = 0.003
"""Weight of the values themselves: far from seams they go back to 0."""
SEAM_ROBUST_SCALE = 0.1
"""Difference at a seam from which it counts little: light does not make it, but photographs that do not fit."""
WHITE_ROOM, DARK_COLOR = 0.2, 0.05
"""Colours nearer to white, or black, than this are changed less at seams."""
MAX_CORRECTION = 0.25
"""Largest value that is added."""


@dataclass(frozen=True)
class SeamCorrections:
    """Values to be added to colours in [0, 1].

    Attributes:
        corner: (F, 3) int64 rows of `value` for the corners of triangles with a photograph; else 0.
        value: (n, 3) float32.
    """

    corner: np.ndarray
    value: np.ndarray


def level(
    faces: np.ndarray,
    view: np.ndarray,
    places: np.ndarray,
    beyond: np.ndarray,
    photos: PrefetchedPhotos,
    light: OneLight,
) -> SeamCorrections:
    """Find the values.

    Args:
        faces: (F, 3) rows of vertices.
        view: (F,) photograph of each triangle; NONE for none.
        places: (F, 3, 2) corners in the photograph.
        beyond: (F, 3) triangles beyond the edges.
        photos: The photographs.
        light: Theirs.
    """
    seen = np.flatnonzero(view != NO_PHOTO)
    count = len(photos.views)
    known, inverse = np.unique(faces[seen].astype(np.int64) * count + view[seen, None], return_inverse=True)
    corner = np.zeros(faces.shape, np.int64)
    corner[seen] = inverse.reshape(-1, 3)
    there = view[beyond]
    face, edge = np.nonzero(
        (beyond != NO_FACE) & (there != view[:, None]) & (there != NO_PHOTO) & (view != NO_PHOTO)[:, None]
    )
    if not len(face):
        return SeamCorrections(corner, np.zeros((len(known), 3), np.float32))
    color = _seam_colors(corner, view, places, (face, edge), photos, light, len(known))
    ends = np.stack([corner[face, edge], corner[face, (edge + 1) % 3]], axis=1)
    # the same two vertices, of the part beyond
    vertices = np.stack([faces[face, edge], faces[face, (edge + 1) % 3]], axis=1).astype(np.int64)
    other = np.searchsorted(known, vertices * count + there[face, edge][:, None])
    pairs = np.unique(np.sort(np.stack([ends.ravel(), other.ravel()], axis=1), axis=1), axis=0)
    inner = np.stack([corner[seen], np.roll(corner[seen], -1, axis=1)], axis=2).reshape(-1, 2)
    inner = np.unique(np.sort(inner, axis=1), axis=0)
    return SeamCorrections(corner, _solved(pairs, inner, color, len(known)))


def levelled(color: np.ndarray, added: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 of colours in [0, 1] with what is added to them, less the nearer they are to black or white: there
    it would clip, and no seam shows."""
    room = np.minimum(color / DARK_COLOR, (1 - color) / WHITE_ROOM).clip(0, 1)
    return np.rint(255 * (color + room * added)).clip(0, 255).astype(np.uint8)


def _seam_colors(
    corner: np.ndarray,
    view: np.ndarray,
    places: np.ndarray,
    seam: tuple[np.ndarray, np.ndarray],
    photos: PrefetchedPhotos,
    light: OneLight,
    count: int,
) -> np.ndarray:
    """(n, 3) float64 mean colours of photographs at the vertices of seams, along the seams; elsewhere 0."""
    sums, weights = np.zeros((count, 3)), np.zeros(count)
    face, edge = seam
    parts = by_photograph(view[face])
    photos.expect([number for number, _ in parts])
    for done, (number, rows) in enumerate(parts, 1):
        picture, f, e = photos(number), face[rows], edge[rows]
        begin, end = places[f, e], places[f, (e + 1) % 3]
        for share in (np.arange(SAMPLES_PER_EDGE) + 0.5) / SAMPLES_PER_EDGE:
            x, y = np.floor(begin + share * (end - begin)).T.astype(np.int64)
            x, y = x.clip(0, picture.shape[2] - 1), y.clip(0, picture.shape[1] - 1)
            camera = photos.views[number].camera
            shown = light.even(picture[:, y, x].T / 255, number, camera, x + 0.5, y + 0.5)
            for at, weight in ((corner[f, e], 1 - share), (corner[f, (e + 1) % 3], share)):
                np.add.at(sums, at, weight * shown)
                np.add.at(weights, at, weight)
        emit(Progress("comparing colours at seams", done, len(parts)))
    return sums / np.maximum(weights, 1e-12)[:, None]


def _solved(pairs: np.ndarray, inner: np.ndarray, color: np.ndarray, count: int) -> np.ndarray:
    """(n, 3) float32 values that make colours equal across pairs, and differ little along the inner edges."""

    def laplacian(ends: np.ndarray, weight: np.ndarray) -> coo_matrix:
        one, other = ends.T
        graph = coo_matrix((weight, (one, other)), (count, count))
        return diags(np.bincount(one, weight, count) + np.bincount(other, weight, count)) - graph - graph.T

    one, other = pairs.T
    steps = color[other] - color[one]
    weight = 1 / (1 + (np.abs(steps).max(1) / SEAM_ROBUST_SCALE) ** 2) ** 2
    smooth = laplacian(inner, np.full(len(inner), SMOOTHNESS_WEIGHT))
    matrix = (laplacian(pairs, weight) + smooth + VALUE_WEIGHT * diags(np.ones(count))).tocsr()
    scale = diags(1 / matrix.diagonal())
    found = np.zeros((count, 3), np.float32)
    for channel in range(3):
        step = weight * steps[:, channel]
        side = np.bincount(one, step, count) - np.bincount(other, step, count)
        found[:, channel] = cg(matrix, side, rtol=1e-3, maxiter=500, M=scale)[0]
        emit(Progress("levelling seams", channel + 1, 3))
    return found.clip(-MAX_CORRECTION, MAX_CORRECTION)
