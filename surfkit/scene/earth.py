"""Where on Earth the coordinates of a map lie, on WGS 84: what viewers of the globe need.

UTM and topocentric frames, which the readers make, are computed here; any other coordinate reference system by pyproj.
Heights are above what the vertical part of the system says; without one, above the ellipsoid of its datum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.scene.crs import (
    COARSE_M,
    EGM96,
    LATLON_CRS,
    TOPOCENTRIC,
    UTM_PATTERN,
    axes_of,
    degrees_of,
    exact,
    is_plain,
    missing,
    not_installed,
    parsed,
    used_beyond,
)  # fmt: skip
from surfkit.scene.geoid import Geoid

SEMI_MAJOR_AXIS_M, FLATTENING = 6378137.0, 1 / 298.257223563
"""WGS 84: semi-major axis, metres, and flattening."""
UTM_SCALE, UTM_EAST, UTM_SOUTH = 0.9996, 500_000.0, 10_000_000.0
"""Scale on the central meridian; false easting, and northing south of the equator, metres."""
AXIS_STEP_M = 100.0
"""Over which the directions of the axes are measured."""
MAX_AXIS_UNIT_DIFFERENCE = 0.01
"""Most that the units of the axes differ by, as a share, in coordinates that are lengths."""
GEOCENTRIC_CRS, GEODETIC_CRS = "EPSG:4978", "EPSG:4979"
"""WGS 84: metres from the centre of the Earth; degrees and metres above the ellipsoid."""
Convert = Callable[[np.ndarray], np.ndarray]
"""(P, 3) metres from the centre of the Earth (EPSG:4978), of (P, 3) easting, northing and height."""


@dataclass(frozen=True)
class LocalEarthFrame:
    """Metres about a place on Earth, with the axes of a coordinate reference system as they are there.

    Attributes:
        crs: The coordinate reference system.
        pose: (4, 4) float64, a rotation and a translation: from the site to ECEF, EPSG:4978.
        unit: Metres per unit of the coordinate reference system there.
        convert: From coordinates to ECEF.
        notes: What the user is to know of the place, a line each.
    """

    crs: str
    pose: np.ndarray
    unit: float
    convert: Convert
    notes: tuple[str, ...] = ()

    @classmethod
    def at(cls, crs: str, origin: np.ndarray, geoid: Geoid | None = None) -> LocalEarthFrame:
        """The site of a place.

        Args:
            crs: Coordinate reference system, such as "EPSG:32632".
            origin: (3,) easting, northing and height.
            geoid: What heights are above; None leaves it to the system.

        Raises:
            BadInput: Its coordinates are no lengths of one unit, or the shift from its datum to WGS 84 is not known, or
                pyproj does not know it.
        """
        metres = axes_of(crs).metres
        convert, notes = on_earth(crs, origin, geoid)
        steps = AXIS_STEP_M / metres * np.concatenate([np.eye(3), -np.eye(3)])
        around = convert(origin + steps)
        axes = ((around[:3] - around[3:]) / (2 * AXIS_STEP_M / metres)).T
        units = np.linalg.norm(axes, axis=0)
        shown = " ".join(f"{value:.15g}" for value in origin)
        if not (np.isfinite(units).all() and np.linalg.det(axes) > 0):
            raise BadInput(f"{crs} at {shown}: its axes are not east, north and up there; name the system of the place")
        if not units.max() * (1 - MAX_AXIS_UNIT_DIFFERENCE) <= units.min():
            raise BadInput(
                f"{crs} at {shown}: 1 m to the east or north is {metres / units[:2].min():.4g} to "
                f"{metres / units[:2].max():.4g} m on the map, and 1 m of height is {metres / units[2]:.4g}; "
                "convert the cameras to a system that keeps lengths there, such as UTM"
            )
        up = axes[:, 2] / units[2]
        east = axes[:, 0] - up * (up @ axes[:, 0])
        east /= np.linalg.norm(east)
        pose = np.eye(4)
        pose[:3] = np.stack([east, np.cross(up, east), up, convert(origin[None])[0]], axis=1)
        return cls(crs, pose, float(np.prod(units) ** (1 / 3)), convert, notes)

    def local(self, xyz: np.ndarray) -> np.ndarray:
        """(P, 3) float64 metres about the site, of coordinates: the Earth is as round there as it is."""
        return (self.convert(xyz) - self.pose[:3, 3]) @ self.pose[:3, :3]


def to_ecef(crs: str, xyz: np.ndarray, geoid: Geoid | None = None) -> np.ndarray:
    """(P, 3) float64 metres from the centre of the Earth (EPSG:4978), of coordinates; see `on_earth`."""
    xyz = np.asarray(xyz, np.float64)
    return on_earth(crs, xyz.mean(0), geoid)[0](xyz)


def on_earth(crs: str, origin: np.ndarray, geoid: Geoid | None = None) -> tuple[Convert, tuple[str, ...]]:
    """What converts coordinates to ECEF, and what the user is to know of it.

    Args:
        crs: Of easting and northing.
        origin: (3,) a place near the coordinates: which transformation is best depends on it.
        geoid: What heights are above, whatever the system says. None: what its vertical part says, and without one the
            ellipsoid of its datum.

    Raises:
        BadInput: The shift from its datum to WGS 84 is not known there, or pyproj does not know the system.
    """
    untold = (
        f"{crs} does not say what heights are above: they are taken as above the ellipsoid of its datum; where they "
        "are above sea level, give the geoid with --geoid FILE or METRES",
    )
    if is_plain(crs) and (geoid is not None or not crs.endswith(EGM96)):
        return lambda xyz: _plainly(crs, np.asarray(xyz, np.float64), geoid), () if geoid else untold
    axes, given = axes_of(crs), parsed(crs)
    notes: tuple[str, ...] = ()
    if geoid is None:
        unit, whole = 1.0, given
        if axes.height_metres is None:
            unit, whole, notes = axes.metres, given.to_3d(), untold
        known = exact(whole, GEOCENTRIC_CRS)
        if known is not None:
            said = _refused_or_told(crs, known, whole, origin * [1, 1, unit])
            return lambda xyz: _transformed(crs, known, np.asarray(xyz, np.float64) * [1, 1, unit]), (*notes, *said)
    flat = given.to_2d()
    plan = exact(flat, LATLON_CRS)
    said = _refused_or_told(crs, plan, flat, origin[:2])
    if geoid is None:
        notes = (_without_grid(crs, given, origin),)
    metres = axes.height_metres or axes.metres

    def convert(xyz: np.ndarray) -> np.ndarray:
        xyz = np.asarray(xyz, np.float64)
        longitude, latitude = _transformed(crs, plan, xyz[:, :2]).T
        above = 0.0 if geoid is None else geoid(latitude, longitude)
        return geocentric(latitude, longitude, xyz[:, 2] * metres + above)

    return convert, (*notes, *said)


def geocentric(latitude: np.ndarray | float, longitude: np.ndarray | float, height: np.ndarray | float) -> np.ndarray:
    """(..., 3) ECEF metres of degrees and metres above the ellipsoid."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    squared = FLATTENING * (2 - FLATTENING)
    across = SEMI_MAJOR_AXIS_M / np.sqrt(1 - squared * np.sin(phi) ** 2)  # radius of curvature in the prime vertical
    flat = (across + height) * np.cos(phi)
    return np.stack([flat * np.cos(lam), flat * np.sin(lam), (across * (1 - squared) + height) * np.sin(phi)], axis=-1)


def east_north_up(latitude: float, longitude: float) -> np.ndarray:
    """(3, 3) unit vectors in columns, ECEF, of a place in degrees."""
    phi, lam = math.radians(latitude), math.radians(longitude)
    east = [-math.sin(lam), math.cos(lam), 0.0]
    up = [math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)]
    return np.stack([east, np.cross(up, east), up], axis=1)


def utm(latitude: float, longitude: float, zone: int, south: bool) -> tuple[float, float]:
    """Easting and northing in metres, of degrees on WGS 84, by Krueger's series to the fourth order: within 0.1 mm."""
    n, radius = _third_flattening()
    e = 2 * math.sqrt(n) / (1 + n)
    series = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180,
        13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140,
        49561 * n**4 / 161280,
    )
    sine, away = math.sin(math.radians(latitude)), math.radians(longitude - (6 * zone - 183))
    t = math.sinh(math.atanh(sine) - e * math.atanh(e * sine))
    xi, eta = math.atan2(t, math.cos(away)), math.asinh(math.sin(away) / math.hypot(t, math.cos(away)))
    along = xi + sum(a * math.sin(2 * j * xi) * math.cosh(2 * j * eta) for j, a in enumerate(series, 1))
    across = eta + sum(a * math.cos(2 * j * xi) * math.sinh(2 * j * eta) for j, a in enumerate(series, 1))
    return UTM_EAST + UTM_SCALE * radius * across, (UTM_SOUTH if south else 0) + UTM_SCALE * radius * along


def from_utm(east: np.ndarray, north: np.ndarray, zone: int, south: bool) -> tuple[np.ndarray, np.ndarray]:
    """(P,) latitudes and longitudes in degrees of (P,) metres: the inverse of `utm`, by the inverse series."""
    n, radius = _third_flattening()
    inverse = (
        n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96 - n**4 / 360,
        n**2 / 48 + n**3 / 15 - 437 * n**4 / 1440,
        17 * n**3 / 480 - 37 * n**4 / 840,
        4397 * n**4 / 161280,
    )
    latitudes = (
        2 * n - 2 * n**2 / 3 - 2 * n**3 + 116 * n**4 / 45,
        7 * n**2 / 3 - 8 * n**3 / 5 - 227 * n**4 / 45,
        56 * n**3 / 15 - 136 * n**4 / 35,
        4279 * n**4 / 630,
    )
    xi = (north - (UTM_SOUTH if south else 0)) / (UTM_SCALE * radius)
    eta = (east - UTM_EAST) / (UTM_SCALE * radius)
    along = xi - sum(b * np.sin(2 * j * xi) * np.cosh(2 * j * eta) for j, b in enumerate(inverse, 1))
    across = eta - sum(b * np.cos(2 * j * xi) * np.sinh(2 * j * eta) for j, b in enumerate(inverse, 1))
    conformal = np.arcsin(np.sin(along) / np.cosh(across))
    latitude = conformal + sum(d * np.sin(2 * j * conformal) for j, d in enumerate(latitudes, 1))
    return np.degrees(latitude), 6 * zone - 183 + np.degrees(np.arctan2(np.sinh(across), np.cos(along)))


def _third_flattening() -> tuple[float, float]:
    """Of WGS 84, and the radius of the rectifying sphere, metres."""
    n = FLATTENING / (2 - FLATTENING)
    return n, SEMI_MAJOR_AXIS_M / (1 + n) * (1 + n**2 / 4 + n**4 / 64)


def _plainly(crs: str, xyz: np.ndarray, geoid: Geoid | None) -> np.ndarray:
    """ECEF of coordinates of UTM on WGS 84, or of a topocentric frame."""
    if found := UTM_PATTERN.fullmatch(crs):
        latitudes, longitudes = from_utm(xyz[:, 0], xyz[:, 1], int(found[2]), found[1] == "7")
        above = 0.0 if geoid is None else geoid(latitudes, longitudes)
        return geocentric(latitudes, longitudes, xyz[:, 2] + above)
    topocentric = TOPOCENTRIC.fullmatch(crs)
    assert topocentric is not None, "callers have looked at the system"
    latitude, longitude, height = map(float, topocentric.groups())
    if geoid is not None:
        height += geoid(np.array([latitude]), np.array([longitude]))[0]
    return geocentric(latitude, longitude, height) + xyz @ east_north_up(latitude, longitude).T


def _transformed(crs: str, known: Any, places: np.ndarray) -> np.ndarray:
    """(P, n) what a transformer of pyproj makes of (P, n) coordinates."""
    found = np.stack(known.transform(*places.T), axis=1)
    if not np.isfinite(found).all():
        raise BadInput(f"coordinate reference system {crs!r}: pyproj cannot place some of the coordinates on Earth")
    return found


def _refused_or_told(crs: str, known: Any, source: Any, place: np.ndarray) -> tuple[str, ...]:
    """What is to be told of a transformation; BadInput where there is none for (2,) or (3,) coordinates of a place."""
    longitude, latitude = (float(at[0]) for at in degrees_of(crs, place[None]))
    if not np.isfinite([longitude, latitude]).all():
        raise BadInput(f"coordinate reference system {crs!r}: pyproj cannot place some of the coordinates on Earth")
    grids, best = missing(source, GEODETIC_CRS if len(place) == 3 else LATLON_CRS, longitude, latitude)
    here, remedy = f"latitude {latitude:.4f}, longitude {longitude:.4f}", not_installed(grids) or "name another system"
    if known is None:
        raise BadInput(
            f"{crs}: the shift from its datum to WGS 84 is not known at {here}; without it, places are some 100 m off: "
            f"{remedy}"
        )
    _transformed(crs, known, place[None])
    if used_beyond(known, longitude, latitude):
        return (f"{crs} is not meant for {here}, so places on Earth may be some 100 m off: {remedy}",)
    accuracy = known.get_last_used_operation().accuracy
    if accuracy >= COARSE_M and 0 <= best < accuracy and grids:
        return (f"{crs} is placed on Earth within {accuracy:g} m; for {best:g} m {not_installed(grids)}",)
    return ()


def _without_grid(crs: str, given: Any, origin: np.ndarray) -> str:
    """That heights above a geoid are taken as above the ellipsoid, and what is missing."""
    longitude, latitude = (float(at[0]) for at in degrees_of(crs, origin[None]))
    grids, _ = missing(given, GEODETIC_CRS, longitude, latitude)
    why = f"{not_installed(grids)}, or" if grids else "PROJ knows no geoid for them;"
    return (
        f"{crs}: its heights, above sea level, are taken as above the ellipsoid, up to 100 m off: {why} give the geoid "
        "with --geoid FILE or METRES"
    )
