"""The part of a scene that counts, by the polygons of a file: what lies above and below them, at any height."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.io.polygon_file import Bounds, Site, read_polygons, require_polygons

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

AREA_OPTION = "--area"


@dataclass(frozen=True)
class Area:
    """The union of the polygons of a file.

    Attributes:
        path: The file.
        polygons: How many it has.
        shape: Of shapely: easting and northing, units of the data set.
        plan: (2, 4) float64: easting and northing of x, y, z, 1 in the frame of the points that are asked for.
    """

    path: Path
    polygons: int
    shape: BaseGeometry
    plan: np.ndarray

    @property
    def bounds(self) -> Bounds:
        """West, south, east, north."""
        west, south, east, north = self.shape.bounds
        return west, south, east, north

    def within(self, bounds: Bounds) -> float:
        """How much of it lies within bounds, square units of the data set."""
        import shapely

        return shapely.intersection(self.shape, shapely.box(*bounds)).area

    def contains(self, places: np.ndarray) -> np.ndarray:
        """(n,) bool: which of (n, 2) eastings and northings lie in it."""
        import shapely

        shapely.prepare(self.shape)
        return shapely.contains_xy(self.shape, *places.T)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: which of (n, 3) positions lie in it."""
        return self.contains(points @ self.plan[:, :3].T + self.plan[:, 3])

    def moved(self, matrix: np.ndarray) -> Area:
        """The same for positions in another frame, to which a (4, 4) matrix leads from the one before."""
        return replace(self, plan=self.plan @ np.linalg.inv(matrix))

    def record(self) -> dict[str, Any]:
        """What files with facts say of it; the area in square units of the data set."""
        return {"file": str(self.path), "polygons": self.polygons, "area": self.shape.area}


def require_area() -> None:
    """BadInput if a package is missing that `--area` needs."""
    require_polygons(AREA_OPTION)


def read_area(path: Path, site: Site, turn: np.ndarray) -> Area:
    """The union of the polygons of a file; see `read_polygons`.

    Args:
        path: The file.
        site: On which each polygon must lie in part.
        turn: (3, 3) float64 unit vectors in rows: east, north and up of the site in the frame of the input.
    """
    found = read_polygons(Path(path), AREA_OPTION, site)
    import shapely

    plan = np.column_stack([turn[:2], np.zeros(2)])
    return Area(Path(path), len(found), shapely.union_all([each.shape for each in found]), plan)


def bounds_of(blocks: Iterable[np.ndarray], turn: np.ndarray) -> Bounds:
    """West, south, east and north of blocks of (n, 3) positions in the frame of the input; `turn` as in `read_area`."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for block in blocks:
        placed = (block @ turn.T)[:, :2] if len(block) else np.empty((0, 2))
        low, high = np.minimum(low, placed.min(0, initial=np.inf)), np.maximum(high, placed.max(0, initial=-np.inf))
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
