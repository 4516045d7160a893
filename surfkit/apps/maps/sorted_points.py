"""More points than memory holds, sorted along a Z-order curve: sorted runs on disk, then merged."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from surfkit.core.events import Progress, emit
from surfkit.scene.morton import morton_codes

KEY_BITS = 21
"""Bits of each axis in a Z-order key."""
POINT = np.dtype([("place", "<i4", 3), ("color", "u1", 3), ("kind", "u1")])
"""A point on disk: steps of the coordinates of a LAS file, colour, class."""
RUN_POINTS = 1 << 21
"""Points that are sorted at once."""
MERGED_POINTS = 1 << 20
"""Points that are merged at once, about."""
KEYED_POINTS = 1 << 15
"""Points whose keys are made at once: what the caches of a processor hold."""
KEPT_KEYS = 1 << 10
"""Points of a run, one of whose keys is kept in memory."""


class SortedPoints:
    """Points that are added in any order and come back sorted; equal keys keep the order in which they were added.

    Args:
        file: Where they are kept; 16 bytes for each point.
        low: (3,) int64, the lowest corner of a cube around them, in their steps.
        side: Of the cube.
    """

    def __init__(self, file: Path, low: np.ndarray, side: int) -> None:
        self._file, self._low, self._side = file, low, side
        self._waiting: list[np.ndarray] = []
        self._starts = [0]
        self._samples: list[np.ndarray] = []
        file.write_bytes(b"")

    def add(self, points: np.ndarray) -> None:
        """(n,) POINT."""
        self._waiting.append(points)
        if sum(map(len, self._waiting)) >= RUN_POINTS:
            self._sort()

    def _sort(self) -> None:
        points = np.concatenate(self._waiting) if self._waiting else np.zeros(0, POINT)
        self._waiting = []
        if not len(points):
            return
        keys = self._keys(points)
        order = np.argsort(keys, kind="stable")
        with self._file.open("ab") as file:
            file.write(points[order].tobytes())
        self._samples.append(keys[order[::KEPT_KEYS]])
        self._starts.append(self._starts[-1] + len(points))

    def _keys(self, points: np.ndarray) -> np.ndarray:
        """(n,) uint64 of (n,) POINT."""
        keys = np.empty(len(points), np.uint64)
        for start in range(0, len(points), KEYED_POINTS):
            some = slice(start, start + KEYED_POINTS)
            cells = (points["place"][some].astype(np.int64) - self._low << KEY_BITS) // self._side
            keys[some] = morton_codes(cells.astype(np.uint64))
        return keys

    def batches(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Pairs of (n,) uint64 keys and (n,) POINT, rising from pair to pair too."""
        self._sort()
        total = self._starts[-1]
        if not total:
            return
        pivots = np.sort(np.concatenate(self._samples))[:: MERGED_POINTS // KEPT_KEYS][1:]
        at, done = self._starts[:-1], 0
        for pivot in [*np.unique(pivots), None]:
            ends = self._starts[1:] if pivot is None else [self._place(run, pivot) for run in range(len(at))]
            points = np.concatenate([self._read(start, end) for start, end in zip(at, ends, strict=True)])
            at = ends
            if not len(points):
                continue
            keys = self._keys(points)
            order = np.argsort(keys, kind="stable")
            done += len(points)
            yield keys[order], points[order]
            emit(Progress("writing points", done, total))

    def _read(self, start: int, end: int) -> np.ndarray:
        """(n,) POINT on disk; not mapped, as pages of a mapped file count as memory of the process."""
        return np.fromfile(self._file, POINT, end - start, offset=start * POINT.itemsize)

    def _place(self, run: int, pivot: np.uint64) -> int:
        """Where on disk the first point of a run lies whose key is not below a pivot."""
        block = int(np.searchsorted(self._samples[run], pivot))  # the first sample that is not below it
        start = self._starts[run] + max(0, block - 1) * KEPT_KEYS
        keys = self._keys(self._read(start, min(start + KEPT_KEYS, self._starts[run + 1])))
        return start + int(np.searchsorted(keys, pivot))
