"""The base that a volume is measured from: a height, or what the heights along the outline of a polygon tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from surfkit.apps.maps.hillshade import read_heights
from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.rasters import TILE_SIDE_CELLS
from surfkit.core.check import BadInput
from surfkit.io.polygon_file import AreaPolygon

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

BaseKind = Literal["triangulated", "lowest", "plane"]
MAX_OUTLINE_SAMPLES = 200_000
"""Heights along an outline; a longer one has wider steps than a cell."""
LEAST_SAMPLES = {"lowest": 1, "plane": 3, "triangulated": 3}
"""Heights that a base needs."""
LEAST_SPREAD = 1e-6
"""Of the narrow to the wide direction of samples, below which they lie in one line."""


@dataclass(frozen=True)
class OutlineHeights:
    """Heights of the surface along the outlines of a polygon.

    Attributes:
        places: (S, 2) float64 easting and northing; all with a surface.
        heights: (S,) float64, units of the map.
        lengths: (S,) float64 length of the outline that each stands for.
        share: Of the length of the outline, that with a surface.
    """

    places: np.ndarray
    heights: np.ndarray
    lengths: np.ndarray
    share: float


@dataclass(frozen=True)
class Base:
    """What a volume is measured from.

    Attributes:
        height: (n,) float64 heights at (n, 2) eastings and northings.
        lowest: Least height of the base along the outline, units of the map.
        highest: Greatest.
        residual: Root mean square by which heights along the outline lie off a fitted plane; None for other bases.
    """

    height: Callable[[np.ndarray], np.ndarray]
    lowest: float
    highest: float
    residual: float | None = None


def outline_heights(model: DatasetReader, grid: MapGrid, polygon: AreaPolygon) -> OutlineHeights:
    """Heights of a surface model at all corners of the outlines of a polygon, and between, a cell apart or less.

    Holes do not count: they may lie on a heap. Heights are interpolated between the centres of four cells; where one of
    these has no surface, the height is that of the cell.

    Args:
        model: The surface model, open.
        grid: Its cells.
        polygon: The polygon.
    """
    outlines = polygon.outlines
    whole = sum(float(np.linalg.norm(np.diff(ring, axis=0), axis=1).sum()) for ring in outlines)
    step = max(grid.gsd, whole / MAX_OUTLINE_SAMPLES)
    places, lengths = (np.concatenate(each) for each in zip(*(_along(ring, step) for ring in outlines), strict=True))
    heights = heights_at(model, grid, places)
    known = np.isfinite(heights)
    return OutlineHeights(places[known], heights[known], lengths[known], float(lengths[known].sum() / lengths.sum()))


def _along(ring: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a ring and places between, at most a step apart: (n, 2); and (n,) half of the way from the place
    before to the next one."""
    way = np.diff(ring, axis=0)
    length = np.linalg.norm(way, axis=1)
    count = np.ceil(length / step).clip(min=1).astype(np.int64)
    edge = np.repeat(np.arange(len(way)), count)
    within = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    piece = (length / count)[edge]
    return ring[edge] + (within / count[edge])[:, None] * way[edge], (piece + np.roll(piece, 1)) / 2


def heights_at(model: DatasetReader, grid: MapGrid, places: np.ndarray) -> np.ndarray:
    """(n,) float64 heights of a surface model at (n, 2) eastings and northings; NaN where there is no surface.

    Blocks of the file are read one at a time, so memory does not depend on the size of the map.
    """
    cells = np.stack([places[:, 0] / grid.gsd - grid.west, grid.north - places[:, 1] / grid.gsd], axis=1)
    own = np.floor(cells).astype(np.int64)
    found = np.full(len(places), np.nan)
    inside = np.flatnonzero(((own >= 0) & (own < [grid.width, grid.height])).all(1))
    block = own[inside] // TILE_SIDE_CELLS
    for left, top in np.unique(block, axis=0):
        some = inside[(block == [left, top]).all(1)]
        first = np.maximum(np.array([left, top]) * TILE_SIDE_CELLS - 1, 0)
        last = np.minimum((np.array([left, top]) + 1) * TILE_SIDE_CELLS + 1, [grid.width, grid.height])
        heights = read_heights(model, Window(*map(int, first), *map(int, last - first)))
        corner = np.floor(cells[some] - 0.5).astype(np.int64)
        right, down = (cells[some] - 0.5 - corner).T
        column, row = (corner - first).T
        column_1, row_1 = column + 1, row + 1
        beyond = (column < 0) | (row < 0) | (column_1 >= heights.shape[1]) | (row_1 >= heights.shape[0])
        column, column_1 = (each.clip(0, heights.shape[1] - 1) for each in (column, column_1))
        row, row_1 = (each.clip(0, heights.shape[0] - 1) for each in (row, row_1))
        upper = heights[row, column] * (1 - right) + heights[row, column_1] * right
        lower = heights[row_1, column] * (1 - right) + heights[row_1, column_1] * right
        between = upper * (1 - down) + lower * down
        column, row = (own[some] - first).T
        found[some] = np.where(beyond | ~np.isfinite(between), heights[row, column], between)
    return found


def base_of(where: str, kind: BaseKind | float, outline: OutlineHeights) -> Base:
    """The base of a polygon.

    Args:
        where: What messages call the polygon.
        kind: How it follows from the outline; or its height, in units of the map.
        outline: Heights along the outline.

    Raises:
        BadInput: The outline has too few heights, or they lie in one line.
    """
    if not isinstance(kind, str):
        return _level(float(kind))
    if len(outline.heights) < LEAST_SAMPLES[kind]:
        raise BadInput(
            f"{where}: --base {kind} needs heights along its outline, and {len(outline.heights)} places of it have a "
            "surface; give --base HEIGHT, or draw the outline where there is a surface"
        )
    if kind == "lowest":
        return _level(float(outline.heights.min()))
    middle = outline.places.mean(0)
    places = outline.places - middle  # small numbers, where eastings and northings are large
    spread = np.linalg.svd(places, compute_uv=False)
    if spread[1] <= LEAST_SPREAD * spread[0]:
        raise BadInput(f"{where}: --base {kind}: all places of its outline with a surface lie in one line; give "
                       "--base lowest, or --base HEIGHT")  # fmt: skip
    if kind == "plane":
        return _plane(places, middle, outline)
    return _triangulated(places, middle, outline)


def _level(height: float) -> Base:
    """A horizontal plane."""
    return Base(lambda places: np.full(len(places), height), height, height)


def _plane(places: np.ndarray, middle: np.ndarray, outline: OutlineHeights) -> Base:
    """The plane of least squares, every metre of the outline of the same weight."""
    weight = np.sqrt(outline.lengths / outline.lengths.sum())
    terms = np.column_stack([np.ones(len(places)), places])
    terms_of = np.linalg.lstsq(terms * weight[:, None], outline.heights * weight, rcond=None)[0]
    found = terms @ terms_of
    residual = float(np.sqrt(((outline.heights - found) * weight) @ ((outline.heights - found) * weight)))
    return Base(lambda at: terms_of[0] + (at - middle) @ terms_of[1:], float(found.min()), float(found.max()), residual)


def _triangulated(places: np.ndarray, middle: np.ndarray, outline: OutlineHeights) -> Base:
    """The surface over the Delaunay triangles of the places along the outline.

    They are a cell apart, so the triangles follow the outline also where it bends inwards. Beyond all triangles (a
    centre of a cell that lies inside in part) the nearest height counts.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import cKDTree

    surface, nearest = LinearNDInterpolator(places, outline.heights), cKDTree(places)

    def height(at: np.ndarray) -> np.ndarray:
        found = surface(at - middle)
        beyond = ~np.isfinite(found)
        found[beyond] = outline.heights[nearest.query(at[beyond] - middle)[1]]
        return found

    return Base(height, float(outline.heights.min()), float(outline.heights.max()))
