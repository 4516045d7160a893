"""Where on Earth a topocentric reconstruction lies: to UTM by a similarity, as OpenDroneMap does by an affine map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.crs_names import system_of
from surfkit.scene.crs import MAX_UTM_LATITUDE, MAX_UTM_OFFSET_DEGREES, zone_of
from surfkit.scene.earth import FLATTENING, SEMI_MAJOR_AXIS_M, utm

MAX_COORDINATE_M = 1e8
"""No coordinate on Earth is larger, metres."""
ODM_FOLDER = "odm_georeferencing"


@dataclass(frozen=True)
class Similarity:
    """new = scale * turn @ old + move, float64."""

    turn: np.ndarray
    scale: float
    move: np.ndarray

    def points(self, xyz: np.ndarray) -> np.ndarray:
        """(P, 3) new positions."""
        return self.scale * xyz @ self.turn.T + self.move

    def pose(self, pose: np.ndarray) -> np.ndarray:
        """(4, 4) world_to_camera of the new world; camera units become new units too."""
        new = pose.copy()
        new[:3, :3] = pose[:3, :3] @ self.turn.T
        new[:3, 3] = self.scale * pose[:3, 3] - new[:3, :3] @ self.move
        return new


@dataclass(frozen=True)
class GeoPlacement:
    """A reconstruction on Earth.

    Attributes:
        crs: Coordinate reference system of its coordinates, after `moved`.
        moved: From the coordinates of the file; None if they stay.
        shift: What files of these coordinates leave out.
        local: Coordinate reference system before `moved`: metres east, north and up of a place.
    """

    crs: str
    moved: Similarity | None = None
    shift: tuple[float, float, float] | None = None
    local: str | None = None


def place_on_earth(root: Path, folder: Path, model: Mapping[str, Any], height: float) -> GeoPlacement | None:
    """Where a reconstruction of OpenSfM lies, in UTM if OpenDroneMap chose a zone; None if it has no GPS.

    Args:
        root: The project, with odm_georeferencing/.
        folder: That of the reconstruction, with reference_lla.json.
        model: The reconstruction, topocentric.
        height: z that keeps its altitude while all lengths are scaled as the map is, some 0.04 %.
    """
    reference = _reference(folder, model)
    if reference is None:
        return None
    latitude, longitude, altitude = reference
    local = f"+proj=topocentric +ellps=WGS84 +lat_0={latitude!r} +lon_0={longitude!r} +h_0={altitude!r}"
    lines = _lines(root / ODM_FOLDER / "coords.txt")
    texts = [*lines[:1], *_lines(root / ODM_FOLDER / "proj.txt")[:1]]
    zone = next(filter(None, map(_zone, texts)), None)
    if zone is None or abs(latitude) > MAX_UTM_LATITUDE:
        if texts:
            emit(
                Warned(
                    f"{root / ODM_FOLDER}: {texts[0]!r} is no zone of UTM on WGS 84 at {latitude:.6f}, "
                    f"{longitude:.6f}: "
                    "coordinates are metres east, north and up of there"
                )
            )
        return GeoPlacement(local)
    number, south = zone
    if not abs((longitude - (6 * number - 183) + 180) % 360 - 180) < MAX_UTM_OFFSET_DEGREES:
        raise BadInput(
            f"{root / ODM_FOLDER}: zone {number} of UTM is far from the reconstruction's {latitude:.6f}, "
            f"{longitude:.6f}; "
            "run OpenDroneMap again, or delete coords.txt and proj.txt"
        )
    shift = _offset(root / ODM_FOLDER / "coords.txt", lines)
    return GeoPlacement(
        f"EPSG:{(32700 if south else 32600) + number}", _onto_map(reference, zone, height), shift, local
    )


def _onto_map(reference: tuple[float, float, float], zone: tuple[int, bool], height: float) -> Similarity:
    """From metres east, north and up of a reference to UTM and altitude."""
    latitude, longitude, altitude = reference
    squared = FLATTENING * (2 - FLATTENING)
    w = 1 - squared * math.sin(math.radians(latitude)) ** 2
    north_m = SEMI_MAJOR_AXIS_M * (1 - squared) / w**1.5 + altitude  # radius of the meridian
    a_metre = math.degrees(1 / north_m)
    step = 100.0
    upper = utm(latitude + step * a_metre, longitude, *zone)
    lower = utm(latitude - step * a_metre, longitude, *zone)
    east, north = ((u - v) / (2 * step) for u, v in zip(upper, lower, strict=True))
    scale = math.hypot(east, north)
    cosine, sine = north / scale, east / scale
    turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Similarity(turn, scale, np.array([*utm(latitude, longitude, *zone), altitude + height * (1 - scale)]))


def _reference(folder: Path, model: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Latitude and longitude, degrees, and altitude, metres, of the origin; None where the photographs had no GPS."""
    path = folder / "reference_lla.json"
    given = model.get("reference_lla") or (read_json(path, Any) if path.is_file() else None)
    if given is None:
        return None
    try:
        values = tuple(float(given[name]) for name in ("latitude", "longitude", "altitude"))
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise BadInput(f"{path}: lacks latitude, longitude or altitude; run OpenSfM again") from error
    if not (abs(values[0]) <= 90 and abs(values[1]) <= 180 and abs(values[2]) < MAX_COORDINATE_M):
        raise BadInput(f"{path}: {values[0]:g}, {values[1]:g} at {values[2]:g} m is no place; run OpenSfM again")
    return None if values[:2] == (0, 0) else values  # type: ignore[return-value]


def _lines(path: Path) -> list[str]:
    """Lines of a text file that are not empty; none where there is no such file."""
    try:
        return [line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot be read as text; run OpenDroneMap again, or delete it") from error


def _zone(text: str) -> tuple[int, bool] | None:
    """The zone of UTM on WGS 84 that a line of OpenDroneMap names; None where it names another system, or none."""
    try:
        return zone_of(system_of(text).crs)
    except BadInput:
        return None


def _offset(path: Path, lines: list[str]) -> tuple[float, float, float] | None:
    """What OpenDroneMap leaves out of the coordinates in its files."""
    if len(lines) < 2:
        return None
    try:
        east, north = (float(word) for word in lines[1].split()[:2])
    except ValueError as error:
        raise BadInput(f"{path}: line 2 is {lines[1]!r}, not two numbers; run OpenDroneMap again") from error
    if not (abs(east) < MAX_COORDINATE_M and abs(north) < MAX_COORDINATE_M):
        raise BadInput(f"{path}: line 2 is {lines[1]!r}, not two lengths on Earth; run OpenDroneMap again")
    return east, north, 0.0
