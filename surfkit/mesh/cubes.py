"""Which triangles a cube of eight voxels holds: the table of marching cubes, derived here from first principles.

A cube has corners c = x + 2 y + 4 z at unit positions, and edges e = 4 axis + u + 2 v, which go along `axis` from the
corner with coordinates u and v on the next two axes (cyclically). A case has bit c set where corner c is inside.

On each face of a cube the surface shows as segments between the edges that it crosses. Where two opposite corners are
inside, the segments cut off each of them; this depends on the face alone, so two cubes that share it agree, and no case
leaves a hole. Segments join to closed polygons, which are cut into triangles without a diagonal in a face of the cube:
there the neighbour might have the same one, and four triangles would meet in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np


def _edge(axis: int, u: int, v: int) -> int:
    return 4 * axis + u + 2 * v


def _start(edge: int) -> tuple[int, int, int]:
    """The corner from which an edge goes up its axis."""
    axis, u, v = edge // 4, edge & 1, edge >> 1 & 1
    place = [0, 0, 0]
    place[(axis + 1) % 3], place[(axis + 2) % 3] = u, v
    return place[0], place[1], place[2]


CUBE_EDGES = np.array([[*_start(edge), edge // 4] for edge in range(12)], np.int32)
"""(12, 4) x, y, z of the corner where each edge starts, and its axis."""


def _edge_between(a: int, b: int) -> int:
    """The edge between two neighbouring corners."""
    axis = (a ^ b).bit_length() - 1
    low = min(a, b)
    return _edge(axis, low >> (axis + 1) % 3 & 1, low >> (axis + 2) % 3 & 1)


def _rings() -> list[list[int]]:
    """The corners around each face, counter-clockwise seen from outside the cube."""
    rings = []
    for axis in range(3):
        a, b = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        low = [0, b, a | b, a]  # the face at 0 looks down its axis
        rings += [low, [corner | 1 << axis for corner in reversed(low)]]
    return rings


def _segments(case: int) -> Iterator[tuple[int, int]]:
    """Directed segments on the faces of a cube, from edge to edge, with the inside on their right seen from outside."""
    for ring in _rings():
        inside = [bool(case >> corner & 1) for corner in ring]
        crossed = [_edge_between(ring[i], ring[(i + 1) % 4]) for i in range(4)]
        for at in range(4):
            if inside[at] or not inside[(at + 1) % 4]:
                continue  # not where the ring enters the inside
            leave = next(at + k for k in range(1, 5) if not inside[(at + k + 1) % 4])
            yield crossed[at], crossed[leave % 4]


def _polygons(case: int) -> list[list[int]]:
    follows = dict(_segments(case))
    loops = []
    while follows:
        start = min(follows)
        loop, here = [start], follows.pop(start)
        while here != start:
            loop.append(here)
            here = follows.pop(here)
        loops.append(loop)
    return loops


def _in_one_face(a: int, b: int) -> bool:
    """Whether two edges lie in a common face of the cube."""
    ends = []
    for edge in (a, b):
        start = _start(edge)
        ends.append([set(range(2)) if axis == edge // 4 else {start[axis]} for axis in range(3)])
    return any(one == other and len(one) == 1 for one, other in zip(*ends, strict=True))


def _triangulations(loop: list[int]) -> Iterator[list[tuple[int, int, int]]]:
    """Every way to cut a polygon into triangles, in a fixed order."""
    if len(loop) < 3:
        yield []
        return
    for at in range(1, len(loop) - 1):
        for left in _triangulations(loop[: at + 1]):
            for right in _triangulations(loop[at:]):
                yield [*left, (loop[0], loop[at], loop[-1]), *right]


def _flat_diagonals(loop: list[int], triangles: list[tuple[int, int, int]]) -> int:
    sides = {frozenset((a, b)) for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)}
    pairs = {frozenset(pair) for a, b, c in triangles for pair in ((a, b), (b, c), (c, a))}
    return sum(_in_one_face(*pair) for pair in pairs - sides)


@cache
def triangles() -> np.ndarray:
    """(256, L) int8 edges of the triangles of each case, by threes, ended by -1; counter-clockwise from outside."""
    cases = []
    for case in range(256):
        found: list[int] = []
        for loop in _polygons(case):
            best = min(_triangulations(loop), key=lambda cut: _flat_diagonals(loop, cut))
            found += [edge for triangle in best for edge in triangle]
        cases.append(found)
    table = np.full((256, max(map(len, cases)) + 1), -1, np.int8)
    for case, found in enumerate(cases):
        table[case, : len(found)] = found
    table.setflags(write=False)
    return table
