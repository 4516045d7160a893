"""What changed between two surfaces: heights, volumes of cut and fill, and a picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.maps.geotiff import GeoTiffSettings
from surfkit.apps.maps.hillshade import read_heights
from surfkit.apps.maps.rasters import NODATA
from surfkit.core.check import BadInput
from surfkit.core.events import FileWritten, Progress, emit
from surfkit.core.files import replacing

MAP_LONGEST_PX = 1400
"""Longest side of the map in the picture."""
HISTOGRAM_BINS = 1 << 20
"""Of the histogram that percentiles are read from."""
COLOR_PERCENTILE = 95
"""Percentile of the absolute differences at the ends of the colours."""
PICTURE_INCHES, PICTURE_DPI = (11.0, 9.0), 130


@dataclass(frozen=True)
class Difference:
    """Heights of a surface minus those of another, where both are.

    Attributes:
        cells: Compared.
        area: Of these cells, square units of the input.
        fill: Volume by which the surface lies above the other, cubic units.
        cut: Volume by which it lies below.
        median: Of the differences, units.
        median_absolute: Of their absolute values.
        percentile_90: Of their absolute values.
        only_here: Cells where there is no other surface.
        only_other: Cells where there is only the other.
        least_difference: Least detectable difference, units: cells that differ by less count in neither volume.
        unchanged: Area of these cells.
    """

    cells: int
    area: float
    fill: float
    cut: float
    median: float
    median_absolute: float
    percentile_90: float
    only_here: int
    only_other: int
    least_difference: float = 0.0
    unchanged: float = 0.0


def write_difference(
    sheet: GeoTiffSettings, heights: tuple[Path, Path], name: str, side: int, least: float = 0.0
) -> Difference:
    """Write the difference of two surface models on the grid of the sheet, in tiles of so many cells.

    Volumes are sums over cells, each as high as its centre; cells that differ by less than `least`, the least
    detectable difference, are left out of them. Percentiles are of all cells, within a millionth of the range.

    Raises:
        BadInput: No cell has both.
    """
    import rasterio

    windows, found = list(sheet.grid.tiles(side)), []
    with rasterio.open(heights[0]) as here, rasterio.open(heights[1]) as other:
        with sheet.raster(name, "heights") as file:
            for at, window in enumerate(windows):
                facts = file.facts(window)
                if facts is None:
                    ours, theirs = read_heights(here, window), read_heights(other, window)
                    facts = _counted(ours, theirs, least)
                    if facts["cells"]:
                        differences = ours - theirs
                        file.write(np.where(np.isfinite(differences), differences, NODATA), window, facts)
                found.append(facts)
                emit(Progress("comparing heights", at + 1, len(windows)))
            total = {name: sum(facts[name] for facts in found) for name in found[0]}
            if not total["cells"]:
                raise BadInput(f"no cell of {sheet.grid.gsd:g} has both surfaces: they do not lie in the same place")
    cell, counts = sheet.grid.gsd**2, (total["only_here"], total["only_other"])
    volumes = total["cells"] * cell, total["fill"] * cell, total["cut"] * cell
    percentiles = _percentiles(sheet, name, side)
    return Difference(total["cells"], *volumes, *percentiles, *counts, least, total["unchanged"] * cell)


def _counted(ours: np.ndarray, theirs: np.ndarray, least: float) -> dict[str, Any]:
    """Of a tile: cells with both surfaces, sums of the heights above and below, and cells with one surface only."""
    differences = ours - theirs
    both = np.isfinite(differences)
    changed = both & (np.abs(differences) >= least)
    return {
        "cells": int(both.sum()),
        "fill": float(differences[changed].clip(min=0).sum()),
        "cut": -float(differences[changed].clip(max=0).sum()),
        "unchanged": int((both & ~changed).sum()),
        "only_here": int((np.isfinite(ours) & ~both).sum()),
        "only_other": int((np.isfinite(theirs) & ~both).sum()),
    }


def _percentiles(sheet: GeoTiffSettings, name: str, side: int) -> tuple[float, float, float]:
    """Median, median of the absolute values, and 90th percentile of these, from histograms."""
    import rasterio

    with rasterio.open(sheet.out / name) as file:

        def differences() -> Iterator[np.ndarray]:
            for window in sheet.grid.tiles(side):
                values = read_heights(file, window)
                yield values[np.isfinite(values)]

        most = max(float(np.abs(values).max(initial=0)) for values in differences())
        if not most:
            return 0.0, 0.0, 0.0
        signed, absolute = np.zeros(HISTOGRAM_BINS, np.int64), np.zeros(HISTOGRAM_BINS, np.int64)
        for values in differences():
            signed += np.histogram(values, HISTOGRAM_BINS, (-most, most))[0]
            absolute += np.histogram(np.abs(values), HISTOGRAM_BINS, (0, most))[0]
    middles = (np.arange(HISTOGRAM_BINS) + 0.5) / HISTOGRAM_BINS * most

    def at(counts: np.ndarray, share: float) -> float:
        """As numpy's percentile: between two values where it falls there, so the median of an even number is a mean."""
        rank = share * (counts.sum() - 1)
        lower, upper = middles[np.searchsorted(np.cumsum(counts), [np.floor(rank), np.ceil(rank)], side="right")]
        return float(lower + (rank - np.floor(rank)) * (upper - lower))

    return 2 * at(signed, 0.5) - most, at(absolute, 0.5), at(absolute, 0.9)


def draw_difference(path: Path, raster: Path, found: Difference, unit: str) -> None:
    """Save a picture of the differences as PNG, red above and blue below, with a legend and the volumes.

    Args:
        path: Where.
        raster: The GeoTIFF of the differences.
        found: What they come to.
        unit: Of lengths, such as "m".
    """
    import matplotlib
    import rasterio
    from matplotlib.figure import Figure
    from rasterio.enums import Resampling

    with rasterio.open(raster) as file:
        by = max(1.0, max(file.width, file.height) / MAP_LONGEST_PX)
        shape = max(1, round(file.height / by)), max(1, round(file.width / by))
        shown = file.read(1, out_shape=shape, masked=True, resampling=Resampling.average)
        west, south, east, north = file.bounds
    reach = max(float(np.percentile(np.abs(shown.compressed()), COLOR_PERCENTILE)), 1e-9)
    rows, columns = (np.flatnonzero(~np.ma.getmaskarray(shown).all(axis)) for axis in (1, 0))
    wide, high = (east - west) / shape[1], (north - south) / shape[0]
    style: dict[Any, Any] = {name: value for name, value in matplotlib.rcParamsDefault.items() if name != "backend"}
    with matplotlib.rc_context(style):
        figure = Figure(PICTURE_INCHES, PICTURE_DPI, layout="constrained")
        axes = figure.add_subplot(xlabel=f"easting, {unit}", ylabel=f"northing, {unit}")
        axes.set_facecolor("0.85")
        drawn = axes.imshow(shown, "RdBu_r", vmin=-reach, vmax=reach, extent=(west, east, south, north))
        axes.set_xlim(west + columns[0] * wide, west + (columns[-1] + 1) * wide)
        axes.set_ylim(north - (rows[-1] + 1) * high, north - rows[0] * high)
        axes.ticklabel_format(useOffset=False, style="plain")
        bar = figure.colorbar(drawn, ax=axes, extend="both", shrink=0.8)
        bar.set_label(f"height here minus height there, {unit}; grey: no surface in one of them")
        axes.set_title(
            f"above (fill) {found.fill:,.4g} {unit}³, below (cut) {found.cut:,.4g} {unit}³, "
            f"on {found.area:,.4g} {unit}²\n"
            f"median {found.median:.3g} {unit}; absolute: median {found.median_absolute:.3g}, "
            f"90 % under {found.percentile_90:.3g} {unit}",
            fontsize=10,
        )
        with replacing(path) as file:
            figure.savefig(file, format="png", metadata={"Software": None})
    emit(FileWritten(path, "picture"))
