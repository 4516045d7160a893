"""Polygons of a file that a surveyor drew: GeoJSON, GeoPackage or Shapefile, in the coordinates of a map."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from surfkit.apps.maps.map_grid import MapGrid, shown
from surfkit.apps.maps.polygon_checks import refuse_crossing, signed_area
from surfkit.core.check import BadInput, few
from surfkit.core.codec import from_json
from surfkit.core.events import Warned, emit
from surfkit.core.optional import needed
from surfkit.scene.crs import TOPOCENTRIC, degrees_of, exact, in_plan, missing, not_installed, parsed

NAME_FIELDS = ("name", "label", "title", "id", "nr", "number")
"""Fields that a polygon is called by, in any case; the first of them that is there."""
WKB_NAMES = {
    1: "a point", 2: "a line", 4: "points", 5: "lines", 7: "a collection of shapes", 8: "a curve", 9: "a curve",
    10: "a polygon with arcs", 11: "a curve", 12: "a surface with arcs",
}  # fmt: skip
"""What the types of well-known binary are, but for polygons."""
WKB_POLYGON, WKB_MULTIPOLYGON = 3, 6
GEOJSON_ENDINGS = (".geojson", ".json")
LEAST_CORNERS = 4
"""Of a ring, the first one counted again at its end."""
Move = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class AreaPolygon:
    """A polygon of a file, or several that are one item of it.

    Attributes:
        name: What the file calls it, or its number.
        parts: Of each part the outline, then its holes: (n, 2) float64 easting and northing in units of the map, the
            first place again at the end; outlines anticlockwise, holes clockwise.
    """

    name: str
    parts: tuple[tuple[np.ndarray, ...], ...]

    @property
    def rings(self) -> list[np.ndarray]:
        """All outlines and holes."""
        return [ring for part in self.parts for ring in part]

    def as_lists(self) -> list[Any]:
        """The same as JSON has it."""
        return [self.name, [[ring.tolist() for ring in part] for part in self.parts]]

    @property
    def area(self) -> float:
        """In square units of the map, without holes."""
        return sum(map(signed_area, self.rings))


def read_polygons(path: Path, grid: MapGrid, crs: str | None) -> list[AreaPolygon]:
    """The polygons of a file, in the coordinates of a map.

    Coordinates are transformed from the system of the file to that of the map; edges stay straight between their ends.
    GeoJSON is longitude and latitude on WGS 84 by RFC 7946, unless it has the member `crs` of its version of 2008.
    Coordinates of a file without a system are taken as those of the map, which a message says.

    Args:
        path: The file, with one layer.
        grid: The map, on which each polygon must lie in part.
        crs: System of the data set, as its frame names it; None for one that is not georeferenced.

    Raises:
        BadInput: A package is missing; the file cannot be read, or has no polygons or other shapes; a polygon is not
            sound, or lies beside the map; or its coordinates cannot be transformed.
    """
    names, shapes, system = _read(path)
    move = _mover(path, system, crs, grid)
    found = []
    for number, (name, shape) in enumerate(zip(names, shapes, strict=True), 1):
        where = f"{path}: polygon {number}" + (f" ({name!r})" if name != str(number) else "")
        parts = _parts(where, shape) if shape else []
        if not parts:
            raise BadInput(f"{where}: it is empty; draw it, or delete it from the file")
        parts = [[_without_repeats(ring) for ring in part] for part in parts]
        rings = [ring for part in parts for ring in part]
        if any(len(ring) < LEAST_CORNERS or not np.isfinite(ring).all() for ring in rings):
            raise BadInput(f"{where}: a ring of it has less than three corners, or one that is no number; draw it anew")
        refuse_crossing(where, parts)
        _refuse_beside(where, np.concatenate([part[0] for part in parts]), move, grid)
        moved = [[move(ring) for ring in part] for part in parts]
        turned = tuple(tuple(_turned(ring, at == 0) for at, ring in enumerate(part)) for part in moved)
        found.append(AreaPolygon(name, turned))
    return found


def _read(path: Path) -> tuple[list[str], list[bytes | None], CRS | None]:
    """Names, well-known binary and coordinate reference system of the items of a file."""
    with needed("pyogrio", "a file of polygons"):
        from pyogrio import list_layers
        from pyogrio.errors import DataLayerError, DataSourceError
        from pyogrio.raw import read
    if not path.is_file():
        raise BadInput(f"{path}: there is no such file; name a GeoJSON, GPKG or SHP file with polygons")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of heights of corners, which are not used
            layers = list_layers(path)
            if len(layers) > 1:
                told = few([str(name) for name, _ in layers])
                raise BadInput(f"{path}: it has several layers, {told}; export the one with the polygons to a file")
            meta, _, shapes, fields = read(path, force_2d=True)
    except (DataSourceError, DataLayerError) as error:
        said = " ".join(str(error).split())[:200]
        raise BadInput(f"{path}: no GeoJSON, GPKG or SHP file that GDAL reads: {said}") from error
    if shapes is None or not len(shapes):
        raise BadInput(f"{path}: there is no polygon in it; draw at least one")
    columns = {str(name).lower(): values for name, values in zip(meta["fields"], fields, strict=True)}
    chosen = next((columns[name] for name in NAME_FIELDS if name in columns), [None] * len(shapes))
    names = [_name(value) or str(number) for number, value in enumerate(chosen, 1)]
    return names, list(shapes), _system(path, meta["crs"])


def _name(value: Any) -> str:
    """A value of a field as a name; "" for none."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value).strip()


def _system(path: Path, text: str | None) -> CRS | None:
    """The coordinate reference system of a file; None for one that has none, or a local one."""
    if path.suffix.lower() in GEOJSON_ENDINGS:
        try:
            head = from_json(path.read_text(encoding="utf-8-sig"))
        except (BadInput, ValueError) as error:  # GDAL reads some of what is no JSON
            raise BadInput(f"{path}: no sound JSON: {error}; export it again") from error
        if isinstance(head, dict) and "crs" in head and head["crs"] is None:
            return None  # by the version of 2008; GDAL takes it as left out
    if text is None:
        return None
    try:
        found = CRS(text)
    except CRSError as error:
        raise BadInput(f"{path}: pyproj does not know its coordinate reference system {text[:80]!r}") from error
    return None if found.is_engineering else in_plan(found)


def _mover(path: Path, system: CRS | None, crs: str | None, grid: MapGrid) -> Move:
    """What turns coordinates of a file into those of the map; infinite where they cannot be."""
    if system is None:
        emit(Warned(f"{path}: it names no coordinate reference system; its coordinates are taken as those of the map"))
        return lambda places: places
    if crs is None:
        none = '; in GeoJSON, write the member "crs": null' if path.suffix.lower() in GEOJSON_ENDINGS else ""
        raise BadInput(
            f"{path}: its coordinates are in {system.name}, and the map is not georeferenced; give a file in "
            f"coordinates of the map, without a coordinate reference system{none}"
        )
    place = TOPOCENTRIC.fullmatch(crs)
    drawn = f"+proj=ortho +lat_0={place[1]} +lon_0={place[2]} +datum=WGS84 +units=m" if place else crs
    target, west, south = in_plan(parsed(drawn)), *grid.bounds[:2]
    known = exact(system, target)
    if known is None:
        raise BadInput(
            f"{path}: no transformation from its system, {system.name}, to that of the map, {crs}, is known here; "
            "convert the file to that of the map, for example in QGIS"
        )
    lon, lat = degrees_of(drawn, np.array([[west, south]]))
    if np.isfinite([*lon, *lat]).all():
        grids, _ = missing(system, target, float(lon[0]), float(lat[0]))
        if grids:
            emit(Warned(f"{path}: a better transformation to {crs} is not in use: {not_installed(grids)}"))
    return lambda places: np.stack(known.transform(*places.T), axis=1)


def _parts(where: str, shape: bytes) -> list[list[np.ndarray]]:
    """The polygons in well-known binary, each its outline, then its holes."""
    kind, order = _kind(shape, 0)
    if kind not in (WKB_POLYGON, WKB_MULTIPOLYGON):
        raise BadInput(f"{where}: it is {WKB_NAMES.get(kind, 'no polygon')}; only polygons have a volume")
    if kind == WKB_POLYGON:
        rings = list(_rings(shape, 0, order))
        return [rings] if rings else []
    (count,), at, parts = struct.unpack_from(order + "I", shape, 5), 9, []
    for _ in range(count):
        _, inner = _kind(shape, at)
        rings = list(_rings(shape, at, inner))
        at += 9 + sum(4 + 16 * len(ring) for ring in rings)
        if rings:
            parts.append(rings)
    return parts


def _kind(shape: bytes, at: int) -> tuple[int, str]:
    """Type of a shape in two dimensions, and the order of its bytes as `struct` writes it."""
    order = "<" if shape[at] else ">"
    return struct.unpack_from(order + "I", shape, at + 1)[0], order


def _rings(shape: bytes, at: int, order: str) -> Iterator[np.ndarray]:
    """(n, 2) float64 of each ring of a polygon; the first place again at the end."""
    (count,) = struct.unpack_from(order + "I", shape, at + 5)
    at += 9
    for _ in range(count):
        (length,) = struct.unpack_from(order + "I", shape, at)
        yield np.frombuffer(shape, order + "f8", 2 * length, at + 4).reshape(-1, 2).astype(np.float64)
        at += 4 + 16 * length


def _without_repeats(ring: np.ndarray) -> np.ndarray:
    """A ring without places that follow themselves, as digitizing makes them."""
    return ring[np.r_[True, (np.diff(ring, axis=0) != 0).any(1)]] if len(ring) else ring


def _turned(ring: np.ndarray, outline: bool) -> np.ndarray:
    """A ring as it has to run: outlines anticlockwise, holes clockwise."""
    return ring if (signed_area(ring) > 0) == outline else ring[::-1]


def _refuse_beside(where: str, outline: np.ndarray, move: Move, grid: MapGrid) -> None:
    """BadInput for a polygon that lies beside the map, or has corners that its system does not reach."""
    moved = move(outline)
    if np.isfinite(moved).all() and _meets(moved, grid):
        return
    place = shown((*outline.min(0), *outline.max(0)))
    told = f"{where}: it lies within {place} in the file"
    if np.isfinite(moved).all():
        told += f", {shown((*moved.min(0), *moved.max(0)))} on the map"
    told += f", and the map within {shown(grid.bounds)} (west south east north)"
    swapped = move(outline[:, ::-1])
    if np.isfinite(swapped).all() and _meets(swapped, grid):
        raise BadInput(f"{told}; with its two coordinates swapped it lies on the map: write longitude (easting) first")
    raise BadInput(f"{told}; move it, draw another part of the map, or correct the system of the file")


def _meets(places: np.ndarray, grid: MapGrid) -> bool:
    """Whether the bounding box of places has an area in common with a map."""
    west, south, east, north = grid.bounds
    low, high = places.min(0), places.max(0)
    return bool(low[0] < east and high[0] > west and low[1] < north and high[1] > south)
