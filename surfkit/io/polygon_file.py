"""Polygons of a file that a surveyor drew: GeoJSON, GeoPackage or Shapefile, in the coordinates of a scene."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from surfkit.core.check import BadInput, few
from surfkit.core.codec import from_json
from surfkit.core.events import Warned, emit
from surfkit.core.optional import needed
from surfkit.scene.crs import TOPOCENTRIC, degrees_of, exact, in_plan, missing, not_installed, parsed

if TYPE_CHECKING:
    from shapely import MultiPolygon
    from shapely.geometry.base import BaseGeometry

NAME_FIELDS = ("name", "label", "title", "id", "nr", "number")
"""Fields that a polygon is called by, in any case; the first of them that is there."""
POLYGONS = ("Polygon", "MultiPolygon")
GEOJSON_ENDINGS = (".geojson", ".json")
REASON = re.compile(r"(.+)\[(\S+) (\S+)\]")
"""How GEOS says what is wrong with a polygon, and where."""
Bounds = tuple[float, float, float, float]
"""West, south, east, north."""
Move = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Site:
    """What polygons are drawn on.

    Attributes:
        what: For messages, such as "the map".
        crs: System of the data set, as its frame names it; None for one that is not georeferenced.
        bounds: West, south, east and north of it, units of the data set.
    """

    what: str
    crs: str | None
    bounds: Bounds


@dataclass(frozen=True)
class AreaPolygon:
    """A polygon of a file, or several that are one item of it.

    Attributes:
        name: What the file calls it, or its number.
        shape: Easting and northing in units of the data set; outlines anticlockwise, holes clockwise.
    """

    name: str
    shape: MultiPolygon

    @property
    def outlines(self) -> list[np.ndarray]:
        """Of each part, (n, 2) float64, the first place again at the end."""
        return [np.asarray(part.exterior.coords) for part in self.shape.geoms]

    @property
    def rings(self) -> list[np.ndarray]:
        """All outlines and holes, in the same form."""
        return [*self.outlines, *(np.asarray(hole.coords) for part in self.shape.geoms for hole in part.interiors)]


def require_polygons(option: str) -> None:
    """BadInput if a package is missing that reads polygons."""
    for package in ("pyogrio", "shapely"):
        with needed(package, option):
            __import__(package)


def read_polygons(path: Path, option: str, site: Site) -> list[AreaPolygon]:
    """The polygons of a file, in the coordinates of a scene.

    Coordinates are transformed from the system of the file to that of the scene; edges stay straight between their
    ends. GeoJSON is longitude and latitude on WGS 84 by RFC 7946, unless it has the member `crs` of its version of
    2008. Coordinates of a file without a system are taken as those of the scene, which a message says.

    Args:
        path: The file, with one layer.
        option: That names it, for messages.
        site: The scene, on which each polygon must lie in part.

    Raises:
        BadInput: A package is missing; the file cannot be read, or has no polygons or other shapes; a polygon is not
            valid (OGC Simple Features 06-103r4, 6.1.11), or lies beside the site; or its coordinates cannot be
            transformed.
    """
    require_polygons(option)
    import shapely
    from shapely.geometry.polygon import orient

    told = f"{option} {path}"
    names, shapes, system = _read(path, told)
    move = _mover(path, told, system, site)
    found = []
    for number, (name, binary) in enumerate(zip(names, shapes, strict=True), 1):
        where = f"{told}: polygon {number}" + (f" ({name!r})" if name != str(number) else "")
        shape = _valid(where, binary)
        moved = shapely.transform(shape, move)
        _refuse_beside(where, shape, moved, move, site)
        found.append(AreaPolygon(name, shapely.MultiPolygon([orient(part) for part in shapely.get_parts(moved)])))
    return found


def _read(path: Path, told: str) -> tuple[list[str], list[bytes | None], CRS | None]:
    """Names, well-known binary and coordinate reference system of the items of a file."""
    from pyogrio import list_layers
    from pyogrio.errors import DataLayerError, DataSourceError
    from pyogrio.raw import read

    if path.is_dir():
        raise BadInput(f"{told}: it is a folder; name the GeoJSON, GPKG or SHP file with the polygons")
    if not path.is_file():
        raise BadInput(f"{told}: there is no such file; name a GeoJSON, GPKG or SHP file with polygons")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of heights of corners, which are not used
            layers = list_layers(path)
            if len(layers) > 1:
                named = few([str(name) for name, _ in layers])
                raise BadInput(f"{told}: it has several layers, {named}; export the one with the polygons to a file")
            meta, _, shapes, fields = read(path, force_2d=True)
    except (DataSourceError, DataLayerError) as error:
        said = " ".join(str(error).split())[:200]
        raise BadInput(f"{told}: no GeoJSON, GPKG or SHP file that GDAL reads: {said}") from error
    if shapes is None or not len(shapes):
        raise BadInput(f"{told}: there is no polygon in it; draw at least one")
    columns = {str(name).lower(): values for name, values in zip(meta["fields"], fields, strict=True)}
    chosen = next((columns[name] for name in NAME_FIELDS if name in columns), [None] * len(shapes))
    names = [_name(value) or str(number) for number, value in enumerate(chosen, 1)]
    return names, list(shapes), _system(path, told, meta["crs"])


def _name(value: Any) -> str:
    """A value of a field as a name; "" for none."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value).strip()


def _system(path: Path, told: str, text: str | None) -> CRS | None:
    """The coordinate reference system of a file; None for one that has none, or a local one."""
    if path.suffix.lower() in GEOJSON_ENDINGS:
        try:
            head = from_json(path.read_text(encoding="utf-8-sig"))
        except (BadInput, ValueError) as error:  # GDAL reads some of what is no JSON
            raise BadInput(f"{told}: no sound JSON: {error}; export it again") from error
        if isinstance(head, dict) and "crs" in head and head["crs"] is None:
            return None  # by the version of 2008; GDAL takes it as left out
    if text is None:
        return None
    try:
        found = CRS(text)
    except CRSError as error:
        raise BadInput(f"{told}: pyproj does not know its coordinate reference system {text[:80]!r}") from error
    return None if found.is_engineering else in_plan(found)


def _mover(path: Path, told: str, system: CRS | None, site: Site) -> Move:
    """What turns coordinates of a file into those of the scene; infinite where they cannot be."""
    if system is None:
        emit(Warned(f"{told}: it names no coordinate reference system; its coordinates are taken as those of "
                    f"{site.what}"))  # fmt: skip
        return lambda places: places
    crs = site.crs
    if crs is None:
        none = '; in GeoJSON, write the member "crs": null' if path.suffix.lower() in GEOJSON_ENDINGS else ""
        raise BadInput(
            f"{told}: its coordinates are in {system.name}, and {site.what} is not georeferenced; give a file in "
            f"coordinates of {site.what}, without a coordinate reference system{none}"
        )
    place = TOPOCENTRIC.fullmatch(crs)
    drawn = f"+proj=ortho +lat_0={place[1]} +lon_0={place[2]} +datum=WGS84 +units=m" if place else crs
    target, west, south = in_plan(parsed(drawn)), *site.bounds[:2]
    known = exact(system, target)
    if known is None:
        raise BadInput(
            f"{told}: no transformation from its system, {system.name}, to that of {site.what}, {crs}, is known here; "
            f"convert the file to that of {site.what}, for example in QGIS"
        )
    lon, lat = degrees_of(drawn, np.array([[west, south]]))
    if np.isfinite([*lon, *lat]).all():
        grids, _ = missing(system, target, float(lon[0]), float(lat[0]))
        if grids:
            emit(Warned(f"{told}: a better transformation to {crs} is not in use: {not_installed(grids)}"))
    return lambda places: np.stack(known.transform(*places.T), axis=1)


def _valid(where: str, binary: bytes | None) -> BaseGeometry:
    """The shape in well-known binary; BadInput, which names the place, if it is no polygon, or its area is in doubt."""
    import shapely

    try:
        shape = None if binary is None else shapely.from_wkb(binary)
    except (shapely.errors.GEOSException, NotImplementedError) as error:  # too few corners; arcs
        said = " ".join(str(error).split()).removeprefix("IllegalArgumentException: ")
        raise BadInput(f"{where}: no polygon that GEOS reads: {said}; draw it anew, with straight edges") from error
    if shape is None or shape.is_empty:
        raise BadInput(f"{where}: it is empty; draw it, or delete it from the file")
    if shape.geom_type not in POLYGONS:
        raise BadInput(f"{where}: it is a {shape.geom_type}; only polygons have an area")
    if not shapely.is_valid(shape):
        found = REASON.fullmatch(reason := shapely.is_valid_reason(shape))
        if found is not None:
            reason = f"{found[1]} near {float(found[2]):.9g} {float(found[3]):.9g}"
        raise BadInput(
            f"{where}: it is not valid, so its area is in doubt: {reason[0].lower() + reason[1:]}; repair it (in QGIS: "
            "Fix geometries), and do it again"
        )
    return shape


def _refuse_beside(where: str, shape: BaseGeometry, moved: BaseGeometry, move: Move, site: Site) -> None:
    """BadInput for a polygon that lies beside the site, or has corners that its system does not reach.

    Args:
        where: What the message calls it.
        shape: As in the file.
        moved: In coordinates of the site.
        move: From the former to the latter.
        site: On which it must lie in part.
    """
    import shapely

    frame = shapely.box(*site.bounds)

    def meets(places: BaseGeometry) -> bool:
        return bool(np.isfinite(shapely.get_coordinates(places)).all() and shapely.intersects(places, frame))

    if meets(moved):
        return
    told = f"{where}: it lies within {_shown(shape.bounds)} in the file"
    if np.isfinite(shapely.get_coordinates(moved)).all():
        told += f", {_shown(moved.bounds)} on {site.what}"
    told += f", and {site.what} within {_shown(site.bounds)} (west south east north)"
    if meets(shapely.transform(shape, lambda places: move(places[:, ::-1]))):
        raise BadInput(f"{told}; with its two coordinates swapped it lies on {site.what}: write longitude (easting) "
                       "first")  # fmt: skip
    raise BadInput(f"{told}; move it, or correct the system of the file; or take another part for {site.what}")


def _shown(values: tuple[float, ...]) -> str:
    """Numbers with spaces between, for messages."""
    return " ".join(f"{value:.9g}" for value in values)
