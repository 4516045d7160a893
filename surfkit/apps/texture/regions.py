"""A mesh in regions of about as many texels each, one for each tile."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from surfkit.mesh.base import Mesh


@dataclass(frozen=True)
class Region:
    """A part of space, or two of them on both sides of a plane.

    Attributes:
        number: Of a region that is not divided, counted from 0.
        axis: That the plane is perpendicular to.
        value: Where it lies on that axis.
        below: Where the coordinate is less, and where it is not; none for a region that is not divided.
    """

    number: int = 0
    axis: int = 0
    value: float = 0.0
    below: tuple[Region, ...] = ()

    def leaves(self) -> Iterator[Region]:
        """The regions that are not divided, in the order of their numbers."""
        if not self.below:
            yield self
        for part in self.below:
            yield from part.leaves()

    @property
    def depth(self) -> int:
        """How often it is divided, at most."""
        return max((1 + part.depth for part in self.below), default=0)

    def at(self, depth: int) -> list[Region]:
        """What it consists of when it is divided `depth` times at most."""
        if not depth or not self.below:
            return [self]
        return [part for half in self.below for part in half.at(depth - 1)]

    def cut(self, depth: int) -> Region:
        """The same, divided `depth` times at most; numbers are places in `at(depth)`."""
        count = 0

        def shorter(region: Region, left: int) -> Region:
            nonlocal count
            if left and region.below:
                return replace(region, below=tuple(shorter(half, left - 1) for half in region.below))
            count += 1
            return Region(count - 1)

        return shorter(self, depth)

    def of(self, places: np.ndarray) -> np.ndarray:
        """(P,) int32 number of the region that each of (P, 3) places lies in."""
        found = np.zeros(len(places), np.int32)

        def sort(region: Region, rows: np.ndarray) -> None:
            if not region.below:
                found[rows] = region.number
                return
            less = places[rows, region.axis] < region.value
            sort(region.below[0], rows[less])
            sort(region.below[1], rows[~less])

        sort(self, np.arange(len(places)))
        return found


def middles(mesh: Mesh) -> np.ndarray:
    """(F, 3) float64 centres of the triangles."""
    return mesh.vertices[mesh.faces].mean(1, dtype=np.float64)


def divide(places: np.ndarray, weight: np.ndarray, most: float) -> Region:
    """Halve by weight, along the longest extent, until no region weighs more than `most`.

    Args:
        places: (P, 3).
        weight: (P,).
        most: Above 0.
    """
    count = 0

    def divided(rows: np.ndarray) -> Region:
        nonlocal count
        if weight[rows].sum() > most and len(rows) > 1:
            axis = int(np.ptp(places[rows], axis=0).argmax())
            order = rows[np.argsort(places[rows, axis], kind="stable")]
            sums = np.cumsum(weight[order])
            half = int(np.clip(np.searchsorted(sums, sums[-1] / 2), 1, len(order) - 1))
            value = float(places[order[half], axis])
            less = places[rows, axis] < value
            if less.any():
                return Region(0, axis, value, (divided(rows[less]), divided(rows[~less])))
        count += 1
        return Region(count - 1)

    return divided(np.arange(len(places)))
