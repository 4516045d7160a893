"""The digital terrain model of a surface model, heights above ground, and classes of points.

What is ground is found on coarse cells of about 1 m, of the whole map at once, so nothing depends on tiles. The cells
of the map are then done in tiles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from surfkit.apps.maps.cloud import sample_evenly
from surfkit.apps.maps.geotiff import GeoTiffSettings
from surfkit.apps.maps.ground_filter import (
    GROUND,
    LEAST_OBJECT_METRES,
    UNCLASSIFIED,
    between_cells,
    classes,
    fill_smoothly,
    ground_cells,
    roughness,
    slope_of,
)
from surfkit.apps.maps.hillshade import read_heights, with_margin
from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.rasters import NODATA
from surfkit.apps.maps.surface_model import has_colors
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.files import replacing
from surfkit.evaluate.geometry.surface_file import SurfaceFile

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

COARSE_CELL_METRES, MAX_COARSE_CELLS = 1.0, 10_000_000
"""Least side of the cells that the ground is looked for on, and how many of them a map has at most; larger maps have
larger ones."""
BLOCK_CELLS = 2048
"""About the side of the blocks that a surface model is read in."""
SLOPE_TOLERANCE = 1.25
"""Metres by which a cell may be farther from the ground, for each unit of slope (Pingel et al.)."""
LEAST_SHARE = 0.25
"""Share of the cells within a coarse one that are ground, from which it is ground that is seen."""
MAX_BELOW_SHARE = 0.005
"""Share of the surface below the terrain, from which one is told."""
FADE, FADE_RADII, FADE_WEIGHT = 1.0, 3.0, 0.05
"""Width of the strip in coarse cells, its radius in widths, and weight of the terrain, with which heights go over from
ground that is seen to ground that is not."""


@dataclass(frozen=True)
class TerrainSettings:
    """How the ground is found, for `--products terrain`."""

    building_width: float = 80.0
    """Width of the widest building or wood that is removed, metres. The terrain has no data farther than this from
    ground that is seen."""

    slope: float = 0.15
    """Height by distance up to which the ground rises: more on steep land, less for wide and low buildings."""

    height: float = 0.5
    """Height above ground up to which a surface is ground, metres."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not 0 < value < float("inf"):
                raise BadInput(f"--terrain.{name.replace('_', '-')} {value:g}: it must be above 0")


@dataclass(frozen=True)
class Ground:
    """What is known of the ground on coarse cells, (H, W) each, from the upper left corner of the map.

    Attributes:
        factor: Cells of the map along the side of a coarse one.
        terrain: float64 heights of the ground, units of the input.
        tolerance: float64 distance from it up to which a surface is ground, units.
        distance: float64 distance to the nearest ground that is seen, units.
        within: bool: where the mesh is, its holes filled.
        kinds: uint8 classes of the LAS specification of what stands on the ground.
        reach: Distance up to which the ground is told, units.
        metre: Length of a metre in units.
    """

    factor: int
    terrain: np.ndarray
    tolerance: np.ndarray
    distance: np.ndarray
    within: np.ndarray
    kinds: np.ndarray
    reach: float
    metre: float

    def over(self, values: np.ndarray, window: Window) -> np.ndarray:
        """(H, W) coarse values at the centres of cells of the map; the window may lie partly beyond it."""
        return between_cells(values, self.factor, *_numbers(window))

    def is_within(self, window: Window) -> np.ndarray:
        """(H, W) bool of cells of the map."""
        rows, columns = _numbers(window)
        return self.within[np.ix_(rows // self.factor, columns // self.factor)]

    def classes_of(self, places: np.ndarray, grid: MapGrid) -> np.ndarray:
        """(n,) uint8 classes of the LAS specification: 2 ground, 5 vegetation, 6 building, 1 for all else.

        Args:
            places: (n, 3) easting, northing and height, within the map.
            grid: The map.
        """
        column = (places[:, 0] / grid.gsd - grid.west) / self.factor
        row = (grid.north - places[:, 1] / grid.gsd) / self.factor
        terrain, tolerance, distance = (
            ndimage.map_coordinates(each, [row - 0.5, column - 0.5], order=1, mode="nearest")
            for each in (self.terrain, self.tolerance, self.distance)
        )
        above = places[:, 2] - terrain
        high, wide = self.kinds.shape
        kinds = self.kinds[row.astype(np.int64).clip(0, high - 1), column.astype(np.int64).clip(0, wide - 1)]
        found = np.where(above >= LEAST_OBJECT_METRES * self.metre, kinds, UNCLASSIFIED)
        return np.where(distance > self.reach, UNCLASSIFIED, np.where(np.abs(above) <= tolerance, GROUND, found))


def find_ground(
    surface: SurfaceFile, sheet: GeoTiffSettings, model: str, settings: TerrainSettings, metre: float
) -> Ground:
    """Find the ground of a surface model; what an interrupted call found is not looked for again.

    Args:
        surface: The mesh, whose colours tell what is green.
        sheet: Where.
        model: File name of the surface model, in `sheet.out`.
        settings: How.
        metre: Length of a metre in units of the input.

    Raises:
        BadInput: There is no ground.
    """
    kept = sheet.folder / "ground.npz"
    if not kept.exists():
        found = _found(surface, sheet, model, settings, metre)
        with replacing(kept) as file:
            np.savez(file, **asdict(found))
    with np.load(kept) as parts:
        arrays = {name: parts[name] for name in ("terrain", "tolerance", "distance", "within", "kinds")}
        reach, length = float(parts["reach"]), float(parts["metre"])
        return Ground(factor=int(parts["factor"]), reach=reach, metre=length, **arrays)


def coarse_factor(grid: MapGrid, metre: float) -> int:
    """Cells of a map along the side of a coarse cell."""
    factor = max(1, round(COARSE_CELL_METRES * metre / grid.gsd))
    while -(-grid.width // factor) * -(-grid.height // factor) > MAX_COARSE_CELLS:
        factor += 1
    return factor


def _found(surface: SurfaceFile, sheet: GeoTiffSettings, model: str, settings: TerrainSettings, metre: float) -> Ground:
    """The ground, looked for anew."""
    import rasterio

    grid = sheet.grid
    factor = coarse_factor(grid, metre)
    cell, shape = grid.gsd * factor, (-(-grid.height // factor), -(-grid.width // factor))
    lowest, top, seen = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    with rasterio.open(sheet.out / model) as file:
        for rows, columns, blocks, _ in _blocks(file, grid, factor, "looking for the ground"):
            with np.errstate(invalid="ignore"):
                lowest[rows, columns] = np.where(np.isfinite(blocks), blocks, np.inf).min((1, 3))
            top[rows, columns] = _means(blocks, np.isfinite(blocks), 1)
        known = np.isfinite(lowest)
        lowest[~known] = np.nan
        base = ground_cells(lowest, cell, settings.building_width * metre, settings.slope)
        terrain = fill_smoothly(lowest, base)
        least = max(1, int(LEAST_SHARE * factor**2))
        tolerance = _tolerance(terrain, cell, settings, metre)
        for rows, columns, blocks, window in _blocks(file, grid, factor, "measuring the ground"):
            expected, allowed = (
                between_cells(each, factor, *_numbers(window)).reshape(blocks.shape) for each in (terrain, tolerance)
            )
            with np.errstate(invalid="ignore"):
                seen[rows, columns] = _means(blocks, np.abs(blocks - expected) <= allowed, least)
    told = np.isfinite(seen)
    if not told.any():
        raise BadInput(
            "--products terrain: no ground was found; the mesh has too few surfaces, or --terrain.height is too small"
        )
    # A mesh smooths the feet of walls and fills gaps between houses: ground is taken from where there is ground around.
    core = ndimage.binary_erosion(told, np.ones((3, 3)), border_value=True)
    terrain = fill_smoothly(seen, core if core.any() else told)
    tolerance = _tolerance(terrain, cell, settings, metre)
    with np.errstate(invalid="ignore"):
        told = np.abs(seen - terrain) <= tolerance
    distance = ndimage.distance_transform_edt(~told) * cell
    green = _green(surface, grid, terrain, factor, metre) if has_colors(surface) else None
    kinds = classes(top - terrain, roughness(top, known), green, metre)
    reach = settings.building_width * metre
    return Ground(factor, terrain, tolerance, distance, ndimage.binary_fill_holes(known), kinds, reach, metre)


def _tolerance(terrain: np.ndarray, cell: float, settings: TerrainSettings, metre: float) -> np.ndarray:
    """(H, W) distance from the ground up to which a surface is ground: more where that is steep."""
    slope = slope_of(terrain, cell).clip(max=settings.slope)
    return (settings.height + SLOPE_TOLERANCE * slope) * metre


def _blocks(
    model: DatasetReader, grid: MapGrid, factor: int, told: str
) -> Iterator[tuple[slice, slice, np.ndarray, Window]]:
    """Rows and columns of coarse cells, (h, factor, w, factor) heights of the cells within them, NaN where there is no
    surface or no map, and the window of these cells, which may lie partly beyond the map."""
    side = factor * max(1, BLOCK_CELLS // factor)
    windows = list(grid.tiles(side))
    for at, window in enumerate(windows):
        high, wide = -(-window.height // factor), -(-window.width // factor)
        heights = np.full((high * factor, wide * factor), np.nan)
        heights[: window.height, : window.width] = read_heights(model, window)
        top, left = window.top // factor, window.left // factor
        whole = Window(window.left, window.top, wide * factor, high * factor)
        blocks = heights.reshape(high, factor, wide, factor)
        yield slice(top, top + high), slice(left, left + wide), blocks, whole
        emit(Progress(told, at + 1, len(windows)))


def _numbers(window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a window."""
    return window.top + np.arange(window.height), window.left + np.arange(window.width)


def _means(blocks: np.ndarray, chosen: np.ndarray, least: int) -> np.ndarray:
    """(h, w) means of the chosen cells of (h, n, w, n) blocks; NaN with fewer than `least` of them."""
    count = chosen.sum((1, 3))
    mean = np.where(chosen, blocks, 0.0).sum((1, 3)) / count.clip(1)
    return np.where(count >= least, mean, np.nan)


def _green(surface: SurfaceFile, grid: MapGrid, terrain: np.ndarray, factor: int, metre: float) -> np.ndarray:
    """(H, W) mean excess green index of the surfaces that stand on coarse cells; NaN where there are none."""
    high, wide = terrain.shape
    total, count = np.zeros(high * wide), np.zeros(high * wide)
    for places, colors in sample_evenly(surface, (grid.gsd * factor) ** 2 / 4):
        cells = grid.to_cells(places)
        row, column = (np.floor(cells[:, at] / factor).astype(np.int64) for at in (1, 0))
        inside = (row >= 0) & (row < high) & (column >= 0) & (column < wide)
        number = row[inside] * wide + column[inside]
        stands = cells[inside, 2] - terrain.reshape(-1)[number] >= LEAST_OBJECT_METRES * metre
        red, green, blue = np.asarray(colors, np.float64)[inside][stands].T
        index = (2 * green - red - blue) / (red + green + blue).clip(1)
        total += np.bincount(number[stands], index, high * wide)
        count += np.bincount(number[stands], minlength=high * wide)
    return np.where(count > 0, total / count.clip(1), np.nan).reshape(high, wide)


def write_terrain(
    sheet: GeoTiffSettings, ground: Ground, model: str, names: Sequence[str], side: int
) -> dict[str, Any]:
    """Write the terrain model, the heights above ground and the distances to ground that is seen, and return what
    maps.json says of them.

    The terrain has the heights of the surface model where that is ground, and a smooth interpolation elsewhere, with no
    data farther than `ground.reach` from ground that is seen and outside of the mesh.

    Args:
        sheet: Where.
        ground: What is known of it.
        model: File name of the surface model, in `sheet.out`.
        names: File names of the terrain model, the heights above ground and the distances.
        side: Of a tile, cells; results do not depend on it.
    """
    import rasterio

    windows, found = list(sheet.grid.tiles(side)), []
    with rasterio.open(sheet.out / model) as heights, ExitStack() as files:
        rasters = [files.enter_context(sheet.raster(name, "heights")) for name in names]
        for at, window in enumerate(windows):
            facts = rasters[0].facts(window)
            if facts is None:
                layers, facts = terrain_tile(heights, ground, window)
                drawn = sheet.grid.drawn(window)
                for raster, layer in reversed(list(zip(rasters, layers, strict=True))):  # the first last: it is done
                    raster.write(np.where(drawn & np.isfinite(layer), layer, NODATA), window, facts)
            found.append(facts)
            emit(Progress("drawing the terrain", at + 1, len(windows)))
    total = {name: sum(facts[name] for facts in found) for name in found[0]}
    shares = {name: round(total[name] / max(1, total["cells"]), 6) for name in ("seen", "untold", "below")}
    if shares["below"] > MAX_BELOW_SHARE:
        emit(
            Warned(
                f"{shares['below']:.1%} of the surface lies below the terrain, where the mesh has pits or noise, as "
                f"under trees: {names[1]} is negative there; do not measure heights there"
            )
        )
    return {
        "ground_seen": shares["seen"],
        "without_terrain": shares["untold"],
        "below_terrain": shares["below"],
        "coarse_cell": sheet.grid.gsd * ground.factor,
        "reach": ground.reach,
    }


def terrain_tile(
    heights: DatasetReader, ground: Ground, window: Window
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], dict[str, Any]]:
    """Terrain, heights above it, and distances to ground that is seen, (H, W) float64 each with NaN for no data, and
    how many cells of a tile have a surface, are ground, have no terrain, and lie below it."""
    width = FADE * ground.factor
    margin = int(FADE_RADII * width + 0.5)
    surface = with_margin(heights, window, margin)
    around = Window(window.left - margin, window.top - margin, window.width + 2 * margin, window.height + 2 * margin)
    terrain = ground.over(ground.terrain, around)
    with np.errstate(invalid="ignore"):
        tolerance = ground.over(ground.tolerance, around)
        seen = np.abs(surface - terrain) <= tolerance
    # By weights, so that there is no step where ground that is seen ends; a Gaussian is the same in all tiles.
    rest, weight = (
        ndimage.gaussian_filter(each, width, mode="constant", truncate=FADE_RADII)
        for each in (np.where(seen, surface - terrain, 0.0), seen.astype(np.float64))
    )
    terrain = np.where(seen, surface, terrain + rest / (weight + FADE_WEIGHT))
    inner = slice(margin, margin + window.height), slice(margin, margin + window.width)
    surface, terrain, seen, tolerance = surface[inner], terrain[inner], seen[inner], tolerance[inner]
    distance = np.where(seen, 0.0, ground.over(ground.distance, window))
    there = (np.isfinite(surface) | ground.is_within(window)) & (distance <= ground.reach)
    terrain, distance = np.where(there, terrain, np.nan), np.where(there, distance, np.nan)
    counted = np.isfinite(surface)
    with np.errstate(invalid="ignore"):
        below = there & (surface < terrain - tolerance)
    facts = {"cells": counted, "seen": seen & there, "untold": counted & ~there, "below": below}
    return (terrain, surface - terrain, distance), {name: int(cells.sum()) for name, cells in facts.items()}
