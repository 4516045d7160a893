"""Lengths and areas of what was clicked, and coordinates, in the units that the data set has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.scene.crs import TOPOCENTRIC
from surfkit.scene.scene import Frame
from surfkit.scene.up_direction import map_axes


@dataclass(frozen=True)
class PolylineMeasure:
    """Of K points in the order of clicking, units of the input or metres.

    Attributes:
        length: Of the line through them.
        level: Of that line seen from above.
        rise: Height of the last above the first.
        area: Enclosed, if the last is joined to the first, in the plane that suits the points best; the length of half
            the sum of p_i x p_i+1 (Newell's vector area).
        plan: The same area seen from above.
    """

    length: float
    level: float
    rise: float
    area: float
    plan: float


def measured(points: np.ndarray, up: np.ndarray, unit: float = 1.0) -> PolylineMeasure:
    """What (K, 3) points enclose.

    Args:
        points: Any frame.
        up: (3,) unit vector, the same frame.
        unit: Length of a unit of the frame.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3) * unit
    if not len(points):
        return PolylineMeasure(0.0, 0.0, 0.0, 0.0, 0.0)
    points = points - points[0]  # coordinates of millions of metres would lose digits in products
    steps = np.diff(points, axis=0)
    level = steps - np.outer(steps @ up, up)
    vector = np.cross(points, np.roll(points, -1, axis=0)).sum(0) / 2
    return PolylineMeasure(
        length=float(np.linalg.norm(steps, axis=1).sum()),
        level=float(np.linalg.norm(level, axis=1).sum()),
        rise=float(points[-1] @ up),
        area=float(np.linalg.norm(vector)),
        plan=float(abs(vector @ up)),
    )


def in_words(found: PolylineMeasure, frame: Frame, count: int) -> str:
    """A table in Markdown of what `count` points measure; the lengths are in metres if the frame has some."""
    name = "m" if frame.metres else "units"
    if count < 2:
        return "Click on the surface: two points measure a distance, three or more an area as well."
    rows = [("length", found.length, name), ("seen from above", found.level, name), ("rise", found.rise, name)]
    if count > 2:
        square = "m²" if frame.metres else "square units"
        rows += [("area, closed", found.area, square), ("area from above", found.plan, square)]
    return "| | |\n|---|---|\n" + "\n".join(f"| {what} | {shown(value)} {unit} |" for what, value, unit in rows)


def shown(value: float) -> str:
    """A length or an area with five significant digits, at most to a millimetre, never with an exponent."""
    digits = 3 if abs(value) < 100 else 2 if abs(value) < 1000 else 1
    return f"{value:,.{digits}f}" if abs(value) >= 1e-2 or value == 0 else f"{value:.3g}"


def coordinates(local: np.ndarray, frame: Frame, up: np.ndarray) -> str:
    """A (3,) local position in the coordinates of the data set, for people.

    Easting, northing and height where they have a reference system, which is named; x, y and z where they have none.
    """
    place = frame.to_input(local)
    if frame.crs is None:
        digits = decimals(frame)
        text = ", ".join(f"{axis} {value:.{digits}f}" for axis, value in zip("xyz", place, strict=True))
        return f"{text} (coordinates of the data set, not georeferenced)"
    names = ("east", "north", "up") if TOPOCENTRIC.fullmatch(frame.crs) else ("E", "N", "height")
    values = map_axes(np.asarray(up, np.float64)) @ place
    text = ", ".join(f"{name} {value:.{decimals(frame)}f}" for name, value in zip(names, values, strict=True))
    return f"{text} ({frame.crs})"


def decimals(frame: Frame) -> int:
    """Digits after the point that show a hundred-thousandth of the extent of the scene, 2 at least."""
    return int(np.clip(np.ceil(np.log10(frame.scale) + 5), 2, 9))


def path_lines(points: Sequence[np.ndarray], closed: bool) -> np.ndarray:
    """(S, 2, 3) segments through points, and back to the first if `closed`."""
    corners = np.asarray(points, np.float32).reshape(-1, 3)
    if len(corners) < 2:
        return np.zeros((0, 2, 3), np.float32)
    ends = np.roll(corners, -1, axis=0)
    segments = np.stack([corners, ends], axis=1)
    return segments if closed and len(corners) > 2 else segments[:-1]
