"""Heights of the geoid above the ellipsoid, by which heights above sea level become heights above the ellipsoid."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.optional import needed

LARGEST_M = 120.0
"""The geoid lies 107 m below the ellipsoid to 86 m above it."""
Geoid = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(P,) metres above the ellipsoid of WGS 84, of (P,) latitudes and longitudes in degrees."""


def geoid_of(text: str, name: str = "--geoid") -> Geoid:
    """The geoid that an option names.

    Args:
        text: A height in metres, or a file with a grid of heights: any raster that GDAL reads, such as the GTX and
            GeoTIFF files that PROJ uses.
        name: Of the option, for messages.

    Raises:
        BadInput: It is neither, or rasterio is needed and not installed.
    """
    try:
        metres = float(text)
    except ValueError:
        return grid_of(Path(text), name)
    if not abs(metres) <= LARGEST_M:
        raise BadInput(
            f"{name} {text}: the geoid lies 107 m below the ellipsoid to 86 m above it; give its height in metres"
        )
    return lambda latitude, longitude: np.full(np.shape(latitude), metres)


def grid_of(path: Path, name: str) -> Geoid:
    """The geoid in a file; only what is asked for of it is in memory."""
    if not path.is_file():
        raise BadInput(f"{name} {path}: no such file, and no number; give a grid (GTX, GeoTIFF), or a height in metres")
    with needed("rasterio", f"{name} {path}"):
        import rasterio
        from rasterio.errors import RasterioError
        from rasterio.warp import transform
    try:
        with rasterio.open(path) as file:
            crs, count = file.crs, file.count
    except RasterioError as error:
        raise BadInput(
            f"{name} {path}: no raster that GDAL reads; give a grid of geoid heights (GTX, GeoTIFF)"
        ) from error
    if crs is None or count < 1:
        raise BadInput(f"{name} {path}: it does not say where it lies; give a grid with a coordinate reference system")

    def heights(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
        x, y = np.array(longitude, np.float64), np.array(latitude, np.float64)
        if not crs.is_geographic:
            x, y = (np.array(values) for values in transform("EPSG:4326", crs, x, y))
        with rasterio.open(path) as file:
            return _sampled(file, x, y, f"{name} {path}")

    return heights


def _sampled(file: Any, x: np.ndarray, y: np.ndarray, where: str) -> np.ndarray:
    """(P,) values of a raster between the centres of its cells."""
    from rasterio.windows import Window

    if file.crs.is_geographic:
        x = (x - file.bounds.left) % 360 + file.bounds.left  # files begin at -180 or at 0
    a, b, c, d, e, f = tuple(~file.transform)[:6]
    column, row = a * x + b * y + c - 0.5, d * x + e * y + f - 0.5
    if not (np.isfinite([column, row]).all() and column.min() >= -0.5 and row.min() >= -0.5
            and column.max() <= file.width - 0.5 and row.max() <= file.height - 0.5):  # fmt: skip
        raise BadInput(f"{where}: it does not reach the scene; give the grid of its country, or a height in metres")
    left, top = (int(np.floor(at.min()).clip(0)) for at in (column, row))
    wide = min(int(np.floor(column.max())) + 2, file.width) - left
    high = min(int(np.floor(row.max())) + 2, file.height) - top
    values = file.read(1, window=Window(left, top, wide, high), masked=True).astype(np.float64).filled(np.nan)
    column, row = (column - left).clip(0, wide - 1), (row - top).clip(0, high - 1)
    i, j = np.floor(row).astype(int).clip(max=max(high - 2, 0)), np.floor(column).astype(int).clip(max=max(wide - 2, 0))
    below, beside = np.minimum(i + 1, high - 1), np.minimum(j + 1, wide - 1)
    p, q = row - i, column - j
    found = (1 - p) * ((1 - q) * values[i, j] + q * values[i, beside])
    found += p * ((1 - q) * values[below, j] + q * values[below, beside])
    if not np.isfinite(found).all() or np.abs(found).max() > LARGEST_M:
        raise BadInput(f"{where}: it has no heights of a geoid at the scene; give the grid of its country, in metres")
    return found
