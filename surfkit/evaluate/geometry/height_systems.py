"""What heights of two files are above, and in which unit: without that, a difference of heights says nothing."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from pyproj import CRS
from pyproj.exceptions import CRSError

from surfkit.evaluate.geometry.heights import RASTERS, raster_unit
from surfkit.scene.crs import SAME_UNIT, TOPOCENTRIC

ELLIPSOID = "the ellipsoid"
"""What heights of a system of three axes are above."""


@dataclass(frozen=True)
class HeightSystem:
    """Heights of a coordinate reference system.

    Attributes:
        name: Of the system of heights, such as "EGM96 height"; "" where it does not say what they are above.
        datum: What they are above, in small letters without marks; "" the same.
        metres: Per unit; None where it is not known.
    """

    name: str = ""
    datum: str = ""
    metres: float | None = None

    @classmethod
    def of(cls, crs: str | None, path: Path | None = None) -> HeightSystem:
        """That of a system, or of a file in it: a raster may name the unit of its heights itself.

        Heights of a system in plan are in its unit, as everywhere in surfkit.
        """
        own = raster_unit(path) if path is not None and path.suffix.lower() in RASTERS else None
        try:
            whole = CRS(crs) if crs and not TOPOCENTRIC.fullmatch(crs) else None
        except CRSError:  # told where the system is used
            whole = None
        if whole is None or not whole.axis_info:
            return cls(metres=own)
        axes = whole.axis_info
        metres = float(axes[min(2, len(axes) - 1)].unit_conversion_factor)
        if len(axes) < 3:
            return cls(metres=own if own is not None else None if whole.is_geographic else metres)
        if not whole.is_compound:
            return cls(ELLIPSOID, ELLIPSOID, own or metres)
        above = whole.sub_crs_list[1]
        datum = above.name if above.datum is None else above.datum.name
        return cls(above.name, re.sub("[^a-z0-9]", "", datum.lower()), own or metres)

    def contradicts(self, other: HeightSystem) -> str:
        """Why heights of both cannot be compared, in half a sentence; "" where nothing is known against it."""
        if self.datum and other.datum and self.datum != other.datum:
            return f"its heights are above {other.name}, and those here above {self.name}"
        if self.metres and other.metres and abs(other.metres / self.metres - 1) > SAME_UNIT:
            return f"its heights are in units of {other.metres:.7g} m, and those here of {self.metres:.7g} m"
        return ""

    def leaves_open(self, other: HeightSystem) -> str:
        """What one of both does not say, in half a sentence; "" where both say the same, or nothing."""
        if bool(self.datum) == bool(other.datum):
            return ""
        known, which = (self, "here") if self.datum else (other, "there")
        return (
            f"heights {which} are above {known.name}, and the other side does not say what its heights are above: "
            "sea level and the ellipsoid are up to 100 m apart"
        )
