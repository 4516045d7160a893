"""Where votes are asked for: within tetrahedra, and before and behind each point."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.mesh.delaunay import Tetrahedra
from surfkit.mesh.surface_points import SurfacePoints
from surfkit.raster.native import kernels

SHELL_OFFSETS_CELLS = (-0.5, 0.5, 1.0, 1.5, 2.0)
"""Places before and behind a point along its normal that are looked at, cells: tetrahedra behind a surface are large,
and would be met by chance."""
SHELL_DEPTH = 0.5
"""Cells that each of these places stands for."""
MAX_PLACES_PER_TETRAHEDRON = 16
"""Places within one tetrahedron that are looked at."""


def places_of(
    points: SurfacePoints, tets: Tetrahedra, volumes: np.ndarray, side: float, asked: np.ndarray
) -> tuple[np.ndarray, int, np.ndarray, np.ndarray, np.ndarray]:
    """Where votes are asked for.

    Args:
        points: Of the surface.
        tets: Whose corners they are.
        volumes: (T,) of the tetrahedra.
        side: Of a cell, local units.
        asked: (T,) bool, for which tetrahedra.

    Returns:
        (N,) int32 tetrahedron of each place, how many places are of the first kind, the first of these of each
        tetrahedron, (N, 3) float32 the places, and (M,) float32 how many cells those of the second kind stand for.
    """
    native, threads = kernels(), torch.get_num_threads()
    count = len(tets.corners)
    within = np.where(asked, np.clip((2 / side * np.cbrt(volumes)).astype(np.int64), 1, MAX_PLACES_PER_TETRAHEDRON), 0)
    starts = np.cumsum(within) - within
    owner = np.repeat(np.arange(count, dtype=np.int32), within)
    turn = np.arange(len(owner)) - starts[owner]
    inner = np.empty((len(owner), 3), np.float32)
    for at in range(0, len(owner), 1 << 20):
        part = slice(at, at + (1 << 20))
        corners = tets.points[tets.corners[owner[part]]]
        inner[part] = np.einsum("nk,nki->ni", PLACE_WEIGHTS[turn[part]], corners)
    of_point = np.zeros(len(points.places), np.int32)
    mine = tets.corners < len(points.places)
    of_point[tets.corners[mine]] = np.nonzero(mine)[0]
    known = np.flatnonzero((points.normals**2).sum(1) > 0.5)
    outer = np.concatenate([points.places[known] - off * side * points.normals[known] for off in SHELL_OFFSETS_CELLS])
    found = np.empty(len(outer), np.int32)
    start = np.tile(of_point[known], len(SHELL_OFFSETS_CELLS))
    native.locate(tets.points, tets.corners, tets.neighbours, outer, start, found, threads)
    found[(found >= 0) & ~asked[found]] = -1
    rows = np.argsort(found, kind="stable")[(found < 0).sum() :]  # places that are near come together
    outer, found, cells = (
        outer[rows].astype(np.float32),
        found[rows],
        np.tile(points.cells[known], len(SHELL_OFFSETS_CELLS))[rows],
    )
    return np.concatenate([owner, found]), len(owner), starts, np.concatenate([inner, outer]), cells


def _spread() -> np.ndarray:
    """(MOST_PLACES, 4) barycentric coordinates: the middle first, then even over the tetrahedron.

    The R3 sequence (Roberts 2018), sorted into gaps, as uniform coordinates of a simplex are.
    """
    root = 1.2207440846057596
    cube = (0.5 + np.arange(1, MAX_PLACES_PER_TETRAHEDRON)[:, None] * root ** -np.arange(1.0, 4.0)) % 1
    gaps = np.diff(np.sort(cube, 1), axis=1, prepend=0.0, append=1.0)
    return np.concatenate([np.full((1, 4), 0.25), gaps])


PLACE_WEIGHTS = _spread()
