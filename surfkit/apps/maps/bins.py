"""Which triangles lie on which tile of a map, however many there are: sorted on disk."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.zbuffer import boxes
from surfkit.core.events import Progress, emit
from surfkit.evaluate.geometry.surface_file import SurfaceFile

BATCH_TRIANGLES = 1 << 19
"""Triangles in memory at a time."""


@dataclass(frozen=True)
class Bins:
    """The triangles of each tile.

    Attributes:
        surface: The mesh.
        grid: The map.
        numbers: Numbers of triangles, sorted by tile, then rising; on disk.
        starts: (tiles + 1,) where the triangles of each tile begin in `numbers`.
    """

    surface: SurfaceFile
    grid: MapGrid
    numbers: np.ndarray
    starts: np.ndarray

    def of(self, tile: int) -> list[np.ndarray]:
        """Numbers of the triangles that may lie on a tile, in pieces that fit into memory."""
        first, last = int(self.starts[tile]), int(self.starts[tile + 1])
        return [self.numbers[at : min(at + BATCH_TRIANGLES, last)] for at in range(first, last, BATCH_TRIANGLES)]


def corners_of(surface: SurfaceFile, grid: MapGrid, numbers: np.ndarray | slice) -> np.ndarray:
    """(n, 3, 3) float64 column, row and height of the corners of some triangles."""
    return grid.to_cells(surface.vertices(np.asarray(surface.triangles[numbers]).ravel())).reshape(-1, 3, 3)


def sort_faces(surface: SurfaceFile, grid: MapGrid, side: int, file: Path) -> Bins:
    """Sort the triangles of a mesh by the tiles that they may have cells on, in two passes: count, then place.

    Args:
        surface: The mesh.
        grid: The map.
        side: Of a tile, cells.
        file: Where their numbers are kept while the map is drawn.
    """
    across, down = -(-grid.width // side), -(-grid.height // side)
    counts, total = np.zeros(across * down, np.int64), len(surface.triangles)
    for at in range(0, total, BATCH_TRIANGLES):
        tiles, _ = _pairs(surface, grid, side, slice(at, at + BATCH_TRIANGLES))
        counts += np.bincount(tiles, minlength=len(counts))
        emit(Progress("counting triangles", min(at + BATCH_TRIANGLES, total), total))
    starts = np.concatenate([[0], np.cumsum(counts)])
    kind = np.int32 if total <= np.iinfo(np.int32).max else np.int64
    size = max(1, int(starts[-1]))
    with file.open("wb") as room:  # or an OSError now, and not a bus error when a mapped page finds the disk full
        os.posix_fallocate(room.fileno(), 0, size * np.dtype(kind).itemsize)
    numbers, free = np.memmap(file, kind, "r+", shape=(size,)), starts[:-1].copy()
    for at in range(0, total, BATCH_TRIANGLES):
        tiles, faces = _pairs(surface, grid, side, slice(at, at + BATCH_TRIANGLES))
        order = np.argsort(tiles, kind="stable")
        tiles, faces = tiles[order], faces[order]
        used, first, count = np.unique(tiles, return_index=True, return_counts=True)
        numbers[np.repeat(free[used] - first, count) + np.arange(len(tiles))] = faces
        free[used] += count
        emit(Progress("sorting triangles", min(at + BATCH_TRIANGLES, total), total))
    return Bins(surface, grid, numbers, starts)


def _pairs(surface: SurfaceFile, grid: MapGrid, side: int, part: slice) -> tuple[np.ndarray, np.ndarray]:
    """Tile and triangle of each pair of both that may meet, the triangles rising."""
    low, high = boxes(corners_of(surface, grid, part), Window(0, 0, grid.width, grid.height))
    there = np.flatnonzero((high > low).all(1))
    low, high = low[there] // side, (high[there] - 1) // side + 1
    count, wide = (high - low).prod(1), high[:, 0] - low[:, 0]
    owner = np.repeat(np.arange(len(there)), count)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    row = within // wide[owner]
    column = within - row * wide[owner]
    across = -(-grid.width // side)
    return (row + low[owner, 1]) * across + column + low[owner, 0], there[owner] + part.start
