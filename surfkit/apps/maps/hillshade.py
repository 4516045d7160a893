"""The surface model in the light of a low sun."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from surfkit.apps.maps.geotiff import GeoTiffSettings
from surfkit.apps.maps.map_grid import Window
from surfkit.apps.maps.rasters import NODATA, window_of
from surfkit.core.events import Progress, emit

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

LIGHT_AZIMUTH_DEGREES, LIGHT_ALTITUDE_DEGREES = 315.0, 45.0
"""Degrees: the light comes from the north-west, as maps have it."""


def draw_hillshade(sheet: GeoTiffSettings, heights: str, name: str, side: int) -> None:
    """Write the hillshade of a surface model of `sheet.out`, in tiles of so many cells."""
    import rasterio

    windows = list(sheet.grid.tiles(side))
    with rasterio.open(sheet.out / heights) as model, sheet.raster(name, "shades") as file:
        for at, window in enumerate(windows):
            if file.facts(window) is None:
                file.write(hillshade(with_margin(model, window), sheet.grid.gsd), window, {})
            emit(Progress("shading", at + 1, len(windows)))


def hillshade(heights: np.ndarray, gsd: float) -> np.ndarray:
    """(H, W) uint8 of (H + 2, W + 2) float64 heights: 1 to 255, 0 where a height or one of its neighbours is NaN.

    Slopes are those of Horn (1981), weighted differences over 3 x 3 cells; light falls on them by Lambert's law.
    """
    rows, columns = heights[:-2] + 2 * heights[1:-1] + heights[2:], heights[:, :-2] + 2 * heights[:, 1:-1]
    columns = columns + heights[:, 2:]
    east = (rows[:, 2:] - rows[:, :-2]) / (8 * gsd)
    north = (columns[:-2] - columns[2:]) / (8 * gsd)
    azimuth, altitude = math.radians(LIGHT_AZIMUTH_DEGREES), math.radians(LIGHT_ALTITUDE_DEGREES)
    flat = math.cos(altitude)
    light = math.sin(altitude) - flat * (east * math.sin(azimuth) + north * math.cos(azimuth))
    share = (light / np.sqrt(1 + east**2 + north**2)).clip(0) + 0 * heights[1:-1, 1:-1]
    return np.where(np.isfinite(share), np.rint(1 + 254 * share), 0).astype(np.uint8)


def with_margin(model: DatasetReader, window: Window, margin: int = 1) -> np.ndarray:
    """(H + 2 margin, W + 2 margin) float64 heights of a window and cells around it; NaN where there is no surface."""
    left, top = max(0, window.left - margin), max(0, window.top - margin)
    right = min(model.width, window.left + window.width + margin)
    below = min(model.height, window.top + window.height + margin)
    inner = Window(left, top, right - left, below - top)
    found = np.full((window.height + 2 * margin, window.width + 2 * margin), np.nan)
    row, column = top - window.top + margin, left - window.left + margin
    found[row : row + inner.height, column : column + inner.width] = read_heights(model, inner)
    return found


def read_heights(model: DatasetReader, window: Window) -> np.ndarray:
    """(H, W) float64 heights of a window of an open surface model; NaN where there is no surface."""
    found = model.read(1, window=window_of(window)).astype(np.float64)
    found[found == NODATA] = np.nan
    return found
