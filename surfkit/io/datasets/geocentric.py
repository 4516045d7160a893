"""Coordinates about the Earth's centre, brought to a map by a similarity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.topocentric import Similarity
from surfkit.scene.crs import MAX_UTM_LATITUDE, code_in, exact, from_wkt, in_plan, zone_of
from surfkit.scene.earth import FLATTENING, SEMI_MAJOR_AXIS_M, to_ecef, utm

WGS84 = ("EPSG:4326", "EPSG:4979")
EARTH_RADIUS_M = (6.2e6, 6.5e6)
"""Distances from the Earth's centre at which there are photographs."""
OnMap = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(P, 2) east and north of (P,) latitudes and longitudes, degrees."""
Convert = Callable[[np.ndarray], np.ndarray]
"""(P, 3) coordinates on the map of (P, 3) about the Earth's centre."""
AXIS_STEP_M = 100.0
"""Over which the directions of the axes are measured."""
QUIET_SHIFT_M = 0.1
"""Distances between a camera and its place on the map that are not told of."""
MAX_CAMERA_DISTANCE_M = 1e5
"""A camera that is farther from the others is a mistake."""


@dataclass(frozen=True)
class MapPlace:
    """Where on a map coordinates about the Earth's centre lie.

    Attributes:
        move: To the map.
        crs: Coordinate reference system of the map.
        metres: Per unit of it.
    """

    move: Similarity
    crs: str
    metres: float


def place_of(where: str, text: str, centres: np.ndarray) -> MapPlace | None:
    """The map of a coordinate reference system; None for local coordinates.

    A projected one is the map itself. For degrees it is the zone of UTM. Heights are those above the ellipsoid. As no
    pose follows a map exactly, lengths are scaled as they are on the map at the mean camera, heights too, and the
    surface bends away from the map as the Earth does: 8 cm at 1 km from that camera, 2 m at 5 km. A note says so.

    Args:
        where: The text is from, for messages.
        text: Well-known text; its datum is that of the coordinates.
        centres: (V, 3) of the cameras, metres from the Earth's centre.

    Raises:
        BadInput: It is no such text.
    """
    whole = from_wkt(where, text)
    if whole.is_engineering:
        return None
    flat = in_plan(whole)
    if not (flat.is_geographic or flat.is_projected):
        raise BadInput(
            f"{where}: {flat.name!r} is a {flat.type_name}, and no projected, geographic or local one; choose such a "
            "coordinate reference system, and export again"
        )
    middle = centres.mean(0)
    if not EARTH_RADIUS_M[0] < np.linalg.norm(middle) < EARTH_RADIUS_M[1]:
        emit(
            Warned(
                f"{where}: {flat.name!r}, but the cameras are not on the Earth: their coordinates are taken as local"
            )
        )
        return None
    if whole.is_compound:
        emit(Warned(f"{where}: heights are those above the ellipsoid, not {whole.sub_crs_list[1].name!r}"))
    axis, flattening = _ellipsoid(where, flat)
    degrees = geodetic(middle[None], axis, flattening)[0]
    crs, unit, on_map = _projection(where, text, flat, degrees)

    def convert(xyz: np.ndarray) -> np.ndarray:
        latitude, longitude, height = geodetic(xyz, axis, flattening).T
        return np.column_stack([on_map(latitude, longitude), height / unit])

    place = MapPlace(_similarity(where, convert, middle), crs, unit)
    warn_of_bend(where, flat.name, place.move, unit, convert, centres)
    return place


def topocentric_to_utm(local: str, crs: str) -> Convert:
    """The exact way from metres east, north and up of a place, `local` as PROJ names it, to a zone of UTM."""
    zone = zone_of(crs)
    if zone is None:
        raise ValueError(f"{crs} is no zone of UTM")

    def convert(xyz: np.ndarray) -> np.ndarray:
        found = geodetic(to_ecef(local, xyz))
        return np.array([[*utm(latitude, longitude, *zone), height] for latitude, longitude, height in found.tolist()])

    return convert


def geodetic(xyz: np.ndarray, axis: float = SEMI_MAJOR_AXIS_M, flattening: float = FLATTENING) -> np.ndarray:
    """(P, 3) latitude and longitude, degrees, and height, of (P, 3) metres from the centre of an ellipsoid."""
    squared = flattening * (2 - flattening)
    away = np.hypot(xyz[:, 0], xyz[:, 1])
    phi = np.arctan2(xyz[:, 2], away * (1 - squared))
    for _ in range(6):  # converges by a factor of some 300 a round
        across = axis / np.sqrt(1 - squared * np.sin(phi) ** 2)
        phi = np.arctan2(xyz[:, 2] + squared * across * np.sin(phi), away)
    height = away * np.cos(phi) + xyz[:, 2] * np.sin(phi) - axis * np.sqrt(1 - squared * np.sin(phi) ** 2)
    return np.column_stack([np.degrees(phi), np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])), height])


def _similarity(where: str, convert: Convert, middle: np.ndarray) -> Similarity:
    """From coordinates about the Earth's centre to the map, exact in a point and in the directions there."""
    steps = AXIS_STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
    around = convert(middle + steps)
    east, north, up = ((around[:3] - around[3:]) / (2 * AXIS_STEP_M)).T
    if not np.isfinite([east, north, up]).all() or not np.cross(east, north) @ up > 0:
        raise BadInput(f"{where}: its axes are not east, north and up at the cameras; export in another system")
    scale = float(np.sqrt(np.linalg.norm(east) * np.linalg.norm(north)))
    up = up / np.linalg.norm(up)
    north = north - up * (up @ north)
    north /= np.linalg.norm(north)
    turn = np.stack([np.cross(north, up), north, up])
    return Similarity(turn, scale, convert(middle[None])[0] - scale * turn @ middle)


def warn_of_bend(where: str, name: str, move: Similarity, metres: float, convert: Convert, centres: np.ndarray) -> None:
    """Say how far the camera that a similarity puts worst is from its place on the map, if that is far.

    Args:
        where: The cameras are from, for the message.
        name: Of the map.
        move: From the coordinates of the cameras to the map.
        metres: Per unit of the map.
        convert: The exact way to the map.
        centres: (V, 3) of the cameras.
    """
    near = centres[np.linalg.norm(centres - np.median(centres, axis=0), axis=1) <= MAX_CAMERA_DISTANCE_M]
    away = np.linalg.norm(move.points(near) - convert(near), axis=1)
    off = float(away[np.isfinite(away)].max(initial=0)) * metres
    if off > QUIET_SHIFT_M:
        emit(
            Warned(
                f"{where}: the Earth is round, {name!r} is flat: at the outermost camera, coordinates are {off:.2f} m "
                "off; for less, split the photographs into parts"
            )
        )


def _ellipsoid(where: str, flat: CRS) -> tuple[float, float]:
    """Its semi-major axis, metres, and flattening."""
    ellipsoid = flat.ellipsoid
    if ellipsoid is None:
        raise BadInput(f"{where}: {flat.name!r} has no ellipsoid; choose another system, and export again")
    axis, inverse = ellipsoid.semi_major_metre, ellipsoid.inverse_flattening
    if not (6e6 < axis < 7e6 and (inverse == 0 or 100 < inverse < 1000)):
        raise BadInput(
            f"{where}: {flat.name!r} has an ellipsoid of {axis:g} m and a flattening of 1 : {inverse:g}, which is not "
            "the Earth's; choose another coordinate reference system, and export again"
        )
    return axis, 1 / inverse if inverse else 0.0


def _projection(where: str, text: str, flat: CRS, at: np.ndarray) -> tuple[str, float, OnMap]:
    """The coordinate reference system of the map, metres per unit of it, and what brings degrees to it."""
    code = code_in(flat)
    zone = zone_of(code or "")
    if flat.is_geographic:
        if abs(at[0]) > MAX_UTM_LATITUDE:
            raise BadInput(f"{where}: degrees at latitude {at[0]:.1f}, where UTM ends; choose a projected system")
        zone = (int((at[1] + 180) // 6) % 60 + 1, bool(at[0] < 0))
    if zone is None:
        return _by_pyproj(where, text, code, None)
    utm_crs = f"EPSG:{(32700 if zone[1] else 32600) + zone[0]}"
    if flat.is_projected or code in WGS84:
        return utm_crs, 1.0, lambda lat, lon: np.array([utm(*pair, *zone) for pair in zip(lat, lon, strict=True)])
    return _by_pyproj(where, text, code, utm_crs)


def _by_pyproj(where: str, text: str, code: str | None, onto: str | None) -> tuple[str, float, OnMap]:
    """The same, of degrees on the datum of a text, or of the code in it, onto another system or its own."""
    try:
        given = CRS(code or text)
        given = given.sub_crs_list[0] if given.is_compound else given
        target = (CRS(onto) if onto else given).to_2d()
        if (geodetic_crs := given.geodetic_crs) is None:
            raise ProjError("it has no geodetic system")
        degrees = geodetic_crs.to_2d()
        if (known := exact(degrees, target)) is None:
            emit(Warned(f"{where}: the shift from its datum to {onto} is not known; places may be some 100 m off"))
            known = Transformer.from_crs(degrees, target, always_xy=True)
        unit = float(target.axis_info[0].unit_conversion_factor)
    except (ProjError, AttributeError, IndexError) as error:
        said = " ".join(str(error).split())[:200]
        raise BadInput(f"{where}: pyproj does not know its coordinate reference system: {said}") from error
    name = onto or code or " ".join(target.to_wkt().split())
    return name, unit, lambda lat, lon: np.column_stack(known.transform(lon, lat))
