"""Contour lines of a surface or terrain model, as a GeoPackage."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import numpy as np

from surfkit.apps.maps.geopackage import write_layer
from surfkit.apps.maps.geotiff import TILES_SUFFIX, GeoTiffSettings
from surfkit.apps.maps.hillshade import read_heights
from surfkit.apps.maps.joined_lines import Line, joined, length_of
from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.core.files import replacing
from surfkit.core.optional import needed

AUTO_LEVELS = 20
"""About how many levels an automatic interval gives."""
MAX_CONTOUR_LEVELS = 10_000
"""Of a map."""
LINES_TOGETHER = 10_000
"""Lines that are written at once."""


def even_interval(lowest: float, highest: float) -> float:
    """1, 2 or 5 times a power of ten, so that there are 20 levels or somewhat fewer between two heights."""
    least = max((highest - lowest) / AUTO_LEVELS, 1e-9 * max(abs(lowest), abs(highest), 1e-9))
    power = 10.0 ** math.floor(math.log10(least))
    return float(f"{next(step * power for step in (1, 2, 5, 10) if step * power >= least * (1 - 1e-9)):.1g}")


def write_contours(
    sheet: GeoTiffSettings, heights: str, name: str, interval: float, least: float, side: int
) -> tuple[int, int]:
    """Write the contour lines of heights in `sheet.out`; how many there are, and how many were too short.

    They are traced tile by tile, put together where tiles meet, and end where there is no surface.

    Args:
        sheet: Where.
        heights: File name of the surface or terrain model.
        name: File name of the GeoPackage: a layer of the same name, `contours` or `contours_terrain`, with a field
            `elevation`.
        interval: Between levels, units of the input; levels are its multiples.
        least: Shorter lines are left out, units of the input.
        side: Of a tile, cells.
    """
    for package in ("pyogrio", "shapely"):  # before anything is traced
        with needed(package, "contour lines"):
            __import__(package)
    import rasterio

    grid, path, count, short = sheet.grid, sheet.folder / name, 0, 0
    windows, tiles = list(grid.tiles(side)), sheet.folder / f"{name}{TILES_SUFFIX}"
    tiles.mkdir(exist_ok=True)
    with rasterio.open(sheet.out / heights) as model:
        for at, window in enumerate(windows):
            wide, high = (
                min(window.width + 1, grid.width - window.left),
                min(window.height + 1, grid.height - window.top),
            )
            part = Window(window.left, window.top, wide, high)
            if not (tiles / f"{at}.npz").exists():
                _keep(contour_lines(read_heights(model, part), grid, part, interval), tiles / f"{at}.npz")
            emit(Progress("contour lines", at + 1, len(windows)))
    for rest in sheet.folder.glob(f"{name}*"):
        if rest != tiles:  # of an interrupted call
            rest.unlink()
    few: list[Line] = []
    traced = joined(len(windows), lambda at: _kept(tiles / f"{at}.npz"))
    for found in traced:
        long = [line for line in found if length_of(line[1]) >= least]
        short += len(found) - len(long)
        few += long
        if len(few) >= LINES_TOGETHER:
            count += _append(few, path, sheet.crs)
            few = []
    if few or not path.exists():
        count += _append(few, path, sheet.crs)
    sheet.deliver(path)
    return count, short


def _append(lines: list[Line], path: Path, crs: Any) -> int:
    """Write lines to those of a file, and return how many they are."""
    import shapely

    shapes = np.array([shapely.LineString(line).wkb for _, line in lines], object)
    levels = np.array([level for level, _ in lines], np.float64)
    write_layer(path, path.stem.replace("-", "_"), "LineString", crs, shapes, [levels], ["elevation"])
    return len(lines)


def _keep(lines: list[Line], path: Path) -> None:
    """Keep the levels and lines of a tile."""
    levels, places = [level for level, _ in lines], [line for _, line in lines]
    with replacing(path) as file:
        ends = np.cumsum([len(line) for line in places], dtype=np.int64)
        np.savez(
            file, levels=np.array(levels, np.float64), ends=ends, places=np.concatenate([*places, np.empty((0, 2))])
        )


def _kept(path: Path) -> list[Line]:
    """What was kept."""
    with np.load(path) as found:
        lines = np.split(found["places"], found["ends"])[:-1]
        return list(zip(found["levels"].tolist(), lines, strict=True))


def contour_lines(heights: np.ndarray, grid: MapGrid, window: Window, interval: float) -> list[Line]:
    """Levels and lines, (n, 2) float64 easting and northing, of the heights at the centres of a window of cells.

    Between centres heights are linear along the sides of the squares of four of them, as in all programs.

    Args:
        heights: (H, W) float64; NaN where there is no surface.
        grid: The map.
        window: Of the map.
        interval: Between levels.

    Raises:
        BadInput: Too many levels.
    """
    from contourpy import contour_generator

    known = np.isfinite(heights)
    if min(heights.shape) < 2 or not known.any():
        return []
    first, last = math.ceil(heights[known].min() / interval), math.floor(heights[known].max() / interval)
    if last - first > MAX_CONTOUR_LEVELS:
        raise BadInput(f"--interval {interval:g}: more than {MAX_CONTOUR_LEVELS:,} levels; give a larger one")
    columns = np.arange(window.left, window.left + window.width) + 0.5
    rows = np.arange(window.top, window.top + window.height) + 0.5
    tracer = contour_generator(columns, rows, np.ma.masked_array(heights, ~known))
    found = []
    for level in range(first, last + 1):
        height = float(f"{level * interval:.12g}")  # 0.3 and not 0.30000000000000004, as labels show it
        for line in cast("list[np.ndarray]", tracer.lines(height)):  # an array a line, where nothing else is asked for
            if len(line) > 1:
                place = np.stack([grid.west + line[:, 0], grid.north - line[:, 1]], axis=1) * grid.gsd
                found.append((height, place))
    return found
