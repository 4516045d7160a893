"""The minimum cut of many tetrahedra, tile by tile: what one has decided is given to those after it.

A tile has its own points and a halo of others. A tetrahedron belongs to the first tile that has a point of it: that
tile decides whether it is full, and later ones, in whose halo it lies too, take that as it is. So the surfaces of two
tiles meet without a gap. It holds for tetrahedra that both tiles have, those whose circumscribed ball lies within both
halos; larger ones span gaps that nobody has seen into, and are decided anew.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from surfkit.raster.native import kernels

UNDECIDED = -1
LAST = np.iinfo(np.int32).max
"""The tile of the corners of the tetrahedron around all: after each other."""


@dataclass(frozen=True)
class TetraTile:
    """Some of many points.

    Attributes:
        number: In the order in which tiles are decided.
        rows: (N,) of the points that it has or that lie in its halo.
        later: (N + 4,) bool of these, whether they are points of a later tile too; not so the four around all.
        tile_of: (N + 4,) int32 the tile that has each, and `LAST` for the four.
        step: Of the grid that points are rounded to, the same in all tiles.
        title: Of the tile, for progress; empty if it is the only one.
    """

    number: int
    rows: np.ndarray
    later: np.ndarray
    tile_of: np.ndarray
    step: float
    title: str


def tiles(places: np.ndarray, most: int, halo: float) -> list[TetraTile]:
    """Boxes that together are all of space, with at most `most` points each, the halo included.

    Boxes that are hardly wider than their halo are not divided: they may have more.

    Args:
        places: (P, 3).
        most: See above.
        halo: Distance up to which points around a box are added.
    """
    found: list[tuple[np.ndarray, np.ndarray]] = []  # rows of a box, and with its halo
    todo = [(np.full(3, -np.inf), np.full(3, np.inf), np.arange(len(places)), np.arange(len(places)))]
    while todo:
        low, high, own, around = todo.pop()
        extent = np.ptp(places[own], axis=0)
        axis = int(extent.argmax())
        if len(around) <= most or extent[axis] < 2 * halo:
            found.append((own, around))
            continue
        at = float(np.median(places[own, axis]))
        if not (places[own, axis] < at).any():  # half of them in one place: nothing to halve
            found.append((own, around))
            continue
        for below in (False, True):
            lower, upper = low.copy(), high.copy()
            (upper if below else lower)[axis] = at
            inner = own[(places[own, axis] < at) == below]
            near = places[around, axis] < at + halo if below else places[around, axis] >= at - halo
            todo.append((lower, upper, inner, around[near]))
    tile_of, last = np.empty((2, len(places)), np.int32)
    for number, (own, around) in enumerate(found):
        tile_of[own], last[around] = number, number
    step = max(kernels().least_step(np.ascontiguousarray(places[around], np.float64)) for _, around in found)

    def tile(number: int, rows: np.ndarray) -> TetraTile:
        title = f", tile {number + 1} of {len(found)}" if len(found) > 1 else ""
        later = np.append(last[rows] > number, [False] * 4)
        return TetraTile(number, rows, later, np.append(tile_of[rows], np.full(4, LAST, np.int32)), step, title)

    return [tile(number, around) for number, (_, around) in enumerate(found)]


@dataclass
class DecidedTetrahedra:
    """Which tetrahedra tiles have decided to be full, for those whose halo they lie in."""

    names: np.ndarray = field(default_factory=lambda: np.empty(0, np.uint64))
    full: np.ndarray = field(default_factory=lambda: np.empty(0, bool))

    def of(self, tile: TetraTile, corners: np.ndarray) -> np.ndarray:
        """(T,) int8: 1 for full, 0 for empty, `UNDECIDED` if no tile before has decided on a tetrahedron.

        Args:
            tile: That has the tetrahedra.
            corners: (T, 4) rows of the tile's points.
        """
        found = np.full(len(corners), UNDECIDED, np.int8)
        if not len(self.names):
            return found
        of = tile.tile_of[corners]
        earlier = np.flatnonzero((of.min(1) < tile.number) & (of < LAST).all(1))
        asked = names_of(tile.rows, corners[earlier])
        at = np.minimum(np.searchsorted(self.names, asked), len(self.names) - 1)
        there = self.names[at] == asked
        found[earlier[there]] = self.full[at[there]]
        return found

    def add(self, tile: TetraTile, corners: np.ndarray, full: np.ndarray) -> None:
        """Keep what a tile has decided on the tetrahedra that it shares with later ones.

        Args:
            tile: See `of`.
            corners: (T, 4), see `of`.
            full: (T,) bool.
        """
        own = tile.tile_of[corners].min(1) == tile.number
        shared = np.flatnonzero(own & tile.later[corners].all(1))
        names = np.concatenate([self.names, names_of(tile.rows, corners[shared])])
        self.names, first = np.unique(names, return_index=True)
        self.full = np.concatenate([self.full, full[shared]])[first]


def names_of(rows: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(T,) uint64 for (T, 4) corners, which two sets of four points share by chance only."""
    ids = rows[corners].astype(np.uint64)
    ids = (ids ^ ids >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(0x9E3779B97F4A7C15)
    ids = (ids ^ ids >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    return (ids ^ ids >> np.uint64(31)).sum(1, dtype=np.uint64)
