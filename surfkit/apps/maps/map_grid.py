"""The plane that a map is drawn on: its axes, its cells, and the coordinate reference system they are written with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.optional import needed
from surfkit.io.area import Area
from surfkit.scene.crs import TOPOCENTRIC, refuse_other_unit, scale_at
from surfkit.scene.scene import Frame

MAX_MAP_CELLS = 4e10
"""Of a map: twice those of 14 x 14 km at 0.1 m."""
QUIET_SCALE_ERROR, MAX_SCALE_ERROR = 0.01, 0.1
"""Shares by which lengths on a map differ from those on the ground: a line tells of it; no map is drawn."""


@dataclass(frozen=True)
class Window:
    """A rectangle of cells: columns [left, left + width), rows [top, top + height), from the upper left of the map."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class MapGrid:
    """Square cells on the ground, north up.

    Borders of cells lie at multiples of their size, so that maps with the same size of cells have the same grid.

    Attributes:
        turn: (3, 3) float64 unit vectors in rows: east, north and up in the frame of the input.
        gsd: Side of a cell (ground sampling distance), units of the input.
        west: Easting of the left border, in cells.
        north: Northing of the upper border, in cells.
        width: Cells.
        height: Cells.
        area: What of the map is drawn; None for all of it.
    """

    turn: np.ndarray
    gsd: float
    west: int
    north: int
    width: int
    height: int
    area: Area | None = None

    @classmethod
    def around(cls, turn: np.ndarray, gsd: float, bounds: tuple[float, float, float, float]) -> MapGrid:
        """The cells that cover bounds: least easting and northing, then greatest, units of the input.

        Raises:
            BadInput: They are empty or too many.
        """
        west, south, east, north = (value / gsd for value in bounds)
        if not (west <= east and south <= north and math.isfinite(east - west + north - south)):
            raise BadInput(f"bounds {shown(bounds)}: nothing lies within; give west south east north of the surface")
        left, low = math.floor(west), math.floor(south)
        width, height = max(1, math.ceil(east) - left), max(1, math.ceil(north) - low)
        if width * height > MAX_MAP_CELLS:
            raise BadInput(
                f"--gsd: {width} x {height} cells of {gsd:g} are too many for one map (at most {MAX_MAP_CELLS:.0e}); "
                f"give "
                "a larger --gsd, or --bounds, if parts of the mesh lie far away"
            )
        return cls(turn, gsd, left, low + height, width, height)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north: borders of the outer cells, units of the input."""
        edges = self.west, self.north - self.height, self.west + self.width, self.north
        west, south, east, north = (edge * self.gsd for edge in edges)
        return west, south, east, north

    @property
    def cells(self) -> float:
        """How many are drawn; of an area, as many as its part on the map would hold."""
        if self.area is None:
            return self.width * self.height
        return self.area.within(self.bounds) / self.gsd**2

    def drawn(self, window: Window) -> np.ndarray:
        """(H, W) bool: which cells of a window are drawn, as their centres lie in the area."""
        inside = np.ones((window.height, window.width), bool)
        if self.area is not None:
            east = (self.west + window.left + np.arange(window.width) + 0.5) * self.gsd
            north = (self.north - window.top - np.arange(window.height) - 0.5) * self.gsd
            inside = self.area.contains(np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)).reshape(
                inside.shape
            )
        return inside

    def to_map(self, xyz: np.ndarray) -> np.ndarray:
        """(..., 3) float64 easting, northing and height of positions in the frame of the input."""
        return xyz if np.array_equal(self.turn, np.eye(3)) else xyz @ self.turn.T

    def to_cells(self, xyz: np.ndarray) -> np.ndarray:
        """(..., 3) float64 column and row, counted from the upper left corner of the map, and height, of positions in
        the frame of the input. Centres of cells are at +0.5."""
        found = np.array(self.to_map(xyz), np.float64)
        found[..., 0] = found[..., 0] / self.gsd - self.west
        found[..., 1] = self.north - found[..., 1] / self.gsd
        return found

    def from_cells(self, cells: np.ndarray) -> np.ndarray:
        """(..., 3) float64 positions in the frame of the input, of column, row and height: see `to_cells`."""
        found = np.array(cells, np.float64)
        found[..., 0] = (found[..., 0] + self.west) * self.gsd
        found[..., 1] = (self.north - found[..., 1]) * self.gsd
        return found if np.array_equal(self.turn, np.eye(3)) else found @ self.turn

    def tiles(self, side: int) -> Iterator[Window]:
        """Squares of so many cells that cover the map, row by row; smaller at its right and lower borders."""
        for top in range(0, self.height, side):
            for left in range(0, self.width, side):
                yield Window(left, top, min(side, self.width - left), min(side, self.height - top))


def map_crs(frame: Frame) -> tuple[Any, str]:
    """The coordinate reference system (of rasterio) that files of a frame have, and a line that says what it is.

    Coordinates about a place on Earth (topocentric) are written as its orthographic projection, which differs by less
    than 2 cm where 1 km from the place and 100 m high. Without a reference the file states a local one with its unit.

    Raises:
        BadInput: rasterio is missing, or the system is unknown, has no easting and northing in units of
            length, has heights in another unit, does not keep lengths, or contradicts the unit of the data set.
    """
    with needed("rasterio", "surfkit maps"):
        from rasterio.crs import CRS
        from rasterio.errors import CRSError
    crs = frame.crs
    if crs is None:
        unit = "metre" if frame.metres == 1 else "unit"
        told = f"{frame.metres:.15g} m" if frame.metres else "of unknown length"
        local = f'LOCAL_CS["local, not georeferenced",UNIT["{unit}",{frame.metres or 1:.15g}]]'
        return CRS.from_wkt(local), "local coordinates, not georeferenced; unit: " + (
            "1 m" if unit == "metre" else told
        )
    place = TOPOCENTRIC.fullmatch(crs)
    text = f"+proj=ortho +lat_0={place[1]} +lon_0={place[2]} +ellps=WGS84 +units=m" if place else crs
    try:
        found = CRS.from_user_input(text)
    except CRSError as error:
        raise BadInput(f"coordinate reference system {crs!r}: GDAL does not know it: {error}") from error
    if not found.is_projected:
        raise BadInput(
            f"coordinate reference system {crs!r}: maps need easting and northing in units of length; convert "
            "the cameras to a projected system such as UTM"
        )
    refuse_other_unit(crs, frame.metres, frame.origin)
    refuse_stretched(crs, frame.origin)
    return found, f"{text}, for coordinates about a place on Earth" if place else text


def refuse_stretched(crs: str, place: np.ndarray) -> None:
    """BadInput for a map on which areas and volumes would be far from those on the ground; a line if they are off."""
    longer = 1 / scale_at(crs, place)
    told = f"{crs}: lengths on the map are {longer:.4g} times those on the ground here, areas {longer**2:.4g} times"
    if abs(longer - 1) > MAX_SCALE_ERROR:
        raise BadInput(f"{told}; convert the cameras to a system that keeps lengths, such as UTM")
    if abs(longer - 1) > QUIET_SCALE_ERROR:
        emit(Warned(f"{told}; cells, areas and volumes are those of the map"))


def same_crs(one: str | None, other: str | None) -> bool:
    """Whether two coordinate reference systems are the same one, however they are spelt."""
    if one == other or one is None or other is None or TOPOCENTRIC.fullmatch(one) or TOPOCENTRIC.fullmatch(other):
        return one == other
    with needed("rasterio", "surfkit maps"):
        from rasterio.crs import CRS
        from rasterio.errors import CRSError
    try:
        return CRS.from_user_input(one) == CRS.from_user_input(other)
    except CRSError:
        return False


def shown(values: tuple[float, ...]) -> str:
    """Numbers with spaces between, for messages."""
    return " ".join(f"{value:.9g}" for value in values)
