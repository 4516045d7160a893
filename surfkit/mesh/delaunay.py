"""The Delaunay tetrahedralisation of many points, in tiles that fit into memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surfkit.core.events import Progress, emit
from surfkit.raster.native import kernels

TETRA_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
"""Vertices of the edges of a tetrahedron."""

BYTES_A_POINT = 4_000
"""What Qhull takes, measured at a million points."""

MIN_TILE_POINTS = 2_000
"""Points in a tile, whatever the budget."""

HALO_DOUBLINGS = 3
"""How often the halo of a tile is doubled before what is left is taken as it is."""


def crossing(points: np.ndarray, known: np.ndarray, inside: np.ndarray, budget_bytes: int) -> tuple[np.ndarray, int]:
    """The tetrahedra that have known points only, some of them inside and some outside.

    Each tile is tetrahedralised with a halo around it and keeps what has its centroid in the tile. A tetrahedron whose
    circumscribed ball lies within the halo is the one that all points together would give.

    Args:
        points: (P, 3) float64, in general position.
        known: (P,) bool.
        inside: (P,) bool.
        budget_bytes: Memory to stay within.

    Returns:
        (T, 4) int64 rows of `points`, and how many of them are not certain.
    """
    most = max(MIN_TILE_POINTS, int(budget_bytes / BYTES_A_POINT / 2))  # half of it for the halo
    tiles = [(points.min(0), points.max(0))] if len(points) <= 2 * most else split(points, most)
    found, doubtful = [], 0
    for at, (low, high) in enumerate(tiles, 1):
        rows, uncertain = tile(points, known, inside, low, high, len(tiles) == 1)
        found.append(rows)
        doubtful += uncertain
        emit(Progress("tetrahedra", at, len(tiles)))
    return np.concatenate(found), doubtful


def split(points: np.ndarray, most: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Boxes, half open, that fill space and hold at most `most` points each: halved along the longest side."""
    found = []
    todo = [(np.full(3, -np.inf), np.full(3, np.inf), np.arange(len(points)))]
    while todo:
        low, high, rows = todo.pop()
        if len(rows) <= most:
            found.append((low, high))
            continue
        axis = int(np.ptp(points[rows], axis=0).argmax())
        at = float(np.median(points[rows, axis]))
        below = points[rows, axis] < at
        if not below.any():  # half of them in one place: nothing to halve
            found.append((low, high))
            continue
        upper, lower = high.copy(), low.copy()
        upper[axis] = lower[axis] = at
        todo += [(low, upper, rows[below]), (lower, high, rows[~below])]
    return found


def tile(
    points: np.ndarray, known: np.ndarray, inside: np.ndarray, low: np.ndarray, high: np.ndarray, alone: bool
) -> tuple[np.ndarray, int]:
    """The crossing tetrahedra of one box, (T, 4) rows of `points`, and how many of them are not certain."""
    from scipy.spatial import Delaunay, QhullError

    own = ((points >= low) & (points < high)).all(1) if not alone else np.ones(len(points), bool)
    if own.sum() < 4 and alone:
        return np.empty((0, 4), np.int64), 0
    halo = 0.25 * float(np.ptp(points[own], axis=0).max()) if own.any() else 0.0
    for _ in range(HALO_DOUBLINGS + 1):
        rows = (
            np.flatnonzero(((points >= low - halo) & (points <= high + halo)).all(1))
            if not alone
            else np.flatnonzero(own)
        )
        try:
            tets = rows[Delaunay(points[rows]).simplices]
        except QhullError:  # fewer than five points, or all in one plane: they enclose nothing
            return np.empty((0, 4), np.int64), 0
        some = inside[tets]
        tets = tets[known[tets].all(1) & some.any(1) & ~some.all(1)]
        if alone:
            return tets, 0
        centroid = points[tets].mean(1)
        tets = tets[((centroid >= low) & (centroid < high)).all(1)]
        centre, radius = circumscribed(points[tets])
        certain = ((centre - radius[:, None] >= low - halo) & (centre + radius[:, None] <= high + halo)).all(1)
        if certain.all():
            break
        halo *= 2
    return tets, int((~certain).sum())


def circumscribed(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, 3) centres and (T,) radii of the balls through (T, 4, 3) corners; infinite where these lie in a plane."""
    sides = corners[:, 1:] - corners[:, :1]
    squares = (sides**2).sum(2)
    volume = np.linalg.det(sides)
    b, c, d = sides.transpose(1, 0, 2)
    offset = (
        squares[:, 0, None] * np.cross(c, d)
        + squares[:, 1, None] * np.cross(d, b)
        + squares[:, 2, None] * np.cross(b, c)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = offset / (2 * volume[:, None])
    offset = np.where(np.isfinite(offset), offset, np.inf)
    return corners[:, 0] + offset, np.linalg.norm(offset, axis=1)


@dataclass(frozen=True)
class Tetrahedra:
    """A Delaunay tetrahedralisation.

    Attributes:
        points: (P + 4, 3) float64: those given, and the corners of a tetrahedron around all.
        corners: (T, 4) int32 rows of points, positively oriented.
        neighbours: (T, 4) int32 the tetrahedron opposite to each corner; -1 for none.
    """

    points: np.ndarray
    corners: np.ndarray
    neighbours: np.ndarray


def tetrahedralised(points: np.ndarray, step: float = 0.0) -> Tetrahedra:
    """The Delaunay tetrahedralisation of (P, 3) float64 points, by the compiled part: 6 us and 250 bytes a point.

    Points are rounded to whole multiples of a step, and are exact from there on; one in the place of another is left
    out, as the corner of no tetrahedron. Four points enclose all, so the hull is not exactly convex.

    Args:
        points: See above.
        step: 0 for the least that can be had, a millionth of the extent of the points.
    """
    given = np.ascontiguousarray(points, np.float64)
    step = step or kernels().least_step(given)
    corners, neighbours, enclosing, _ = kernels().tetrahedralise(given, step)
    return Tetrahedra(np.concatenate([points, enclosing]), corners, neighbours)
