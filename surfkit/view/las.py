"""Points of LAS and LAZ files, such as those of `surfkit maps`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.memory import is_out_of_memory
from surfkit.core.optional import needed
from surfkit.view.display import by_height, height_bounds

CLOUDS = (".las", ".laz")
MOST = 10_000_000
"""Points that are kept; a click looks among these."""
AT_ONCE = 1_000_000
"""Points in memory besides."""
RECORDS = {"WktCoordinateSystemVlr", "GeoKeyDirectoryVlr"}
"""Of laspy, what a reference system is in."""
COLORS = ("red", "green", "blue")


def read_las(path: Path) -> tuple[np.ndarray, np.ndarray, dict[str, str]]:
    """(N, 3) float64 positions, (N, 3) uint8 colours, and what the file says of its coordinates, as PLY headers do.

    Of more than MOST points every second, third and so on is taken. Points without colours have those of their heights.

    Raises:
        BadInput: laspy is not installed, or the file is damaged or empty.
    """
    with needed("laspy", str(path)):
        import laspy
    if path.suffix.lower() == ".laz":
        with needed("lazrs", str(path)):
            import lazrs  # noqa: F401 (what laspy reads it with)
    try:
        with laspy.open(path) as file:
            xyz, rgb = _points(file)
            notes = _notes(path, file.header)
    except Exception as error:  # laspy and lazrs have errors of many kinds
        if is_out_of_memory(error):
            raise
        raise BadInput(f"{path}: cannot be read: {' '.join(str(error).split())}; write or copy it again") from error
    if not len(xyz):
        raise BadInput(f"{path}: there are no points in it")
    if len(xyz) < file.header.point_count:
        emit(Warned(f"{path}: {len(xyz):,} of {file.header.point_count:,} points are shown"))
    return xyz, by_height(xyz[:, 2], height_bounds(xyz[:, 2])) if rgb is None else rgb, notes


def _points(file: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions, and colours if there are some."""
    every, before, places, colors = max(1, -(-file.header.point_count // MOST)), 0, [], []
    colored = set(COLORS) <= set(file.header.point_format.dimension_names)
    for chunk in file.chunk_iterator(AT_ONCE):
        rows = slice(-before % every, None, every)
        before += len(chunk)
        places.append(np.stack([np.asarray(chunk[axis])[rows] for axis in "xyz"], axis=1))
        if colored:
            colors.append(np.stack([np.asarray(chunk[name])[rows] for name in COLORS], axis=1))
    xyz = np.concatenate(places) if places else np.zeros((0, 3))
    rgb = np.concatenate(colors) if colors else np.zeros((0, 3), np.uint16)
    if not rgb.any():
        return xyz, None
    return xyz, (rgb >> 8 if rgb.max() > 255 else rgb).astype(np.uint8)  # some programs write 8 bits


def _notes(path: Path, header: Any) -> dict[str, str]:
    """Reference system and unit, where the header has a projected one, as well-known text or as keys of GeoTIFF."""
    if not {type(vlr).__name__ for vlr in (*header.vlrs, *(header.evlrs or ()))} & RECORDS:
        return {}
    try:
        with needed("pyproj", "the reference system"):
            import pyproj  # noqa: F401 (what laspy reads it with)
        found = header.parse_crs()
        if found is None:
            raise BadInput("it is empty, or of no number of EPSG")
        flat = found.sub_crs_list[0] if found.is_compound else found
        number, unit = flat.to_epsg(), flat.axis_info[0].unit_conversion_factor if flat.axis_info else 1.0
    except Exception as error:  # no pyproj, or what it does not know
        emit(Warned(f"{path}: coordinates are shown without their reference system: {' '.join(str(error).split())}"))
        return {}
    return {"crs": f"EPSG:{number}", "metres per unit": f"{unit:.15g}"} if number and flat.is_projected else {}
