"""How fast the camera of each photograph moved when it was taken: by the photographs before and after it, and by the
speed that drones write into XMP."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np

from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.scene.earth import geocentric

MAX_GAP_S = 15.0
"""Photographs farther apart in time say nothing of the speed in between."""
SPEED_SIGMA = 0.1
"""Standard deviation of a speed between two photographs, as a share: drones do not fly evenly."""
CLOCK_SIGMA_S = 0.4
"""That of the time between two photographs whose times are whole seconds."""
MIN_STEP_M = 3.0
"""Photographs nearer to each other say nothing of the scale: their positions are not exact enough."""


@dataclass(frozen=True)
class Velocity:
    """Of the camera of a photograph.

    Attributes:
        vector: (3,) units of the model per second.
        sigma: Standard deviation of each coordinate.
        by_xmp: Whether the speed is that of XMP; the direction is that of the path.
    """

    vector: np.ndarray
    sigma: float
    by_xmp: bool


@dataclass(frozen=True)
class Motion:
    """Of the cameras of a model.

    Attributes:
        velocities: By name of the photograph, those that are known.
        unit: Metres per unit of the model by the positions of the photographs; None where these do not tell.
    """

    velocities: Mapping[str, Velocity]
    unit: float | None

    @property
    def speed(self) -> float | None:
        """Median, m/s; None where the unit is not known."""
        if self.unit is None or not self.velocities:
            return None
        return self.unit * float(np.median([np.linalg.norm(each.vector) for each in self.velocities.values()]))


def motion_of(centres: Mapping[str, np.ndarray], photos: Mapping[str, Photo]) -> Motion:
    """The motion of cameras by the times of their photographs.

    Args:
        centres: (3,) of each placed camera, by name of the photograph.
        photos: By name.
    """
    groups: dict[tuple[str | None, str], list[tuple[float, str]]] = {}
    for name in centres:
        if (taken := seconds(photos[name].exif.taken)) is not None:
            folder = name.rpartition("/")[0]
            groups.setdefault((photos[name].exif.which, folder), []).append((taken, name))
    rows = [sorted(group) for group in groups.values()]
    unit = _unit(rows, centres, photos)
    found = {}
    for row in rows:
        times = np.array([taken for taken, _ in row])
        path = np.stack([centres[name] for _, name in row])
        for at, (_, name) in enumerate(row):
            if (velocity := _velocity(at, times, path, photos[name].exif.speed, unit)) is not None:
                found[name] = velocity
    return Motion(found, unit)


def seconds(taken: str | None) -> float | None:
    """Of a time as EXIF has it, "2024:05:01 12:00:00.25"; None for what is none."""
    whole, _, part = (taken or "").partition(".")
    try:
        since = datetime.strptime(whole, "%Y:%m:%d %H:%M:%S").replace(tzinfo=timezone.utc).timestamp()
    except ValueError:
        return None
    return since + float(f"0.{part}") if part.isdigit() else since


def _velocity(at: int, times: np.ndarray, path: np.ndarray, speed: float | None, unit: float | None) -> Velocity | None:
    """Of one photograph of a row: the derivative of the parabola through it and its neighbours in time."""
    before, after = np.searchsorted(times, times[at]) - 1, np.searchsorted(times, times[at], side="right")
    steps = [(int(other), float(times[other] - times[at])) for other in (before, after) if 0 <= other < len(times)]
    steps = [(other, step) for other, step in steps if abs(step) <= MAX_GAP_S]
    if not steps:
        return None
    slopes = np.stack([(path[other] - path[at]) / step for other, step in steps])
    weights = np.array([1 / abs(step) for _, step in steps])
    vector = (weights / weights.sum()) @ slopes
    size = float(np.linalg.norm(vector))
    clock = CLOCK_SIGMA_S / sum(abs(step) for _, step in steps) if (times == np.round(times)).all() else 0.0
    bend = float(np.linalg.norm(slopes[0] - slopes[-1])) / 2
    if speed is None or unit is None:
        return Velocity(vector, size * (SPEED_SIGMA + clock) + bend, False)
    vector = vector / max(size, 1e-12) * (speed / unit)
    return Velocity(vector, speed / unit * (SPEED_SIGMA + bend / max(size, 1e-12)), True)


def _unit(
    rows: list[list[tuple[float, str]]], centres: Mapping[str, np.ndarray], photos: Mapping[str, Photo]
) -> float | None:
    """Metres per unit of the model, by positions of photographs that follow each other."""
    found = []
    for row in rows:
        for (_, one), (_, other) in zip(row, row[1:], strict=False):
            places = [photos[name].exif.position for name in (one, other)]
            if any(place is None for place in places):
                continue
            ends = [geocentric(place[0], place[1], place[2] or 0.0) for place in places if place is not None]
            metres = float(np.linalg.norm(ends[0] - ends[1]))
            units = float(np.linalg.norm(centres[one] - centres[other]))
            if metres >= MIN_STEP_M and units > 0:
                found.append(metres / units)
    return float(np.median(found)) if found else None
