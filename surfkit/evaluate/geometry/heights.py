"""Rasters of heights, such as dsm.tif of `surfkit maps` or of a laser scan, as meshes: one vertex in each cell."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.optional import needed

RASTERS = (".tif", ".tiff", ".vrt", ".asc")
MAX_CELLS = 16_000_000
"""Of a raster: a larger one is read coarser. A cell takes 50 bytes."""
UNIT_METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), 0.3048),
    **dict.fromkeys(("us-ft", "us ft", "ft us", "ftus", "us survey foot", "us survey feet", "foot_us"), 1200 / 3937),
}
"""Metres per unit of heights that a raster names."""
PICTURE_BANDS = 3
"""A raster of so many bands or more is a picture."""


def raster_system(path: Path) -> str | None:
    """The coordinate reference system of a raster, such as EPSG:32632; None where it has none."""
    with _opened(path) as file:
        return file.crs.to_string() if file.crs else None


def raster_unit(path: Path) -> float | None:
    """Metres per unit of the heights of a raster, if it names a unit that is known here."""
    with _opened(path) as file:
        return UNIT_METRES.get((file.units[0] or "").strip().lower())


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The open raster, of rasterio; BadInput where it is none."""
    with needed("rasterio", str(path)):
        import rasterio
    try:
        with rasterio.open(path) as file:
            yield file
    except rasterio.errors.RasterioError as error:
        raise BadInput(f"{path}: cannot be read as a raster: {' '.join(str(error).split())}") from error


def read_heights_raster(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) float64 places of cells with a height, and (F, 3) int32 triangles between them.

    x and y are those of the middle of a cell, as the raster is placed; z is its height. Steps between cells become
    steep triangles.

    Raises:
        BadInput: rasterio is not installed, no raster, a picture, without a place, or without heights.
    """
    with _opened(path) as file:
        if file.count >= PICTURE_BANDS:
            raise BadInput(f"{path}: a picture of {file.count} bands; name a raster of heights, which has one")
        every = max(1, int(np.ceil(np.sqrt(file.width * file.height / MAX_CELLS))))
        shape = (-(-file.height // every), -(-file.width // every))
        heights = file.read(1, out_shape=shape, masked=True).astype(np.float64).filled(np.nan)
        heights = heights * file.scales[0] + file.offsets[0]
        transform, (wide, high) = file.transform, (file.width / shape[1], file.height / shape[0])
    if transform.is_identity:
        raise BadInput(f"{path}: it does not say where it lies; write it as a GeoTIFF with its place")
    if every > 1:
        emit(Warned(f"{path}: {file.width} x {file.height} cells, read as {shape[1]} x {shape[0]}"))
    rows, columns = np.indices(shape)
    x, y = (columns + 0.5) * wide, (rows + 0.5) * high  # in cells of the file
    a, b, c, d, e, f = transform[:6]  # affine 2 multiplies by *, affine 3 by @
    x, y = a * x + b * y + c, d * x + e * y + f
    return mesh_of_cells(path, np.stack([x, y, heights], axis=2), is_mirrored=transform.determinant < 0)


def mesh_of_cells(path: Path, places: np.ndarray, is_mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) vertices and (F, 3) triangles of (H, W, 3) places of cells; those whose z is not finite are left out.

    Args:
        path: What a message names.
        places: x, y and z by row and column.
        is_mirrored: Whether rows go downwards on the map, as in most rasters: triangles face up in either case.
    """
    there = np.isfinite(places[..., 2])
    number = np.cumsum(there.ravel()).reshape(there.shape) - 1
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    ta, tb, tc, td = there[:-1, :-1], there[:-1, 1:], there[1:, :-1], there[1:, 1:]
    corners = [np.stack([a, c, b], -1)[ta & tc & tb], np.stack([b, c, d], -1)[tb & tc & td]]
    faces = np.concatenate(corners).astype(np.int32)
    if not len(faces):
        raise BadInput(f"{path}: no three cells beside one another have heights, so there is no surface in it")
    return places[there], faces if is_mirrored else faces[:, ::-1]
