"""In how many photographs each place of the ground is seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from surfkit.apps.quality.survey import Survey
from surfkit.core.optional import needed
from surfkit.scene.scene import View

MAX_CELLS = 250
"""Cells along the longer side of the overlap map."""
SPARSE_CELLS = 120
"""The same where heights are those of the sparse points only; fewer where cells would have too few of these."""
CELL_POINTS = 4
"""Sparse points of a cell, on average, at least."""
REACH_CELLS = 2.5
"""How far from a sparse point a cell may lie to have its height."""
SPARSE_PERCENTILES = (1, 99)
"""Of the sparse points, beyond which they are not on the map: some lie far away."""


@dataclass(frozen=True)
class Ground:
    """Heights of a grid, north up.

    Attributes:
        heights: (H, W) float64; NaN where there is none.
        bounds: West, south, east, north.
        source: What they are of.
    """

    heights: np.ndarray
    bounds: tuple[float, float, float, float]
    source: str

    def places(self) -> np.ndarray:
        """(H, W, 3) east, north and up of the middles of the cells."""
        rows, columns = self.heights.shape
        west, south, east, north = self.bounds
        x = west + (np.arange(columns) + 0.5) * (east - west) / columns
        y = north - (np.arange(rows) + 0.5) * (north - south) / rows
        return np.dstack([*np.meshgrid(x, y), self.heights])


def photographs_seeing(views: Sequence[View], local: np.ndarray) -> np.ndarray:
    """(N,) how many photographs have each of (N, 3) local positions within their frame and before them. What stands
    between is not looked at."""
    points = torch.from_numpy(np.ascontiguousarray(local, np.float64))
    counts = torch.zeros(len(points), dtype=torch.int64)
    for view in views:
        camera = view.camera
        x, y, depth = camera.project(points).unbind(1)
        counts += (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return counts.numpy()


def overlap(survey: Survey, ground: Ground) -> np.ndarray:
    """(H, W) float64 photographs that see each cell; NaN where it has no height."""
    places = ground.places().reshape(-1, 3)
    known = np.isfinite(places[:, 2])
    counts = np.full(len(places), np.nan)
    counts[known] = photographs_seeing(survey.views, survey.to_local(places[known]))
    return counts.reshape(ground.heights.shape)


def ground_of(survey: Survey) -> Ground | None:
    """Heights of the surface model, else of the sparse points; None where there are neither."""
    model = survey.map_file("dsm.tif")
    if model is not None:
        heights, bounds = read_raster(model, MAX_CELLS)
        return Ground(heights[0], bounds, "the surface model")
    return ground_of_points(survey.sparse_points) if len(survey.sparse_points) else None


def ground_of_points(placed: np.ndarray) -> Ground:
    """Median heights of (P, 3) sparse points in cells, and in cells next to these that of the nearest."""
    low, high = np.percentile(placed[:, :2], SPARSE_PERCENTILES, axis=0)
    sides = np.maximum(high - low, 1e-9)
    size = max(float(sides.max()) / SPARSE_CELLS, float(np.sqrt(CELL_POINTS * sides.prod() / len(placed))))
    columns, rows = (max(1, int(np.ceil(side / size))) for side in sides)
    at = np.floor((placed[:, :2] - low) / size).astype(int)
    inside = ((at >= 0) & (at < (columns, rows))).all(1)
    cell = (rows - 1 - at[inside, 1]) * columns + at[inside, 0]
    heights = np.full(rows * columns, np.nan)
    order = np.lexsort((placed[inside, 2], cell))
    numbers, first, counts = np.unique(cell[order], return_index=True, return_counts=True)
    heights[numbers] = placed[inside, 2][order][first + counts // 2]
    grid = heights.reshape(rows, columns)
    distance, nearest = distance_transform_edt(np.isnan(grid), return_indices=True)
    filled = np.where(distance <= REACH_CELLS, grid[tuple(nearest)], np.nan)
    west, south = low
    return Ground(filled, (west, south, west + columns * size, south + rows * size), "the sparse points")


def read_raster(path: Path, longest: int) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """(B, H, W) float64 bands of a GeoTIFF, reduced to a longest side by the nearest cells, NaN where there is no
    value; and its west, south, east and north."""
    with needed("rasterio", f"reading {path.name}"):
        import rasterio
    with rasterio.open(path) as file:
        by = max(1.0, max(file.width, file.height) / longest)
        shape = (file.count, max(1, round(file.height / by)), max(1, round(file.width / by)))
        bands = file.read(out_shape=shape, masked=True)
        box = file.bounds
    return np.ma.filled(bands.astype(np.float64), np.nan), (box.left, box.bottom, box.right, box.top)
