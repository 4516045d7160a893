"""Triangles of a mesh that cross others of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from surfkit.evaluate.mesh.boxes import boxes, by_number
from surfkit.evaluate.mesh.whole import WholeMesh

MAX_WHOLE_TRIANGLES = 1_000_000
"""Triangles of a mesh that is measured whole: 7 s of CPU time."""
SAMPLED_CUBES = 48
"""Cubes that are measured of a larger one."""
TRIANGLES_PER_CUBE = 10_000
"""Triangles in a cube that one sheet of surface goes straight through."""
MIN_MEAN_AREA_SHARE = 0.01
"""Of the mean area of a triangle, by which the median counts at least: slivers may be more than half."""
PAIRS = 1 << 20
"""Pairs of triangles in memory at a time."""
GRID_CELLS_PER_AXIS = 1 << 20
"""Of a grid, along an axis."""


@dataclass(frozen=True)
class Crossings:
    """What was found.

    Attributes:
        share: Of the triangles, that cross another one; None if no triangle was looked at.
        crossing: Triangles that cross another one.
        measured: Triangles that were looked at.
        boxes: Cubes that they lie in; None if they are all of the mesh.
        side: Of a cube, units of the mesh; None if all were looked at.
    """

    share: float | None
    crossing: int
    measured: int
    boxes: int | None = None
    side: float | None = None


def crossings(mesh: WholeMesh) -> Crossings:
    """Triangles that cross another one, in all of the mesh or in cubes of it.

    Two triangles cross if they have no common vertex, and an edge of one goes through the inside of the other. Those
    that only touch, or overlap in one plane, do not. In a cube the triangles that lie within it are measured, against
    all that reach into it, so cubes take nothing from the measure; larger triangles than a cube are not measured. Cubes
    are as likely as they have triangles, and the share is the mean of theirs.

    Args:
        mesh: Any.
    """
    total = len(mesh.faces)
    if total <= MAX_WHOLE_TRIANGLES:
        crossing = int(crossing_faces(mesh, np.arange(total)).sum())
        return Crossings(crossing / total, crossing, total)
    side = float(np.sqrt(TRIANGLES_PER_CUBE * max(np.median(mesh.areas), mesh.area / total * MIN_MEAN_AREA_SHARE)))
    crossed: list[int] = []
    measured: list[int] = []
    chosen: list[int] = []
    for box in boxes(mesh, side, by_number(mesh, SAMPLED_CUBES)):
        within = box.has(mesh.corners(box.faces)).all(1)
        if within.any():
            crossed.append(int((crossing_faces(mesh, box.faces) & within).sum()))
            measured.append(int(within.sum()))
            chosen.append(box.chosen)
    share = float(np.average(np.divide(crossed, measured), weights=chosen)) if chosen else None
    return Crossings(share, sum(crossed), sum(measured), len(chosen), side)


def crossing_faces(mesh: WholeMesh, faces: np.ndarray) -> np.ndarray:
    """(n,) bool, which of some faces of a mesh cross another one of them."""
    corners, vertices = mesh.corners(faces), mesh.faces[faces]
    corners -= corners.reshape(-1, 3).mean(0)
    found = np.zeros(len(faces), bool)
    for first, second in _near_pairs(corners.min(1), corners.max(1)):
        apart = (vertices[first][:, :, None] != vertices[second][:, None]).all((1, 2))
        first, second = first[apart], second[apart]
        hit = cross(corners[first], corners[second])
        found[first[hit]] = found[second[hit]] = True
    return found


def cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(n,) bool, which of (n, 3, 3) triangles and (n, 3, 3) others cross: Moeller's test (1997), with volumes.

    Each has corners on both sides of the plane of the other, and an edge of one goes through the inside of the other.
    """
    found = np.zeros(len(one), bool)
    rows = np.arange(len(one))
    sides: list[np.ndarray] = []
    for a, b in ((one, other), (other, one)):
        normal = np.cross(a[rows, 1] - a[rows, 0], a[rows, 2] - a[rows, 0])
        height = np.einsum("nij,nj->ni", b[rows] - a[rows, :1], normal)
        kept = (height.min(1) < 0) & (height.max(1) > 0)
        rows, sides = rows[kept], [side[kept] for side in sides] + [height[kept]]
    for (a, b), height in zip(((one[rows], other[rows]), (other[rows], one[rows])), sides, strict=True):
        for start, end in ((0, 1), (1, 2), (2, 0)):
            found[rows] |= (height[:, start] * height[:, end] < 0) & _through(b[:, start], b[:, end], a)
    return found


def _through(start: np.ndarray, end: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) bool, which lines from (n, 3) to (n, 3) go through the inside of (n, 3, 3) triangles."""
    direction, corners = (end - start)[:, None], triangles - start[:, None]
    volumes = (np.cross(corners, np.roll(corners, -1, axis=1)) * direction).sum(2)
    return (volumes > 0).all(1) | (volumes < 0).all(1)


def _near_pairs(low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Each pair of overlapping bounding boxes once, some at a time.

    A hierarchy of grids (Ericson, Real-Time Collision Detection, 2005, 7.2): a triangle lies in at most eight cells of
    the first grid whose cells are as large as it is, and looks for partners there and in all coarser grids.

    Args:
        low: (n, 3) least coordinates.
        high: (n, 3) greatest.
    """
    extent, origin = (high - low).max(1), low.min(0)
    base = max(float(np.median(extent)), float((high - origin).max()) / GRID_CELLS_PER_AXIS, 1e-300)
    level = np.ceil(np.log2((extent / base).clip(1))).astype(np.int64)
    for each in np.unique(level):
        size = base * 2.0**each
        seekers = np.flatnonzero(level <= each)
        places = _entries(low, high, seekers, origin, size)
        own = level[places[1]] == each
        yield from _joined(places, own, (low, high, level), origin, size)


def _entries(
    low: np.ndarray, high: np.ndarray, rows: np.ndarray, origin: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """(e,) numbers of cells in order, and (e,) row of the triangle in each."""
    first = ((low[rows] - origin) / size).astype(np.int64)
    last = ((high[rows] - origin) / size).astype(np.int64)
    numbers, owners = [], []
    for step in product((0, 1), repeat=3):
        reach = (last - first >= step).all(1)
        numbers.append(_cell(first[reach] + step))
        owners.append(rows[reach])
    number, owner = np.concatenate(numbers), np.concatenate(owners)
    order = np.argsort(number, kind="stable")
    return number[order], owner[order]


def _joined(
    places: tuple[np.ndarray, np.ndarray],
    own: np.ndarray,
    triangles: tuple[np.ndarray, np.ndarray, np.ndarray],
    origin: np.ndarray,
    size: float,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of a triangle of a grid with any that is in one of its cells, in the first cell that they share."""
    (number, owner), (low, high, level) = places, triangles
    held, holder = number[own], owner[own]
    begin, end = np.searchsorted(held, number, "left"), np.searchsorted(held, number, "right")
    totals = np.concatenate([[0], np.cumsum(end - begin)])
    start = 0
    while start < len(number):
        stop = max(start + 1, int(np.searchsorted(totals, totals[start] + PAIRS, "right")) - 1)
        counts = end[start:stop] - begin[start:stop]
        seeker = np.repeat(np.arange(start, stop), counts)
        order = np.arange(len(seeker)) - np.repeat(totals[start:stop] - totals[start], counts)
        a, b = owner[seeker], holder[begin[seeker] + order]
        kept = (level[a] < level[b]) | (a < b)  # of the same grid, each pair once
        a, b, cell = a[kept], b[kept], number[seeker[kept]]
        least = np.maximum(low[a], low[b])
        kept = (least <= np.minimum(high[a], high[b])).all(1)
        a, b, least = a[kept], b[kept], least[kept]
        kept = _cell(((least - origin) / size).astype(np.int64)) == cell[kept]
        yield a[kept], b[kept]
        start = stop


def _cell(places: np.ndarray) -> np.ndarray:
    """(n,) int64 number of each of (n, 3) cells."""
    return (places[:, 0] * (2 * GRID_CELLS_PER_AXIS) + places[:, 1]) * (2 * GRID_CELLS_PER_AXIS) + places[:, 2]
