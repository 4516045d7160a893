"""What makes a polygon one whose area is beyond doubt: rings that do not cross, holes within, parts apart."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from surfkit.core.check import BadInput

BATCH_PAIRS = 1 << 21
"""Pairs of edges in memory."""


def signed_area(ring: np.ndarray) -> float:
    """Area of a closed ring, (n, 2) float64; negative if it runs clockwise."""
    x, y = (ring - ring[0]).T  # about its first place, as coordinates of maps are large
    return float(0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


def refuse_crossing(where: str, parts: Sequence[Sequence[np.ndarray]]) -> None:
    """BadInput, which names the place, for a polygon whose area is in doubt.

    Rings may touch other rings at single places, as OGC Simple Features (06-103r4, 6.1.11) has it; a ring must not
    touch itself.

    Args:
        where: What the message calls the polygon.
        parts: The polygons of it, each the outline, then the holes: (n, 2) float64, the first place again at the end.

    Raises:
        BadInput: Edges cross or lie on each other, a hole lies beyond its outline, or a part or hole within another.
    """
    rings = [ring for part in parts for ring in part]
    starts, ends = np.concatenate([ring[:-1] for ring in rings]), np.concatenate([ring[1:] for ring in rings])
    ring_of = np.repeat(np.arange(len(rings)), [len(ring) - 1 for ring in rings])
    first_of = np.cumsum([0, *(len(ring) - 1 for ring in rings)])
    for one, other in _near_pairs(starts, ends):
        same = ring_of[one] == ring_of[other]
        apart, least, most = np.abs(one - other), np.minimum(one, other), np.maximum(one, other)
        closing = (least == first_of[ring_of[one]]) & (most == first_of[ring_of[one] + 1] - 1)
        neighbours = same & ((apart == 1) | closing)
        crossing, touching, overlapping = _meetings(starts[one], ends[one], starts[other], ends[other])
        bad = overlapping | ~neighbours & (crossing | same & touching)
        if bad.any():
            at = int(np.flatnonzero(bad)[0])
            place = _meeting_place(starts[one[at]], ends[one[at]], starts[other[at]], ends[other[at]])
            raise BadInput(
                f"{where}: its outline crosses or touches itself near {place[0]:.9g} {place[1]:.9g}, so its area is in "
                "doubt; repair it (in QGIS: Fix geometries), and do it again"
            )
    for part in parts:
        for at, hole in enumerate(part[1:]):
            if not _within(hole, part[0]):
                raise BadInput(f"{where}: hole {at + 1} lies beyond the outline; repair it (in QGIS: Fix geometries)")
        if any(_within(one, other) for one in part[1:] for other in part[1:] if one is not other):
            raise BadInput(f"{where}: one of its holes lies within another; repair it (in QGIS: Fix geometries)")
    for part, whole in ((part, whole) for part in parts for whole in parts if part is not whole):
        if _within(part[0], whole[0]) and not any(_within(part[0], hole) for hole in whole[1:]):
            raise BadInput(f"{where}: one of its parts lies within another; repair it (in QGIS: Fix geometries)")


def _near_pairs(starts: np.ndarray, ends: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Numbers of edges whose bounding boxes meet, (k,) int64 each, some at a time; each pair once."""
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    order = np.argsort(low[:, 0], kind="stable")
    last = np.searchsorted(low[order, 0], high[order, 0], side="right")
    count = last - np.arange(len(order)) - 1
    total = np.cumsum(count)
    first = 0
    while first < len(order):
        before = total[first] - count[first]
        stop = max(first + 1, int(np.searchsorted(total, before + BATCH_PAIRS, "right")))
        some = np.arange(first, stop)
        owner = np.repeat(some, count[some])
        within = np.arange(len(owner)) - np.repeat(np.cumsum(count[some]) - count[some], count[some])
        one, other = order[owner], order[owner + 1 + within]
        near = (low[one, 1] <= high[other, 1]) & (low[other, 1] <= high[one, 1])
        yield one[near], other[near]
        first = stop


def _side(start: np.ndarray, end: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(k,) positive where a place lies left of the way from start to end, 0 on the line."""
    along, to = end - start, place - start
    return along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]


def _meetings(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(k,) bool: where the edges a-b and c-d cross within both; have a place in common; lie on each other."""
    sides = [np.sign(_side(*each)) for each in ((a, b, c), (a, b, d), (c, d, a), (c, d, b))]
    crossing = (sides[0] * sides[1] < 0) & (sides[2] * sides[3] < 0)
    boxes = (np.minimum(a, b) <= np.maximum(c, d)).all(1) & (np.minimum(c, d) <= np.maximum(a, b)).all(1)
    touching = boxes & (sides[0] * sides[1] <= 0) & (sides[2] * sides[3] <= 0)
    shared = np.minimum(np.maximum(a, b), np.maximum(c, d)) - np.maximum(np.minimum(a, b), np.minimum(c, d))
    flat = (sides[0] == 0) & (sides[1] == 0)
    return crossing, touching, flat & (shared >= 0).all(1) & (shared > 0).any(1)


def _meeting_place(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """(2,) float64: where two edges meet, for a message."""
    (ux, uy), (vx, vy) = b - a, d - c
    turn = ux * vy - uy * vx
    if turn == 0:
        return np.maximum(np.minimum(a, b), np.minimum(c, d))
    return a + ((c[0] - a[0]) * vy - (c[1] - a[1]) * vx) / turn * (b - a)


def _within(ring: np.ndarray, other: np.ndarray) -> bool:
    """Whether a ring lies in another one that it does not cross; it may touch it.

    The middle of an edge that is not on the other ring decides: most middles agree.
    """
    middles = (ring[:-1] + ring[1:]) / 2
    middles = middles[:: max(1, len(middles) // 5)]
    inside = 0
    for x, y in middles:
        (ax, ay), (bx, by) = other[:-1].T, other[1:].T
        over = (ay > y) != (by > y)
        cut = ax[over] + (y - ay[over]) / (by - ay)[over] * (bx - ax)[over]
        inside += int((cut > x).sum() % 2)
    return 2 * inside > len(middles)
