"""The ground plan of a set of points: an alpha shape, as one polygon."""

from __future__ import annotations

import numpy as np

from surfkit.core.check import BadInput
from surfkit.scene.set_membership import is_among

RADIUS_CELLS = 8
"""Points closer than a radius over this, or than the extent over the next, are one: the triangulation stays small."""
EXTENT_CELLS = 400
MIN_PIECE_SHARE = 0.01
"""Pieces of less than this share of the area do not count."""


def outline(points: np.ndarray, radius: float) -> np.ndarray:
    """(K, 2) corners of the alpha shape of (n, 2) points, in order: holes are filled, small stray pieces left out.

    The union of the Delaunay triangles whose circumcircle is no larger than `radius` (alpha = 1 / radius). Where it
    falls into several pieces, the radius is doubled until it does not: the convex hull is where that ends.

    Raises:
        BadInput: Fewer than three points, or all on a line.
    """
    from scipy.spatial import Delaunay, QhullError

    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    points = _spread(points, min(radius / RADIUS_CELLS, extent / EXTENT_CELLS)) if extent > 0 else points[:1]
    centre = points.mean(0) if len(points) else 0.0
    try:
        triangles = Delaunay(points - centre).simplices if len(points) > 2 else None
    except QhullError:
        triangles = None
    if triangles is None or not len(triangles):
        raise BadInput(
            f"{len(points)} separate visible points on the ground span no area; lower --visible, or give --crop"
        )
    circles, areas = _circumradius(points, triangles)
    while True:
        kept = circles <= radius
        if kept.any() and (found := _one_piece(triangles[kept], areas[kept])) is not None:
            return points[_longest_ring(found, points)]
        radius *= 2


def _spread(points: np.ndarray, cell: float) -> np.ndarray:
    """One point in each square cell: the first."""
    at = np.floor((points - points.min(0)) / cell).astype(np.int64)
    _, first = np.unique(at, axis=0, return_index=True)
    return points[np.sort(first)]


def _circumradius(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T,) radii of the circumcircles, inf for flat triangles, and (T,) areas."""
    a, b, c = (points[triangles[:, i]] for i in range(3))
    ab, ac = b - a, c - a
    area = np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]) / 2
    product = np.linalg.norm(ab, axis=1) * np.linalg.norm(ac, axis=1) * np.linalg.norm(c - b, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(area > 0, product / (4 * area), np.inf), area


def _one_piece(triangles: np.ndarray, areas: np.ndarray) -> np.ndarray | None:
    """The triangles without stray pieces, or None where several large pieces remain."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(triangles)), 3)
    order = np.lexsort(sides.T)
    sides, owner = sides[order], owner[order]
    shared = np.flatnonzero((sides[1:] == sides[:-1]).all(1))
    pairs = (np.ones(len(shared)), (owner[shared], owner[shared + 1]))
    count, piece = connected_components(csr_matrix(pairs, shape=(len(triangles),) * 2), directed=False)
    share = np.bincount(piece, areas, minlength=count) / areas.sum()
    large = np.flatnonzero(share >= MIN_PIECE_SHARE)
    return triangles[piece == large[0]] if len(large) == 1 else None


def _longest_ring(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(K,) rows of the points around the triangles; of several rings the one around the most: the outer one."""
    a, b, c = (points[triangles[:, i]] for i in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles = np.where(turn[:, None] < 0, triangles[:, ::-1], triangles)
    begin, end = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    single = ~is_among(begin.astype(np.int64) * len(points) + end, end.astype(np.int64) * len(points) + begin)
    border: dict[int, list[int]] = {}
    for u, v in zip(begin[single].tolist(), end[single].tolist(), strict=True):
        border.setdefault(u, []).append(v)
    rings = []
    while border:
        start = min(border)
        ring, at = [start], start
        while True:
            following = border[at]
            step = _leftmost(points, ring[-2] if len(ring) > 1 else None, at, following)
            following.remove(step)
            if not following:
                del border[at]
            if step == start:
                break
            ring.append(step)
            at = step
        rings.append(ring)
    return np.array(max(rings, key=lambda ring: _signed_area(points[ring])))


def _leftmost(points: np.ndarray, before: int | None, at: int, following: list[int]) -> int:
    """Where a ring that keeps the shape on its left goes on, at a point where shapes touch: the sharpest turn right."""
    if before is None or len(following) == 1:
        return following[0]
    here = points[at] - points[before]
    angles = []
    for step in following:
        there = points[step] - points[at]
        angles.append(np.arctan2(here[0] * there[1] - here[1] * there[0], here @ there))
    return following[int(np.argmin(angles))]


def _signed_area(ring: np.ndarray) -> float:
    x, y = ring.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
