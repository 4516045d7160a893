"""Volumes of a surface above and below a base, and between two dates, for each polygon of a file."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.apps.maps.cell_shares import OutlinePieces, outline_pieces
from surfkit.apps.maps.geopackage import write_layer
from surfkit.apps.maps.geotiff import GDAL_CACHE_MB, GeoTiffSettings
from surfkit.apps.maps.hillshade import read_heights
from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.map_settings import VOLUME_OPTION
from surfkit.apps.maps.volume_base import BaseKind, base_of, outline_heights
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.optional import needed
from surfkit.io.area import AREA_OPTION, Area
from surfkit.io.polygon_file import AreaPolygon

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

BLOCK_ROWS, BLOCK_COLUMNS = 512, 2048
"""Cells that are in memory at once. They do not depend on --tile, so volumes do not either, to the last bit."""
TOLD_MISSING = 0.01
"""Share of a polygon without surface from which on a message tells of it."""
MAX_CUT_OFF_SHARE = 1e-6
"""Share of a polygon outside the area of the map that is rounding."""


@dataclass(frozen=True)
class Volume:
    """What a polygon holds. Lengths are in units of the map, areas and volumes in their squares and cubes.

    Attributes:
        name: Of the polygon.
        area: Of the polygon, in plan.
        without_surface: Share of the area where there is no surface; it counts neither as fill nor as cut.
        base: How the base was found: triangulated, lowest, plane, height.
        base_lowest: Least height of the base along the outline.
        base_highest: Greatest.
        outline_with_surface: Share of the outline with heights, which the base follows.
        fill: Volume of the surface above the base.
        cut: Volume of the base above the surface.
        net: Fill minus cut.
        mean_height: Of the surface above the base, where there is a surface: net divided by its area.
        highest: Greatest height of the surface above the base.
        base_residual: Root mean square by which the outline lies off a fitted plane; None for other bases.
        base_error: That times the area with a surface: volume by which net would change, were the base off by so much
            everywhere. None for other bases, whose error is not known.
        surface_error: Volume by which net would change, were each height off by its expected error in the same
            direction: an upper bound. None without `--products precision`.
        without_precision: Share of the area with a surface whose errors are not known, and not in `surface_error`.
        compared: Area where both dates have a surface; None, as the rest, without a second date.
        changed: Area of it where heights differ by the least detectable difference or more.
        fill_since: Volume by which the surface lies above that of the other date, on the changed area.
        cut_since: Volume by which it lies below.
        net_since: The former minus the latter.
    """

    name: str
    area: float
    without_surface: float
    base: str
    base_lowest: float
    base_highest: float
    outline_with_surface: float
    fill: float
    cut: float
    net: float
    mean_height: float
    highest: float
    base_residual: float | None = None
    base_error: float | None = None
    surface_error: float | None = None
    without_precision: float | None = None
    compared: float | None = None
    changed: float | None = None
    fill_since: float | None = None
    cut_since: float | None = None
    net_since: float | None = None


@dataclass(frozen=True)
class VolumeSettings:
    """How volumes are measured.

    Attributes:
        base: How the base follows from the outline, or its height, units of the map.
        least_difference: Of two dates, units of the map: cells that differ by less are unchanged.
    """

    base: BaseKind | float
    least_difference: float = 0.0


def tell_cut_off(polygons: Sequence[AreaPolygon], area: Area, unit: str) -> None:
    """Refuse polygons of volumes that lie outside the area of the map, and say of which a part does.

    Raises:
        BadInput: One of them has no part within.
    """
    for each in polygons:
        within, whole = each.shape.intersection(area.shape).area, each.shape.area
        if not within > 0:
            raise BadInput(
                f"{VOLUME_OPTION}: polygon {each.name!r} lies outside the polygons of {AREA_OPTION}, where nothing is "
                f"drawn; leave {AREA_OPTION} out, or draw its polygons around it"
            )
        if whole - within > MAX_CUT_OFF_SHARE * whole:
            share = 100 * (whole - within) / whole
            emit(
                Warned(
                    f"polygon {each.name!r}: {share:.1f}% of it, {whole - within:,.4g} {unit}², lies outside the "
                    f"polygons of {AREA_OPTION} and is not measured, and its base has no heights there"
                )
            )


def measure_volumes(
    sheet: GeoTiffSettings,
    heights: Path,
    other: Path | None,
    precision: Path | None,
    polygons: Sequence[AreaPolygon],
    settings: VolumeSettings,
) -> list[Volume]:
    """The volumes of polygons on a surface model.

    A cell counts by its share inside the polygon, which is exact, times the height of the surface at its centre above
    the base there. Changes between two dates follow Wheaton et al. 2010 (Earth Surface Processes and Landforms 35,
    136-156, doi:10.1002/esp.1886): with a uniform least detectable difference, a cell below it counts as unchanged, and
    one above it with its whole difference.

    Args:
        sheet: The map.
        heights: The surface model.
        other: That of the other date, on the same cells; None for none.
        precision: Expected errors of the heights, on the same cells; None where they are not known.
        polygons: What to measure.
        settings: How.

    Raises:
        BadInput: A polygon has no surface, or its outline too few heights for the base.
    """
    import rasterio

    found = []
    with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_MB), ExitStack() as files:
        model, theirs, errors = (
            None if path is None else files.enter_context(rasterio.open(path)) for path in (heights, other, precision)
        )
        for at, polygon in enumerate(polygons):
            found.append(_measured(HeightRasters(model, theirs, errors), sheet.grid, polygon, settings))
            emit(Progress("measuring volumes", at + 1, len(polygons)))
    return found


@dataclass(frozen=True)
class HeightRasters:
    """Open rasters on the cells of a map.

    Attributes:
        model: The surface model.
        other: That of the other date; None for none.
        errors: Expected errors of the heights; None where they are not known.
    """

    model: DatasetReader
    other: DatasetReader | None
    errors: DatasetReader | None


def _measured(rasters: HeightRasters, grid: MapGrid, polygon: AreaPolygon, settings: VolumeSettings) -> Volume:
    """The volumes of one polygon."""
    model, other = rasters.model, rasters.other
    where, kind = f"polygon {polygon.name!r}", settings.base
    outline = outline_heights(model, grid, polygon)
    base = base_of(where, kind, outline)
    pieces = outline_pieces(polygon.rings, grid)
    total, uncertain = np.zeros(7), np.zeros(2)
    highest = -np.inf
    for window in _blocks(pieces, grid):
        shares = pieces.shares(window)
        inside = np.flatnonzero(shares)
        ours, share = read_heights(model, window).ravel()[inside], shares.ravel()[inside]
        known = np.isfinite(ours)
        above = ours[known] - base.height(_centres(grid, window, inside[known]))
        weight = share[known]
        total[:3] += weight.sum(), weight @ above.clip(min=0), -weight @ above.clip(max=0)
        highest = max(highest, float(above.max(initial=-np.inf)))
        if rasters.errors is not None:
            sigma = read_heights(rasters.errors, window).ravel()[inside][known]
            told = np.isfinite(sigma)
            uncertain += weight[told].sum(), weight[told] @ sigma[told]
        if other is not None:
            change = ours - read_heights(other, window).ravel()[inside]
            both = np.isfinite(change)
            total[3] += share[both].sum()
            told = both & (np.abs(change) >= settings.least_difference)
            change, share = change[told], share[told]
            total[4:] += share.sum(), share @ change.clip(min=0), -share @ change.clip(max=0)
    covered, fill, cut, compared, changed, fill_since, cut_since = map(float, total * grid.gsd**2)
    if not covered:
        raise BadInput(f"{where}: the map has no surface in it; move it, or delete it from the file")
    sure, error = map(float, uncertain * grid.gsd**2)
    missing = max(0.0, 1 - covered / polygon.shape.area)
    if missing >= TOLD_MISSING:
        emit(Warned(f"{where}: {missing:.1%} of it has no surface, and counts neither as fill nor as cut"))
    return Volume(
        polygon.name, polygon.shape.area, round(missing, 9), kind if isinstance(kind, str) else "height", base.lowest,
        base.highest, round(outline.share, 9), fill, cut, fill - cut, (fill - cut) / covered, highest, base.residual,
        None if base.residual is None else base.residual * covered,
        *((None, None) if rasters.errors is None else (error, round(max(0.0, 1 - sure / covered), 9))),
        *((None,) * 5 if other is None else (compared, changed, fill_since, cut_since, fill_since - cut_since)),
    )  # fmt: skip


def _blocks(pieces: OutlinePieces, grid: MapGrid) -> Iterator[Window]:
    """Rectangles of cells that a polygon may cover."""
    if not len(pieces.row):
        return
    left, right = int(pieces.column.min()), min(int(pieces.column.max()) + 1, grid.width)
    for top in range(int(pieces.row[0]), int(pieces.row[-1]) + 1, BLOCK_ROWS):
        high = min(BLOCK_ROWS, int(pieces.row[-1]) + 1 - top)
        for column in range(left, right, BLOCK_COLUMNS):
            yield Window(column, top, min(BLOCK_COLUMNS, right - column), high)


def _centres(grid: MapGrid, window: Window, cells: np.ndarray) -> np.ndarray:
    """(n, 2) easting and northing of the centres of cells, which are numbered within a window."""
    row, column = np.divmod(cells, window.width)
    return np.stack([grid.west + window.left + column + 0.5, grid.north - window.top - row - 0.5], axis=1) * grid.gsd


def write_volumes(
    sheet: GeoTiffSettings,
    polygons: Sequence[AreaPolygon],
    volumes: Sequence[Volume],
    layer: str,
    table: str,
    types: str,
) -> None:
    """Write volumes as a table, and as a layer `volumes` of polygons in the coordinates of the map.

    Args:
        sheet: Where.
        polygons: What was measured.
        volumes: Of each of them.
        layer: File name of the GeoPackage.
        table: File name of the CSV file; values that are not known are empty.
        types: File name of the types of its columns, without which QGIS and GDAL take numbers for texts.
    """
    with needed("pyogrio", "--volume"):
        import pyogrio  # noqa: F401
    names = [field.name for field in fields(Volume)]
    rows = [asdict(volume) for volume in volumes]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, names)
    writer.writeheader()
    writer.writerows(rows)
    (sheet.folder / table).write_text(text.getvalue(), encoding="utf-8", newline="")
    kinds = ['"String"' if isinstance(value, str) else '"Real"' for value in rows[0].values()]
    (sheet.folder / types).write_text(",".join(kinds) + "\n", encoding="utf-8", newline="")
    path = sheet.folder / layer
    for rest in sheet.folder.glob(f"{layer}*"):  # of an interrupted call
        rest.unlink()
    columns = []
    for name in names:
        values: list[Any] = [row[name] for row in rows]
        texts = isinstance(values[0], str)
        columns.append(np.array(values, object) if texts else np.array(values, np.float64))  # None is NaN, a NULL there
    shapes = np.array([polygon.shape.wkb for polygon in polygons], object)
    write_layer(path, "volumes", "MultiPolygon", sheet.crs, shapes, columns, names)
    sheet.deliver(sheet.folder / types)
    sheet.deliver(sheet.folder / table)
    sheet.deliver(path)


def volumes_record(volumes: Sequence[Volume]) -> dict[str, Any]:
    """What maps.json says of volumes: each of them, and the sums of fill, cut and net."""
    sums = {name: sum(getattr(volume, name) for volume in volumes) for name in ("fill", "cut", "net")}
    return {**sums, "polygons": [asdict(volume) for volume in volumes]}
