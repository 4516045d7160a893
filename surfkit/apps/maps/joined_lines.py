"""Pieces of lines that were cut where tiles meet, put together again with only their ends in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from surfkit.core.events import Progress, emit

PHASE = "joining contour lines"
Line = tuple[float, np.ndarray]
"""A level, and the places of a line, (n, 2) float64."""
TILES_IN_MEMORY = 16
"""Tiles whose pieces are at hand while lines are put together."""


@dataclass
class PieceEnds:
    """Where the open pieces of tiles begin and end; all that is in memory of pieces.

    Attributes:
        pieces: Tile and number in it of each.
        follows: Piece that begins where another ends, by that one's number.
        starts: Pieces by level and the place where they begin, as bytes, until they follow one.
        ends: Level and place where each ends, as bytes.
    """

    pieces: list[tuple[int, int]] = field(default_factory=list)
    follows: dict[int, int] = field(default_factory=dict)
    starts: dict[bytes, list[int]] = field(default_factory=dict)
    ends: list[bytes] = field(default_factory=list)

    def add(self, tile: int, lines: Sequence[Line]) -> None:
        """Note the open lines of a tile; where one ends, its neighbour's goes on, so lines must have a direction."""
        for number, (level, line) in enumerate(lines):
            if not is_closed(line):
                start, end = (np.array([level, *line[at]]).tobytes() for at in (0, -1))
                self.starts.setdefault(start, []).append(len(self.pieces))
                self.ends.append(end)
                self.pieces.append((tile, number))

    def chains(self) -> Iterator[list[tuple[int, int]]]:
        """Pieces that make a line, in their order; those that follow no other come first, then rings."""
        for piece, end in enumerate(self.ends):
            if self.starts.get(end):
                self.follows[piece] = self.starts[end].pop(0)
        first = sorted(set(range(len(self.pieces))) - set(self.follows.values()))
        left = set(range(len(self.pieces)))
        for piece in [*first, *range(len(self.pieces))]:
            found, at = [], piece
            while at in left:
                left.remove(at)
                found.append(self.pieces[at])
                at = self.follows.get(at, at)
            if found:
                yield found


def joined(tiles: int, read: Callable[[int], list[Line]]) -> Iterator[list[Line]]:
    """The lines of all tiles, some at a time, without ends where tiles meet.

    Pieces are of one line where one ends at the very place, and on the level, where the other begins.

    Args:
        tiles: How many there are.
        read: Gives the pieces of one; it is asked several times.
    """
    ends = PieceEnds()
    for tile in range(tiles):
        lines = read(tile)
        ends.add(tile, lines)
        yield [line for line in lines if is_closed(line[1])]
        emit(Progress(PHASE, tile + 1, 2 * tiles))
    kept, done, said = lru_cache(TILES_IN_MEMORY)(read), 0, tiles
    for chain in ends.chains():
        parts = [kept(tile)[number] for tile, number in chain]
        level, places = parts[0][0], [line for _, line in parts]
        yield [(level, np.concatenate([places[0], *(line[1:] for line in places[1:])]))]
        done += len(chain)
        if (now := tiles + tiles * done // len(ends.pieces)) > said:
            emit(Progress(PHASE, said := now, 2 * tiles))
    if said < 2 * tiles:
        emit(Progress(PHASE, 2 * tiles, 2 * tiles))


def is_closed(line: np.ndarray) -> bool:
    """Whether a line (n, 2) ends where it begins."""
    return bool((line[0] == line[-1]).all())


def length_of(line: np.ndarray) -> float:
    """Length of a line (n, 2)."""
    return float(np.hypot(*np.diff(line, axis=0).T).sum())
