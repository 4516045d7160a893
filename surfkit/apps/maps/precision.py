"""The expected error of each height of the surface model, from the rays that meet there.

A photograph confirms a cell if its own stereo depth there agrees with the surface. Of these rays three things tell how
exact the height is: where they come from and how many they are (an intersection of rays, each exact to some pixels, as
in Förstner and Wrobel 2016, Photogrammetric Computer Vision, 13.2), how far they disagree, and how steep the surface
is within a pixel, as a place that is off by a share of a pixel has the height of its neighbour. The weights of the
three were fitted to a rendered city with an exact surface (`bench/precision.py`). Pixels are those of the depth maps:
stereo at half the size is half as exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from surfkit.apps.maps.geotiff import GeoTiffSettings
from surfkit.apps.maps.hillshade import with_margin
from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.rasters import NODATA
from surfkit.apps.texture.pieces import box_corners, may_show
from surfkit.core.events import Progress, emit
from surfkit.io.datasets.depth_prior import DepthPrior, Priors
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

RAY_ERROR_PX = 0.05
"""Standard deviation of a ray, pixels."""
DISAGREEMENT_SHARE = 0.10
"""Of the root mean square by which rays miss the surface in height: what is left of it in their mean."""
STEP_SHARE = 0.68
"""Of the greatest difference of heights within a pixel around, by the slope there."""
AGREEING_PX, STEEPEST = 3.0, 3.0
"""A ray agrees with the surface within so many pixels, times what the slope makes of that; slopes up to this count."""
LEAST_CONFIDENCE = 0.25
"""Of a stereo depth that counts."""
LEAST_FACING = 0.1
"""Cosine between the normal of the surface and a ray: what is seen along the surface tells nothing of its height."""
LEAST_RAYS = 2
"""With fewer, nothing is known of the error."""
BATCH_CELLS = 1 << 18
"""Cells that are looked at in a photograph at once."""
SMOOTHING_RADII = 4
"""Width of the window of a Gaussian, standard deviations."""
HISTOGRAM_STEP = 1.02
"""Ratio of the borders of classes in which values are counted, for their median."""


@dataclass(frozen=True)
class StereoDepths:
    """What the photographs of a run know of depth.

    Attributes:
        priors: Of the views of the maps, by their position.
        key: Of all that they depend on.
    """

    priors: Priors
    key: str


@dataclass(frozen=True)
class Rays:
    """What confirms the heights of some cells.

    Attributes:
        views: The photographs.
        priors: Their depths.
        frame: Of the data set.
        grid: The map.
        pixel: Side of a pixel on the surface, units of the input.
    """

    views: Sequence[View]
    priors: Priors
    frame: Frame
    grid: MapGrid
    pixel: float

    @property
    def reach(self) -> int:
        """Cells in a pixel, at least one: as far as the neighbours of a cell count."""
        return max(1, round(self.pixel / self.grid.gsd))

    @property
    def margin(self) -> int:
        """Cells around a window whose heights are needed."""
        return SMOOTHING_RADII * self.reach + 1

    def over(self, window: Window, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) standard deviation of the heights of a window, NaN where it is not known; (H, W) rays that confirm
        each.

        Args:
            window: Of the map.
            heights: (H + 2 margin, W + 2 margin) of it and of the cells around, NaN for none.
        """
        inner = slice(self.margin, -self.margin), slice(self.margin, -self.margin)
        normals, steps = self._normals(heights)[inner], _range(heights, self.reach)[inner]
        row, column = np.nonzero(np.isfinite(heights[inner]))
        east = (self.grid.west + window.left + column + 0.5) * self.grid.gsd
        north = (self.grid.north - window.top - row - 0.5) * self.grid.gsd
        places = np.stack([east, north, heights[inner][row, column]], 1) @ self.grid.turn
        local = self.frame.to_local(places)
        met = Meetings(local, normals[row, column] @ self.grid.turn, self.frame.scale)
        if len(local):
            box = box_corners(local.min(0)[None], local.max(0)[None])
            for at, view in enumerate(self.views):
                if may_show(box, view.camera)[0] and (prior := self.priors[at]) is not None:
                    met.add(view.camera, prior)
        sigma, count = np.full((window.height, window.width), np.nan), np.zeros((window.height, window.width))
        slopes = steps[row, column] / (self.reach * self.grid.gsd)
        sigma[row, column] = np.hypot(met.sigma(), STEP_SHARE * slopes * met.pixel())
        count[row, column] = met.count
        return sigma, count

    def _normals(self, heights: np.ndarray) -> np.ndarray:
        """(H, W, 3) direction in which the surface rises by 1 in height: minus its slopes to the east and north, and 1.

        Of heights smoothed by a pixel; holes do not count.
        """
        known = np.isfinite(heights)
        smooth, weight = (
            ndimage.gaussian_filter(each, self.reach, mode="constant", truncate=SMOOTHING_RADII)
            for each in (np.where(known, heights, 0.0), known.astype(np.float64))
        )
        smooth = smooth / np.maximum(weight, 1e-12)
        down, right = np.gradient(smooth, self.grid.gsd)
        return np.stack([-right, down, np.ones_like(down)], -1)


class Meetings:
    """Rays that confirm some places, added up one photograph at a time.

    Args:
        places: (n, 3) local.
        rising: (n, 3) axes of the input: a place that moves by d has a surface that is higher by its product with d.
        scale: Local units in a unit of the input.
    """

    def __init__(self, places: np.ndarray, rising: np.ndarray, scale: float) -> None:
        self.places, self.rising, self.scale = places, rising, scale
        self.steepness = np.linalg.norm(rising, axis=1)
        self.count = np.zeros(len(places))
        self.squares = np.zeros(len(places))
        """Of the differences of heights, units of the input."""
        self.pixels = np.zeros(len(places))
        """Sum of the sides of pixels on the surface, units of the input."""
        self.information = np.zeros((len(places), 6))
        """Upper triangles of the normal matrices of the intersections, pixels per local unit, squared."""

    def add(self, camera: Camera, prior: DepthPrior) -> None:
        """Count the rays of a photograph."""
        known = prior.inverse.numpy(), prior.confidence.numpy(), prior.coarseness
        pose, centre = camera.world_to_camera.numpy().astype(np.float64), camera.centre.numpy().astype(np.float64)
        for first in range(0, len(self.places), BATCH_CELLS):
            part = slice(first, first + BATCH_CELLS)
            self._add_some(part, camera, known, pose, centre)

    def _add_some(
        self,
        part: slice,
        camera: Camera,
        known: tuple[np.ndarray, np.ndarray, float],
        pose: np.ndarray,
        centre: np.ndarray,
    ) -> None:
        x, y, z = pose[:3, :3] @ self.places[part].T + pose[:3, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            rows = np.flatnonzero((z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
        at = v[rows].astype(np.int64), u[rows].astype(np.int64)
        inverse, confidence = known[0][at], known[1][at]
        sure = (confidence >= LEAST_CONFIDENCE) & (inverse > 0)
        rows, inverse = rows[sure], inverse[sure].astype(np.float64)
        away = self.places[part][rows] - centre
        rising, steepness = self.rising[part][rows], self.steepness[part][rows]
        facing = -(away * rising).sum(1) / (np.linalg.norm(away, axis=1) * steepness)
        higher = (away * rising).sum(1) * (1 / (inverse * z[rows]) - 1) / self.scale
        pixel = known[2] * z[rows] / min(camera.fx, camera.fy) / self.scale
        agreeing = np.abs(higher) <= AGREEING_PX * pixel * np.minimum(steepness, np.hypot(STEEPEST, 1))
        chosen = np.flatnonzero(agreeing & (facing >= LEAST_FACING))
        rows, higher = rows[chosen], higher[chosen]
        self.count[part][rows] += 1
        self.squares[part][rows] += higher**2
        self.pixels[part][rows] += pixel[chosen]
        across = camera.fx / known[2] / z[rows, None] * (pose[0, :3] - (x / z)[rows, None] * pose[2, :3])
        along = camera.fy / known[2] / z[rows, None] * (pose[1, :3] - (y / z)[rows, None] * pose[2, :3])
        for entry, (i, j) in enumerate(UPPER):
            self.information[part, entry][rows] += across[:, i] * across[:, j] + along[:, i] * along[:, j]

    def pixel(self) -> np.ndarray:
        """(n,) mean side of a pixel of the depth maps that confirm each place, on the surface, units of the input."""
        return self.pixels / np.maximum(self.count, 1)

    def sigma(self) -> np.ndarray:
        """(n,) standard deviations of the heights as rays tell them, units of the input; NaN for too few rays."""
        found = np.full(len(self.places), np.nan)
        rows = np.flatnonzero(self.count >= LEAST_RAYS)
        matrix = np.empty((len(rows), 3, 3))
        for entry, (i, j) in enumerate(UPPER):
            matrix[:, i, j] = matrix[:, j, i] = self.information[rows, entry]
        # Rays that are one have no intersection: their error is that of the least angle that numbers can tell.
        matrix += 1e-12 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        rising = self.rising[rows]
        solved = np.linalg.solve(matrix, rising[:, :, None])[:, :, 0]
        crossing = RAY_ERROR_PX * np.sqrt((rising * solved).sum(1)) / self.scale
        missing = DISAGREEMENT_SHARE * np.sqrt(self.squares[rows] / self.count[rows])
        found[rows] = np.hypot(crossing, missing)
        return found


UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Entries of the upper triangle of a symmetric matrix."""


def _range(heights: np.ndarray, reach: int) -> np.ndarray:
    """(H, W) greatest less least height in a square around each cell; holes do not count."""
    known, side = np.isfinite(heights), 2 * reach + 1
    with np.errstate(invalid="ignore"):
        return ndimage.maximum_filter(np.where(known, heights, -np.inf), side) - ndimage.minimum_filter(
            np.where(known, heights, np.inf), side
        )


def write_precision(sheet: GeoTiffSettings, rays: Rays, model: str, names: Sequence[str], side: int) -> dict[str, Any]:
    """Write the expected errors of a surface model and the rays that confirm it; what maps.json says of them.

    Args:
        sheet: Where.
        rays: What confirms heights.
        model: File name of the surface model, in `sheet.out`.
        names: File names of the two rasters.
        side: Of a tile, cells; results do not depend on it.
    """
    import rasterio

    windows, found = list(sheet.grid.tiles(side)), []
    with rasterio.open(sheet.out / model) as heights, ExitStack() as files:
        errors = files.enter_context(sheet.raster(names[0], "heights"))
        counts = files.enter_context(sheet.raster(names[1], "counts"))
        for at, window in enumerate(windows):
            facts = errors.facts(window)
            if facts is None:
                sigma, count, facts = precision_tile(heights, rays, window)
                counts.write(count, window)
                errors.write(np.where(np.isfinite(sigma), sigma, NODATA), window, facts)  # last: the tile is done
            found.append(facts)
            emit(Progress("finding the precision", at + 1, len(windows)))
    cells, known = (sum(facts[name] for facts in found) for name in ("cells", "known"))
    return {
        "known": round(known / max(1, cells), 6),
        "median": _share_below([facts["classes"] for facts in found], 0.5),
        "percentile_90": _share_below([facts["classes"] for facts in found], 0.9),
        "least_rays": LEAST_RAYS,
    }


def precision_tile(heights: DatasetReader, rays: Rays, window: Window) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """(H, W) standard deviations, NaN where they are not known; (H, W) rays, NODATA where there is no surface; and what
    is counted of a tile."""
    around = with_margin(heights, window, rays.margin)
    sigma, count = rays.over(window, around)
    there = np.isfinite(around[rays.margin : -rays.margin, rays.margin : -rays.margin])
    values = sigma[np.isfinite(sigma)]
    classes, sizes = np.unique(np.rint(np.log(values.clip(1e-9)) / np.log(HISTOGRAM_STEP)), return_counts=True)
    facts = {
        "cells": int(there.sum()),
        "known": len(values),
        "classes": dict(zip(map(str, classes.astype(int).tolist()), sizes.tolist(), strict=True)),
    }
    return sigma, np.where(there, count, NODATA), facts


def _share_below(tiles: Sequence[dict[str, int]], share: float) -> float | None:
    """The value below which a share of all values lies, to 1 %; None if there are none."""
    total: dict[int, int] = {}
    for classes in tiles:
        for name, size in classes.items():
            total[int(name)] = total.get(int(name), 0) + size
    rank, seen = share * sum(total.values()), 0
    for step, size in sorted(total.items()):
        seen += size
        if seen >= rank:
            return float(HISTOGRAM_STEP**step)
    return None
