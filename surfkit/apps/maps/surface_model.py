"""The digital surface model, the highest surface above each cell, and the colours of its vertices."""

from __future__ import annotations

from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.maps.bins import Bins, corners_of, sort_faces
from surfkit.apps.maps.geotiff import GeoTiffSettings
from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.rasters import NODATA, Raster
from surfkit.apps.maps.zbuffer import NO_TRIANGLE, ZBuffer, barycentric
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.evaluate.geometry.surface_file import SurfaceFile

BATCH_CELLS = 1 << 20
"""Cells whose colour is computed at once."""
UNSEEN_GREY = 128
"""Of what no photograph shows, if the mesh has no colours."""
COLOR_CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class SurfaceModelStats:
    """What was drawn.

    Attributes:
        covered: Cells with a surface.
        lowest: Height, units of the input.
        highest: The same.
    """

    covered: int
    lowest: float
    highest: float


def has_colors(surface: SurfaceFile) -> bool:
    """Whether the vertices of a mesh have colours."""
    return set(COLOR_CHANNELS) <= set(surface.rows.dtype.names or ())


def draw_surface(
    surface: SurfaceFile,
    sheet: GeoTiffSettings,
    side: int,
    heights: str,
    colors: AbstractContextManager[Raster] | None = None,
) -> SurfaceModelStats:
    """Write the surface model of a mesh, and the colours of its vertices.

    Args:
        surface: The mesh, in the frame of the input.
        sheet: Where.
        side: Cells of a tile, along each side, on which memory depends.
        heights: File name of the surface model.
        colors: For the colours; None for none.

    Raises:
        BadInput: No cell has a surface.
    """
    bins = sort_faces(surface, sheet.grid, side, sheet.folder / f"faces-{Path(heights).stem}")
    windows, found = list(sheet.grid.tiles(side)), []
    with ExitStack() as files:
        model = files.enter_context(sheet.raster(heights, "heights"))
        photo = None if colors is None else files.enter_context(colors)
        for tile, window in enumerate(windows):
            facts = model.facts(window)
            if facts is None and (buffer := drawn_tile(bins, tile, window)).covered.any():
                facts = facts_of(buffer)
                if photo is not None:
                    photo.write(colors_of(buffer, bins), window)
                model.write(np.where(buffer.covered, buffer.height, NODATA), window, facts)  # last: the tile is done
            found += [] if facts is None else [facts]
            emit(Progress(f"drawing {Path(heights).stem}", tile + 1, len(windows)))
        if not found:
            raise BadInput(
                f"{surface.path}: none of its triangles covers the centre of a cell of {sheet.grid.gsd:g}; give a "
                "smaller --gsd, or other --bounds or another --area"
            )
    return SurfaceModelStats(
        sum(facts["covered"] for facts in found),
        min(facts["lowest"] for facts in found),
        max(facts["highest"] for facts in found),
    )


def drawn_tile(bins: Bins, tile: int, window: Window) -> ZBuffer:
    """The highest triangles on a tile of the map, in the cells that are drawn."""
    buffer = ZBuffer(window)
    for numbers in bins.of(tile):
        buffer.draw(corners_of(bins.surface, bins.grid, numbers), numbers)
    if bins.grid.area is not None and buffer.covered.any():
        buffer.leave(bins.grid.drawn(window))
    return buffer


def facts_of(buffer: ZBuffer) -> dict[str, Any]:
    """What is counted of a tile with a surface."""
    found = buffer.height[buffer.covered]
    return {"covered": len(found), "lowest": float(found.min()), "highest": float(found.max())}


def colors_of(buffer: ZBuffer, bins: Bins) -> np.ndarray:
    """(4, H, W) uint8 colours of the highest triangles at the centres of cells, between those of their corners (grey if
    they have none), and 255; 0 0 0 0 where there is no triangle."""
    window, faces = buffer.window, buffer.face.reshape(-1)
    image, colored = np.zeros((4, faces.size), np.uint8), has_colors(bins.surface)
    seen = np.flatnonzero(faces != NO_TRIANGLE)
    for at in range(0, len(seen), BATCH_CELLS):
        cells = seen[at : at + BATCH_CELLS]
        used, owner = np.unique(faces[cells], return_inverse=True)
        row, column = np.divmod(cells, window.width)
        places = column + window.left + 0.5, row + window.top + 0.5
        inside, second, third = barycentric(corners_of(bins.surface, bins.grid, used), owner, *places)
        rows = bins.surface.rows[np.asarray(bins.surface.triangles[used]).ravel()]
        for channel, name in enumerate(COLOR_CHANNELS):
            values = rows[name] if colored else np.full(len(rows), UNSEEN_GREY)
            a, b, c = values.reshape(-1, 3).T.astype(np.float64)
            found = a[owner] + second * (b - a)[owner] + third * (c - a)[owner]
            image[channel, cells[inside]] = np.rint(found).astype(np.uint8)
        image[3, cells] = 255
    return image.reshape(4, *buffer.face.shape)


def needs_double(surface: SurfaceFile, grid: MapGrid) -> bool:
    """Whether heights of a mesh, in 32 bits, would be coarser than a hundredth of a cell."""
    highest = max((float(np.abs(grid.to_map(block)[:, 2]).max(initial=0)) for block in surface.blocks()), default=0.0)
    return float(np.spacing(np.float32(highest))) > grid.gsd / 100
