"""Where on Earth the coordinates of a map lie, on WGS 84: what viewers of the globe need.

UTM and topocentric frames, which the readers make, are computed here; any other coordinate reference system by pyproj.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.optional import needed

AXIS, FLATTENING = 6378137.0, 1 / 298.257223563
"""WGS 84: semi-major axis, metres, and flattening."""
UTM_SCALE, UTM_EAST, UTM_SOUTH = 0.9996, 500_000.0, 10_000_000.0
"""Scale on the central meridian; false easting, and northing south of the equator, metres."""
STEP_M = 100.0
"""Over which the directions of the axes are measured."""
UNEVEN = 0.01
"""Most that the units of the axes differ by, as a share, in coordinates that are lengths."""
NUMBER = r"(-?[\d.]+(?:e-?\d+)?)"
TOPOCENTRIC = re.compile(rf"\+proj=topocentric \+ellps=WGS84 \+lat_0={NUMBER} \+lon_0={NUMBER} \+h_0={NUMBER}")
UTM = re.compile(r"EPSG:32([67])(\d\d)", re.IGNORECASE)


@dataclass(frozen=True)
class Site:
    """Metres about a place on Earth, with the axes of a coordinate reference system as they are there.

    Attributes:
        crs: The coordinate reference system.
        pose: (4, 4) float64, a rotation and a translation: from the site to ECEF, EPSG:4978.
        unit: Metres per unit of the coordinate reference system there.
    """

    crs: str
    pose: np.ndarray
    unit: float

    @classmethod
    def at(cls, crs: str, origin: np.ndarray) -> Site:
        """The site of a place.

        Args:
            crs: Coordinate reference system, such as "EPSG:32632".
            origin: (3,) easting, northing and height.

        Raises:
            BadInput: Its coordinates are no lengths, or pyproj is needed and not installed, or does not know it.
        """
        steps = STEP_M * np.concatenate([np.eye(3), -np.eye(3)])
        around = to_ecef(crs, origin + steps)
        axes = ((around[:3] - around[3:]) / (2 * STEP_M)).T
        units = np.linalg.norm(axes, axis=0)
        if not (np.isfinite(units).all() and units.max() * (1 - UNEVEN) <= units.min() and np.linalg.det(axes) > 0):
            shown = " ".join(f"{value:.15g}" for value in origin)
            feet = "; name heights in feet too, such as EPSG:2263+6360" if 0.3 < units[0] < 0.31 else ""
            raise BadInput(f"{crs} at {shown}: its axes are not east, north and up in one unit of length{feet}")
        up = axes[:, 2] / units[2]
        east = axes[:, 0] - up * (up @ axes[:, 0])
        east /= np.linalg.norm(east)
        pose = np.eye(4)
        pose[:3] = np.stack([east, np.cross(up, east), up, to_ecef(crs, origin[None])[0]], axis=1)
        return cls(crs, pose, float(np.prod(units) ** (1 / 3)))

    def local(self, xyz: np.ndarray) -> np.ndarray:
        """(P, 3) float64 metres about the site, of coordinates: the Earth is as round there as it is."""
        return (to_ecef(self.crs, xyz) - self.pose[:3, 3]) @ self.pose[:3, :3]


def to_ecef(crs: str, xyz: np.ndarray) -> np.ndarray:
    """(P, 3) float64 metres from the centre of the Earth (EPSG:4978), of easting, northing and height.

    Heights are taken as above the ellipsoid, unless the coordinate reference system says otherwise to pyproj.

    Raises:
        BadInput: pyproj is needed and not installed, or does not know the coordinate reference system.
    """
    xyz = np.asarray(xyz, np.float64)
    if (found := UTM.fullmatch(crs)) and 1 <= int(found[2]) <= 60:
        latitude, longitude = from_utm(xyz[:, 0], xyz[:, 1], int(found[2]), found[1] == "7")
        return geocentric(latitude, longitude, xyz[:, 2])
    if found := TOPOCENTRIC.fullmatch(crs):
        latitude, longitude, height = map(float, found.groups())
        return geocentric(latitude, longitude, height) + xyz @ east_north_up(latitude, longitude).T
    return _by_pyproj(crs, xyz)


def geocentric(latitude: np.ndarray | float, longitude: np.ndarray | float, height: np.ndarray | float) -> np.ndarray:
    """(..., 3) ECEF metres of degrees and metres above the ellipsoid."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    squared = FLATTENING * (2 - FLATTENING)
    across = AXIS / np.sqrt(1 - squared * np.sin(phi) ** 2)  # radius of curvature in the prime vertical
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
    return n, AXIS / (1 + n) * (1 + n**2 / 4 + n**4 / 64)


def _by_pyproj(crs: str, xyz: np.ndarray) -> np.ndarray:
    with needed("pyproj", f"the coordinate reference system {crs}"):
        from pyproj import CRS, Transformer
        from pyproj.exceptions import ProjError
    try:
        given = CRS(crs)
        if given.is_geographic:
            raise BadInput(f"{crs}: it is in degrees, where lengths belong; name a projected one, such as EPSG:32633")
        known = Transformer.from_crs(given.to_3d(), "EPSG:4978", always_xy=True)
        found = np.stack(known.transform(*xyz.T), axis=1)
    except ProjError as error:
        said = " ".join(str(error).split())[:200]
        raise BadInput(f"coordinate reference system {crs!r}: pyproj cannot place it on Earth: {said}") from error
    if not np.isfinite(found).all():
        raise BadInput(f"coordinate reference system {crs!r}: pyproj cannot place some of the coordinates on Earth")
    return found
