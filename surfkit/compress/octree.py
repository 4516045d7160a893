"""Points in the leaves of an octree, and their order along a space-filling curve.

All that is decided here follows from the cells that points lie in, never from where they lie in them: points that were
rounded to the centres of cells get the same leaves in the same order again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from surfkit.core.check import BadInput

MAX_LEAF_POINTS = 1 << 17
"""Points of a leaf."""
LEAF_POSITION_BITS = 16
"""Of a position in its leaf, on each axis."""
MAX_TREE_LEVELS = 21
"""Of the tree at most: 3 x 21 bits number its smallest cells."""
DIGITS = {4: 22, 8: 51}
"""Cells are at least 2^-22 of the largest coordinate in float32, 2^-51 in float64: their centres can be told apart."""
MAX_COORDINATE = 2.0**200
"""Coordinates below it are taken: more than all of float32."""


@dataclass(frozen=True)
class Leaf:
    """A cube with some of the points. Where one place has more points than a leaf may, several leaves are there.

    Attributes:
        exponent: Its side is 2^exponent.
        corner: The corner with the smallest coordinates, in half sides.
        finest: Cells of a side below 2^finest are of no use, as floats round more than that.
        rows: (n,) int64 of its points, along the Morton curve through the smallest cells that the leaf can have.
    """

    exponent: int
    corner: tuple[int, int, int]
    finest: int
    rows: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def low(self) -> np.ndarray:
        """(3,) float64, the corner."""
        return np.ldexp(np.array(self.corner, np.float64), self.exponent - 1)

    @property
    def high(self) -> np.ndarray:
        """(3,) float64, the opposite corner."""
        return self.low + math.ldexp(1.0, self.exponent)

    def cell_exponent(self, wanted: int) -> int:
        """The exponent of the cells of positions, of those that can be had the nearest to the one that is wanted.

        Cells are a quarter of the side or smaller, unless floats round more than that: larger ones would move points so
        far that they come to lie in other leaves.
        """
        return max(min(max(wanted, self.exponent - MAX_TREE_LEVELS + 1), self.exponent - 2), self.finest)

    def codes(self, positions: np.ndarray, exponent: int) -> np.ndarray:
        """(n,) uint64 Morton codes of the cells of side 2^exponent that (n, 3) positions in the leaf lie in."""
        first = np.array(self.corner, np.int64) << (self.exponent - exponent)
        return interleaved(cells(positions, exponent) - (first >> 1))

    def centres(self, codes: np.ndarray, exponent: int) -> np.ndarray:
        """(n, 3) float64 centres of cells."""
        return self.low + np.ldexp(separated(codes) + 0.5, exponent)


def leaves(positions: np.ndarray, most: int = MAX_LEAF_POINTS) -> Iterator[Leaf]:
    """The leaves of an octree over (N, 3) positions, float32 or float64, each of `most` points or fewer.

    They come along a Morton curve. Memory beside the positions: about 32 bytes a point.

    Raises:
        BadInput: Coordinates that are NaN, or too large.
    """
    if not len(positions):
        return
    low, high = positions.min(0), positions.max(0)
    if not (np.abs(np.array([low, high], np.float64)) < MAX_COORDINATE).all():
        raise BadInput("positions that are NaN, Inf or beyond 2^200; such a model is of no use")
    top = _top(low, high)
    first = cells(low[None], top - 1)[0]
    largest = max(abs(int(index) + more) for index in first for more in (0, 2))
    finest = top - 1 + (largest - 1).bit_length() - DIGITS[positions.dtype.itemsize]
    depth = max(1, min(MAX_TREE_LEVELS, top - finest))
    codes = np.empty(len(positions), np.uint64)
    for start in range(0, len(positions), MAX_LEAF_POINTS):
        part = slice(start, start + MAX_LEAF_POINTS)
        codes[part] = interleaved(cells(positions[part], top - depth) - (first << (depth - 1)))
    order = np.argsort(codes, kind="stable")
    codes = codes[order]

    def below(level: int, number: int, start: int, stop: int) -> Iterator[Leaf]:
        if stop - start > most and level < depth:
            ends = np.array([(8 * number + child) << 3 * (depth - level - 1) for child in range(1, 8)], np.uint64)
            cuts = [start, *(start + np.searchsorted(codes[start:stop], ends)).tolist(), stop]
            for child in range(8):
                if cuts[child] < cuts[child + 1]:
                    yield from below(level + 1, 8 * number + child, cuts[child], cuts[child + 1])
            return
        inside = separated(np.array([number], np.uint64))[0]
        corner = first + 0 if level == 0 else 2 * (inside + (first << (level - 1)))
        leaf = Leaf(top - level, tuple(corner.tolist()), finest)
        for begin in range(start, stop, most):
            rows = order[begin : min(begin + most, stop)]
            fine = leaf.codes(positions[rows], leaf.cell_exponent(leaf.exponent - MAX_TREE_LEVELS))
            yield Leaf(leaf.exponent, leaf.corner, finest, rows[np.argsort(fine, kind="stable")])

    yield from below(0, 0, 0, len(positions))


def cells(positions: np.ndarray, exponent: int) -> np.ndarray:
    """(N, 3) int64 numbers of the cubes of side 2^exponent that positions lie in; exact."""
    return np.floor(np.ldexp(positions.astype(np.float64), -exponent)).astype(np.int64)


def _top(low: np.ndarray, high: np.ndarray) -> int:
    """The exponent of the tree's cube: two cells on each axis are the smallest that hold all points."""
    above, below = max(float(high.max()), 1e-30), max(-float(low.min()), 1e-30)
    below = math.nextafter(below, 0)  # a cell has its lower border: -1 and what is nearest above it must count alike
    least = max(math.frexp(above)[1], math.frexp(below)[1]) - DIGITS[low.dtype.itemsize] + 2
    exponent = max(least, math.frexp(float((high.astype(np.float64) - low).max()))[1] + 1)
    while exponent > least and (cells(high, exponent - 1) - cells(low, exponent - 1)).max() <= 1:
        exponent -= 1
    return exponent + 1


_BIT_SPREADING = (
    (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip
"""Shifts and masks that put two zeros between the bits of a number of 21 bits."""


def interleaved(numbers: np.ndarray) -> np.ndarray:
    """(N,) uint64 Morton codes of (N, 3) numbers of 21 bits: the bits of x, y and z in turn."""
    code = np.zeros(len(numbers), np.uint64)
    for axis in range(3):
        bits = numbers[:, axis].astype(np.uint64)
        for shift, mask in _BIT_SPREADING:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


def separated(codes: np.ndarray) -> np.ndarray:
    """(N, 3) int64 numbers of Morton codes."""
    found = []
    for axis in range(3):
        bits = (codes >> np.uint64(axis)) & np.uint64(_BIT_SPREADING[-1][1])
        for (shift, _), (_, mask) in zip(_BIT_SPREADING[::-1], [*_BIT_SPREADING[-2::-1], (0, 0x1FFFFF)], strict=True):
            bits = (bits | (bits >> np.uint64(shift))) & np.uint64(mask)
        found.append(bits.astype(np.int64))
    return np.stack(found, 1)
