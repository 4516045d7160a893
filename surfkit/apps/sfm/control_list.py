"""Lists of ground control points, as OpenDroneMap has them (gcp_list.txt): places, and where photographs show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from surfkit.apps.sfm.georeference import MapProjection, chart_about, chart_of, to_chart
from surfkit.core.check import BadInput, few
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.crs_names import system_of

MIN_CONTROL_POINTS, MIN_POINT_PHOTOS = 3, 2
"""Control points that determine a similarity; photographs that determine where a point is."""


@dataclass(frozen=True)
class GroundControlPoint:
    """A place on the map that photographs show.

    Attributes:
        name: As the list has it, or its line number.
        xyz: (3,) in the coordinates of the list.
        marks: By name of the photograph, the pixel: x to the right and y down from the corner of the file as stored.
    """

    name: str
    xyz: tuple[float, float, float]
    marks: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class GroundControl:
    """Ground control points on a map.

    Attributes:
        points: Of the list.
        chart: The map.
        onto: (P, 3) their places less the offset.
        first: The system in the words of the list.
    """

    points: Sequence[GroundControlPoint]
    chart: MapProjection
    onto: np.ndarray
    first: str


def read_list(path: Path) -> tuple[str, list[GroundControlPoint]]:
    """The coordinate reference system of a list, and its points in their order.

    Raises:
        BadInput: The file cannot be read, or a line is not `x y z pixel_x pixel_y photograph [name]`.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise BadInput(f"--gcp {path}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"--gcp {path}: cannot be read as text; write it as OpenDroneMap's gcp_list.txt") from error
    rows = [(at, line.strip()) for at, line in enumerate(lines, 1) if line.strip() and not line.strip().startswith("#")]
    if not rows:
        raise BadInput(f"--gcp {path}: empty; its first line is a coordinate reference system, such as EPSG:32633")
    found: dict[str, GroundControlPoint] = {}
    for at, line in rows[1:]:
        words = line.split()
        try:
            x, y, z, across, down = (float(word) for word in words[:5])
            photo = words[5]
        except (ValueError, IndexError) as error:
            wanted = "x y z pixel_x pixel_y photograph [name]"
            raise BadInput(f"--gcp {path}: line {at} is {line[:60]!r}, not {wanted}") from error
        if not np.isfinite([x, y, z, across, down]).all():
            raise BadInput(f"--gcp {path}: line {at} has a number that is not finite")
        name = (
            words[6] if len(words) > 6 else next((p.name for p in found.values() if p.xyz == (x, y, z)), f"line {at}")
        )
        point = found.get(name, GroundControlPoint(name, (x, y, z), {}))
        if point.xyz != (x, y, z):
            raise BadInput(
                f"--gcp {path}: line {at} puts {name!r} elsewhere than a line before; one place for each name"
            )
        if point.marks.get(photo, (across, down)) != (across, down):
            before = " ".join(f"{value:g}" for value in point.marks[photo])
            raise BadInput(
                f"--gcp {path}: line {at} marks {name!r} in {photo!r} at {across:g} {down:g}, and a line before at "
                f"{before}; keep the right one, or give each point a name of its own"
            )
        found[name] = replace(point, marks={**point.marks, photo: (across, down)})
    return rows[0][1], list(found.values())


def read_ground(
    path: Path,
    wanted: str,
    sizes: Mapping[str, tuple[int, int]],
    held_back: int = 0,
    named: Sequence[str] = (),
) -> GroundControl:
    """The points of a list on their map.

    Args:
        path: The list.
        wanted: `--crs`, which only coordinates in degrees leave open.
        sizes: Width and height of each photograph that can be used, as stored, by its name.
        held_back: How many points are to be checkpoints.
        named: Names of points that are to be checkpoints.

    Raises:
        BadInput: The list cannot be used; says where.
    """
    crs, listed = read_list(path)
    if unknown := [name for name in named if name not in {point.name for point in listed}]:
        raise BadInput(
            f"--checkpoint-names: {few(unknown)} is not in --gcp {path}, whose points are "
            f"{few([point.name for point in listed], 12)}"
        )
    points = _marked(path, listed, sizes)
    enough = sum(len(point.marks) >= MIN_POINT_PHOTOS and point.name not in named for point in points)
    if enough < MIN_CONTROL_POINTS + held_back:
        also = f" besides {held_back} --checkpoints" if held_back else " besides --checkpoint-names" if named else ""
        raise BadInput(
            f"--gcp {path}: {enough} of its {len(points)} points are marked in {MIN_POINT_PHOTOS} or more "
            f"photographs of "
            f"the folder; {MIN_CONTROL_POINTS} are needed{also}"
        )
    xyz = np.array([point.xyz for point in points], np.float64)
    try:
        system = system_of(crs)
    except BadInput as error:
        raise BadInput(f"--gcp {path}: line 1: {error}") from error
    if system.degrees:
        if wrong := [point.name for point, (x, y, _) in zip(points, xyz, strict=True) if abs(x) > 180 or abs(y) > 90]:
            raise BadInput(
                f"--gcp {path}: {few(wrong)} is not in degrees, as line 1, {crs!r}, says; x is the longitude, y the "
                "latitude, or line 1 names another system, such as EPSG:32633"
            )
        positions = system.positions(xyz)
        if wanted == "auto" and system.lost_heights:
            emit(Warned(f"--gcp {path}: {system.lost_heights}"))
        chart = chart_of(positions, wanted)
        onto = to_chart(chart, positions)
        if not np.isfinite(onto).all():
            raise BadInput(f"--gcp {path}: some points are where {chart.crs} does not reach; x is the longitude")
        return GroundControl(points, chart, onto, crs)
    said, crs = crs, system.crs
    if wanted not in ("auto", crs):
        raise BadInput(f"--crs {wanted}: the list of --gcp is in {crs}, and the scene will be; leave --crs out")
    try:
        chart = chart_about(crs, np.median(xyz, axis=0))
    except BadInput as error:
        raise BadInput(f"--gcp {path}: {error} (line 1 names the system; x is east and y north in it)") from error
    return GroundControl(points, chart, xyz - chart.offset, said)


def _marked(
    path: Path, points: Sequence[GroundControlPoint], sizes: Mapping[str, tuple[int, int]]
) -> Sequence[GroundControlPoint]:
    """The points of a list with the full names of the photographs that show them, and without unknown ones."""
    folders: dict[str, list[str]] = {}
    for name in sizes:
        folders.setdefault(name.rpartition("/")[2], []).append(name)
    unknown: dict[str, None] = {}
    found = []
    for point in points:
        marks = {}
        for said, pixel in point.marks.items():
            names = [said] if said in sizes else folders.get(said, [])
            if not names:
                unknown[said] = None
                continue
            if len(names) > 1:
                raise BadInput(f"--gcp {path}: {said!r} may be {few(names)}; write the folder too")
            if not all(0 <= at <= size for at, size in zip(pixel, sizes[names[0]], strict=True)):
                width, height = sizes[names[0]]
                raise BadInput(
                    f"--gcp {path}: {point.name!r} is marked at {pixel[0]:g} {pixel[1]:g} in {said!r}, outside of its "
                    f"{width} x {height} pixels; they are counted from the upper left of the file as it is stored"
                )
            marks[names[0]] = pixel
        found.append(replace(point, marks=marks))
    if not any(point.marks for point in found):
        shown = f": {few(sorted(unknown))}" if unknown else ", as it has no points"
        raise BadInput(f"--gcp {path}: none of its photographs is in the folder{shown}; name those there")
    if unknown:
        emit(
            Warned(
                f"--gcp {path}: {len(unknown)} of its photographs are not in the folder, or cannot be used; their "
                f"marks are left out: {few(list(unknown))}"
            )
        )
    return found
