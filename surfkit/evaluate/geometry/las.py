"""Points of LAS, LAZ and E57 files: laser scans, and the clouds of `surfkit maps`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.memory import is_out_of_memory
from surfkit.core.optional import needed

CLOUDS = (".las", ".laz")
SCANS = (*CLOUDS, ".e57")
MAX_POINTS = 40_000_000
"""Points that are kept of a larger file: a gigabyte of positions."""
CHUNK_POINTS = 1_000_000
"""Points in memory besides."""
RECORDS = {"WktCoordinateSystemVlr", "GeoKeyDirectoryVlr"}
"""Of laspy, what a reference system is in."""
NOISE_CLASSES = (7, 18)
"""Low and high noise."""
COLOR_FIELDS = ("red", "green", "blue")


def read_e57(path: Path) -> np.ndarray:
    """(N, 3) float64 positions of all scans of an E57 file, in its own coordinates.

    Of more than MAX_POINTS every second, third and so on is taken.

    Raises:
        BadInput: pye57 is not installed, or the file is damaged or empty.
    """
    with needed("pye57", str(path)):
        import pye57
    try:
        file = pye57.E57(str(path))
        count = sum(file.get_header(at).point_count for at in range(file.scan_count))
        every, parts = max(1, -(-count // MAX_POINTS)), []
        for at in range(file.scan_count):
            scan = file.read_scan(at, ignore_missing_fields=True)
            parts.append(np.stack([scan[f"cartesian{axis}"][::every] for axis in "XYZ"], axis=1).astype(np.float64))
    except Exception as error:  # of libE57Format
        if is_out_of_memory(error):
            raise
        raise BadInput(f"{path}: cannot be read: {' '.join(str(error).split())}; write or copy it again") from error
    if not (found := np.concatenate(parts) if parts else np.zeros((0, 3))).size:
        raise BadInput(f"{path}: there are no points in it")
    _tell_fewer(path, len(found), count)
    return found


def read_las(path: Path, most: int = MAX_POINTS) -> tuple[np.ndarray, np.ndarray | None, dict[str, str]]:
    """(N, 3) float64 positions, (N, 3) uint8 colours, and what the file says of its coordinates, as PLY headers do.

    It is read in pieces. Of more than `most` points every second, third and so on is taken. Points that the file calls
    noise or withheld are none of the surface (LAS specification 1.4), and are left out, with a line. Colours are None
    where the file has none.

    Raises:
        BadInput: laspy is not installed, or the file is damaged or empty.
    """
    with _opened(path) as file:
        xyz, rgb, left = _points(file, most)
        notes, count = _notes(path, file.header), file.header.point_count
    if not len(xyz):
        raise BadInput(f"{path}: there are no points in it" + (f" but {left:,} of noise" if left else ""))
    if left:
        emit(Warned(f"{path}: {left:,} points are left out, which the file calls noise or withheld"))
    _tell_fewer(path, len(xyz) + left, count)
    return xyz, rgb, notes


def las_notes(path: Path) -> dict[str, str]:
    """What a LAS or LAZ file says of its coordinates, as PLY headers do.

    Raises:
        BadInput: laspy is not installed, or the file is damaged.
    """
    with _opened(path) as file:
        return _notes(path, file.header)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The open file, of laspy; BadInput for what is found wrong within."""
    with needed("laspy", str(path)):
        import laspy
    if path.suffix.lower() == ".laz":
        with needed("lazrs", str(path)):
            import lazrs  # noqa: F401 (what laspy reads it with)
    try:
        with laspy.open(path) as file:
            yield file
    except Exception as error:  # laspy and lazrs have errors of many kinds
        if is_out_of_memory(error):
            raise
        raise BadInput(f"{path}: cannot be read: {' '.join(str(error).split())}; write or copy it again") from error


def _tell_fewer(path: Path, used: int, count: int) -> None:
    if used < count:
        emit(Warned(f"{path}: {used:,} of {count:,} points are used"))


def _points(file: Any, most: int) -> tuple[np.ndarray, np.ndarray | None, int]:
    """Positions, colours if there are some, and how many points are left out as noise or withheld."""
    every, before, left, places, colors = max(1, -(-file.header.point_count // most)), 0, 0, [], []
    colored = set(COLOR_FIELDS) <= set(file.header.point_format.dimension_names)
    for chunk in file.chunk_iterator(CHUNK_POINTS):
        rows = np.arange(-before % every, len(chunk), every)
        before += len(chunk)
        wrong = np.isin(np.asarray(chunk.classification)[rows], NOISE_CLASSES) | np.asarray(chunk.withheld, bool)[rows]
        rows, left = rows[~wrong], left + int(wrong.sum())
        places.append(np.stack([np.asarray(chunk[axis])[rows] for axis in "xyz"], axis=1))
        if colored:
            colors.append(np.stack([np.asarray(chunk[name])[rows] for name in COLOR_FIELDS], axis=1))
    xyz = np.concatenate(places) if places else np.zeros((0, 3))
    rgb = np.concatenate(colors) if colors else np.zeros((0, 3), np.uint16)
    if not rgb.any():
        return xyz, None, left
    return xyz, (rgb >> 8 if rgb.max() > 255 else rgb).astype(np.uint8), left  # some programs write 8 bits


def _notes(path: Path, header: Any) -> dict[str, str]:
    """Reference system in plan, its unit, and the system with what heights are above, where the header has a projected
    one, as well-known text or as keys of GeoTIFF."""
    if not {type(vlr).__name__ for vlr in (*header.vlrs, *(header.evlrs or ()))} & RECORDS:
        return {}
    try:
        found = header.parse_crs()
        if found is None:
            raise BadInput("it is empty, or of no number of EPSG")
        flat = found.sub_crs_list[0] if found.is_compound else found
        number, unit = flat.to_epsg(), flat.axis_info[0].unit_conversion_factor if flat.axis_info else 1.0
    except Exception as error:  # what pyproj does not know
        emit(Warned(f"{path}: coordinates are used without their reference system: {' '.join(str(error).split())}"))
        return {}
    if not (number and flat.is_projected):
        return {}
    return {"crs": f"EPSG:{number}", "metres per unit": f"{unit:.15g}", "system": _with_heights(found, number)}


def _with_heights(crs: Any, number: int) -> str:
    """A system of pyproj as text: by its numbers of EPSG where heights have one, and by well-known text otherwise."""
    if len(crs.axis_info) < 3:
        return f"EPSG:{number}"
    heights = crs.sub_crs_list[1].to_epsg() if crs.is_compound else None
    return f"EPSG:{number}+{heights}" if heights else crs.to_wkt()
