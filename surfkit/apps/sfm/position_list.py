"""Positions of photographs from a file: geo.txt of OpenDroneMap, or a table such as Metashape and Pix4D write."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.apps.sfm.exif import MAX_ERROR_M, Position
from surfkit.core.check import BadInput, few
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.crs_names import WGS84_DEGREES, System, names_a_system, system_of
from surfkit.scene.crs import known_axes

COLUMN_NAMES = {
    "name": "name label image imagename imagefile photo photograph photoname file filename sourcefile camera "
    "cameraname picture",
    "x": "x xlongitude xeast xeasting easting east e longitude lon long lng gpslongitude geox",
    "y": "y ylatitude ynorth ynorthing northing north n latitude lat gpslatitude geoy",
    "z": "z zaltitude zheight altitude alt height elevation elev h up gpsaltitude ellipsoidalheight geoz",
    "crs": "crs epsg srs coordinatesystem projection",
    "enabled": "enable enabled",
    "sx": "sx sigmax stdx sde sdeast stdeast xaccuracy accuracyx xacc sdlon stdlon",
    "sy": "sy sigmay stdy sdn sdnorth stdnorth yaccuracy accuracyy yacc sdlat stdlat",
    "sxy": "sxy sigmaxy accuracyhorz horzaccuracy horizontalaccuracy accuracyhorizontal hacc xyaccuracy accuracyxy "
    "gpsxyaccuracy",
    "sz": "sz sigmaz stdz sdu sdup stdup zaccuracy accuracyz zacc accuracyvert vertaccuracy verticalaccuracy "
    "accuracyvertical vacc gpszaccuracy sdheight stdheight",
}
"""Names of the columns that are used, in small letters without blanks, units and marks."""
MEANINGS = {name: column for column, names in COLUMN_NAMES.items() for name in names.split()}
GEO_TXT_COLUMNS = ("name", "x", "y", "z", "yaw", "pitch", "roll", "sxy", "sz")
"""Columns of geo.txt, and of a table without a header."""
SWITCHES = {**dict.fromkeys(("1", "true", "yes", ""), True), **dict.fromkeys(("0", "false", "no"), False)}
"""Whether a position is to be used, by what the column of Metashape that says so has, in small letters."""
DEGREE_NAMES = {"longitude", "xlongitude", "lon", "long", "lng", "gpslongitude"}
"""Names of x that say degrees."""
UNIT_METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "usft", "ftus", "ussurveyfoot", "ussurveyfeet"), 0.3048),
}
"""Metres per unit that a name of a column of heights or accuracies may state, as `Altitude [ft]`; feet of both kinds
differ by 1 mm in 500 m."""
ACCURACY_COLUMNS = ("sx", "sy", "sxy", "sz")
STATED_UNIT = re.compile(r"[\[(]([^\])]*)[\])]")
"""What stands in brackets in the name of a column."""
COMMENT = re.compile(r"#\s*(?:CoordinateSystem\s*:\s*)?(.*)", re.IGNORECASE)
"""A line that Metashape or a person begins with #; it may name the system, or the columns."""
CELL_SEPARATORS = "\t;,"
"""What may stand between cells; blanks otherwise."""
DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+")
WANTED = "name, x (east or longitude), y (north or latitude) and z, such as `DJI_0001.JPG,372345.1,5846123.4,120.5`"


@dataclass(frozen=True)
class PositionRow:
    """A line of the file.

    Attributes:
        at: Number of the line, from 1.
        cells: By column.
    """

    at: int
    cells: Mapping[str, str]


@dataclass(frozen=True)
class Listed:
    """Positions that a file gives.

    Attributes:
        positions: By the name of the photograph, as the file has it; None where it is disabled there.
        accuracies: Standard deviations east, north and up, metres, of those for which it gives them.
        systems: Of its coordinates.
    """

    positions: Mapping[str, Position | None]
    accuracies: Mapping[str, tuple[float, float, float]]
    systems: Sequence[System]

    @property
    def crs(self) -> str | None:
        """The map that its coordinates are on; None if they are in degrees or on several."""
        return self.systems[0].crs if len(self.systems) == 1 and not self.systems[0].degrees else None

    @property
    def named(self) -> str:
        """Its systems, for messages."""
        return " and ".join(system.crs if len(system.crs) <= 60 else f"{system.crs[:60]}..." for system in self.systems)


def read_list(path: Path, said: str, crs: str | None = None) -> Listed:
    """The positions in a file.

    Args:
        path: The file.
        said: What messages call it.
        crs: Its coordinate reference system, if it names none.

    Raises:
        BadInput: It cannot be read; says which line.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except FileNotFoundError as error:
        raise BadInput(f"{said}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{said}: cannot be read as text of UTF-8") from error
    table = _table(lines, said)
    named, rows = table.system, table.rows
    own = named or next((row.cells["crs"] for row in rows if row.cells.get("crs")), None)
    if own is not None and crs is not None:
        raise BadInput(f"{said}: it names its system itself, {own[:60]!r}; leave --positions-crs out")
    given = crs if crs is not None else named
    if given is None and table.degrees:
        given = WGS84_DEGREES
    found: dict[str, tuple[PositionRow, System, list[float | None]]] = {}
    systems: dict[str, System] = {}
    for row in rows:
        text = row.cells.get("crs") or given
        if text is None:
            raise BadInput(
                f"{said}: it names no coordinate reference system; write one into its first line, such as EPSG:32633, "
                "or name one with --positions-crs"
            )
        if text not in systems:
            where = f"{said}: line {row.at}" if row.cells.get("crs") else said if crs is None else "--positions-crs"
            systems[text] = _system(f"EPSG:{text}" if text.isdigit() else text, where)
        numbers = [_number(row.cells.get(axis), said, row, axis == "z") for axis in "xyz"]
        if "z" in table.metres and numbers[2] is not None:
            numbers[2] *= table.metres["z"] / systems[text].height_metres
        name = row.cells["name"]
        if name in found and found[name][2] != numbers:
            raise BadInput(f"{said}: lines {found[name][0].at} and {row.at} give two positions for {name!r}; keep one")
        found[name] = (row, systems[text], numbers)
    if not found:
        raise BadInput(f"{said}: no positions; each line is {WANTED}")
    if "z" not in table.metres and any(numbers[2] is not None for _, _, numbers in found.values()):
        _tell_unit(systems.values(), said)
    positions = _positions(found, said)
    accuracies = {
        name: sigma for name in positions if (sigma := _accuracy(found[name][0], said, table.metres)) is not None
    }
    if accuracies and not table.metres.keys() & set(ACCURACY_COLUMNS):
        _tell_unit_of_accuracies(systems.values(), said)
    return Listed({**dict.fromkeys(table.disabled), **positions}, accuracies, list(dict.fromkeys(systems.values())))


def _tell_unit(systems: Iterable[System], said: str) -> None:
    """Say that heights are taken in another unit than metres where neither the list nor its system says so."""
    for system in systems:
        axes = None if system.degrees else known_axes(system.crs)
        if axes is not None and axes.height_metres is None and axes.metres != 1:
            emit(
                Warned(
                    f"{said}: {system.crs} has no heights of its own, so those of the list are taken in its unit, "
                    f"{axes.unit}; where they are in metres, name the column of heights 'z [m]'"
                )
            )


def _tell_unit_of_accuracies(systems: Iterable[System], said: str) -> None:
    """Say that accuracies are taken in metres where coordinates are in another unit and no column states one."""
    for system in systems:
        axes = None if system.degrees else known_axes(system.crs)
        if axes is not None and axes.metres != 1:
            emit(
                Warned(
                    f"{said}: accuracies are taken in metres, though {system.crs} is in {axes.unit}; where they are in "
                    "feet, name their columns 'sxy [ft]' and 'sz [ft]'"
                )
            )


def _system(text: str, where: str) -> System:
    try:
        return system_of(text)
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from error


@dataclass(frozen=True)
class PositionTable:
    """The lines of a file.

    Attributes:
        system: That a line before the positions names.
        rows: One for each photograph with a position.
        degrees: Whether names of columns say degrees.
        metres: Metres per unit of heights and accuracies, by column, where its name states a unit.
        disabled: Names of photographs whose position is not to be used.
    """

    system: str | None
    rows: Sequence[PositionRow]
    degrees: bool
    metres: Mapping[str, float]
    disabled: Sequence[str]


def _table(lines: Sequence[str], said: str) -> PositionTable:
    """What the lines of a file say."""
    system, header, degrees = None, None, False
    metres: dict[str, float] = {}
    rows: list[PositionRow] = []
    disabled: list[str] = []
    for at, line in enumerate(lines, 1):
        text = line.strip()
        comment = COMMENT.fullmatch(text)
        plain = comment[1] if comment else text
        if not plain:
            continue
        if not rows and system is None and names_a_system(plain):
            system = plain
            continue
        if not rows and header is None and (columns := _header(plain)) is not None:
            header, degrees = columns, any(_small(cell) in DEGREE_NAMES for cell in _split(plain))
            metres = _stated_metres(plain, columns)
            continue
        if comment:
            continue
        cells = _split(text) if header is not None else _joined(_split(text))
        first = not rows and system is None and header is None
        if (
            first
            and not any(mark in text for mark in CELL_SEPARATORS)
            and not (len(cells) > 2 and _is_number(cells[1]))
        ):
            system = text  # by a name that pyproj may know
            continue
        row = PositionRow(at, dict(zip(header or _plain(cells), (cell.strip() for cell in cells), strict=False)))
        if header is not None and not (row.cells.get("x") or row.cells.get("y")):
            continue  # a photograph without a position, as Metashape lists them
        if not row.cells.get("name"):
            raise BadInput(f"{said}: line {at} is {text[:60]!r}, not {WANTED}")
        if _is_enabled(row, said):
            rows.append(row)
        else:
            disabled.append(row.cells["name"])
    if disabled and not rows:
        raise BadInput(f"{said}: its column of enabled positions has all of them disabled; enable those to be used")
    if disabled:
        emit(Warned(f"{said}: positions of {len(disabled)} photographs are disabled, and not used: {few(disabled)}"))
    return PositionTable(system, rows, degrees, metres, disabled)


def _is_enabled(row: PositionRow, said: str) -> bool:
    """Whether the position is to be used, as far as a column says so."""
    text = row.cells.get("enabled", "")
    if text.lower() not in SWITCHES:
        raise BadInput(f"{said}: line {row.at} has {text[:20]!r} for whether it is enabled; write 1 or 0")
    return SWITCHES[text.lower()]


def _plain(cells: Sequence[str]) -> list[str]:
    """The meaning of each cell of a line without names of columns; the last may be a system."""
    named = len(cells) > 3 and names_a_system(cells[-1])
    return [*GEO_TXT_COLUMNS[: len(cells) - named], *["crs"] * named]


def _header(text: str) -> list[str] | None:
    """The meaning of each column, "" for one that is not used; None where the line has no names of columns."""
    found: list[str] = []
    for cell in _split(text):
        column = MEANINGS.get(_small(cell), "")
        found.append("" if column in found else column)
    return found if {"name", "x", "y"} <= set(found) else None


def _stated_metres(text: str, columns: Sequence[str]) -> dict[str, float]:
    """Metres per unit that a line of names of columns states, of heights and accuracies."""
    found = {}
    for cell, column in zip(_split(text), columns, strict=True):
        stated = STATED_UNIT.search(cell) if column in ("z", *ACCURACY_COLUMNS) else None
        unit = UNIT_METRES.get(re.sub(r"[^a-z]", "", stated[1].lower())) if stated else None
        if unit is not None:
            found[column] = unit
    return found


def _small(cell: str) -> str:
    """The name of a column without what does not matter: `X [m]` and `x_(m)` are x."""
    return re.sub(r"[\[(][^\])]*[\])]|[^a-z]", "", cell.lower())


def _split(text: str) -> list[str]:
    """The cells of a line."""
    mark = next((mark for mark in CELL_SEPARATORS if text.count(mark) >= 2), None)
    if mark is None:
        return text.split()
    cells = next(csv.reader([text], delimiter=mark, skipinitialspace=True))
    return cells if mark == "," else [_with_point(cell.strip()) for cell in cells]


def _with_point(cell: str) -> str:
    return cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell) else cell


def _joined(cells: Sequence[str]) -> list[str]:
    """The cells of a line without names of columns, where blanks in the name of the photograph may have cut it."""
    at = next((at for at in range(1, len(cells) - 1) if _is_number(cells[at]) and _is_number(cells[at + 1])), 1)
    return [" ".join(cells[:at]), *cells[at:]]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _number(text: str | None, said: str, row: PositionRow, optional: bool = False) -> float | None:
    """A finite number; None for one that may be missing, and is."""
    if optional and (text or "").lower() in ("", "-", "nan", "none", "null"):
        return None
    try:
        found = float(text or "")
    except ValueError:
        found = float("nan")
    if not np.isfinite(found):
        shown = " ".join(row.cells.values())
        raise BadInput(f"{said}: line {row.at} is {shown[:60]!r}, not {WANTED}")
    return found


def _positions(found: Mapping[str, tuple[PositionRow, System, list[float | None]]], said: str) -> dict[str, Position]:
    """Latitudes, longitudes and altitudes, all of a system at once."""
    positions: dict[str, Position] = {}
    for system in {system for _, system, _ in found.values()}:
        names = [name for name, (_, other, _) in found.items() if other == system]
        xyz = np.array([found[name][2] for name in names], np.float64)
        wrong = [name for name, (x, y, _) in zip(names, xyz, strict=True) if abs(x) > 180 or abs(y) > 90]
        if system.degrees and wrong:
            raise BadInput(
                f"{said}: {few(wrong)} is not in degrees, as {system.crs} says; x is the longitude and y the latitude"
            )
        rows = system.positions(xyz)
        good = np.isfinite(rows[:, :2]).all(1) & rows[:, :2].any(1)
        if not good.any():
            raise BadInput(f"{said}: all positions are where {system.crs} does not reach; x is east and y north")
        if lost := [name for name, reached in zip(names, good, strict=True) if not reached]:
            emit(Warned(f"{said}: {len(lost)} positions are no place in {system.crs}, and are left out: {few(lost)}"))
        for name, (latitude, longitude, height), reached in zip(names, rows.tolist(), good, strict=True):
            if reached:
                positions[name] = (latitude, longitude, height if np.isfinite(height) else None)
    return positions


def _accuracy(row: PositionRow, said: str, metres: Mapping[str, float]) -> tuple[float, float, float] | None:
    """Standard deviations, metres, if the row gives them across and up."""
    columns = ["sx" if row.cells.get("sx") else "sxy", "sy" if row.cells.get("sy") else "sxy", "sz"]
    cells = [(row.cells.get(column), metres.get(column, 1.0)) for column in columns]
    found = tuple((_number(text, said, row) or 0.0) * unit for text, unit in cells if text and _is_number(text))
    return found if len(found) == 3 and all(0 < value < MAX_ERROR_M for value in found) else None
