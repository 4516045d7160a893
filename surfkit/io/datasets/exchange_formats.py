"""What readers of formats for exchange share: paths of another machine, and coordinate reference systems."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath
from urllib.parse import unquote

from pyproj import CRS

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.camera_files import numbers
from surfkit.scene.crs import axes_of, code_in, from_wkt, in_plan, metres_of

UNIT_PATTERN = re.compile(r"UNIT\s*\[", re.IGNORECASE)
"""A unit in well-known text; where there is none, pyproj takes metres."""


def photo_names(paths: Sequence[str]) -> list[str]:
    """Names of photographs by their paths or file URLs on any machine.

    They are the last part where that differs, and what follows the folders that all have otherwise.
    """
    split = []
    for path in paths:
        path = unquote(path.removeprefix("file:")) if path.startswith("file:") else path
        split.append([part for part in path.replace("\\", "/").split("/") if part not in ("", ".")] or [""])
    last = [parts[-1] for parts in split]
    if len(set(last)) == len(last):
        return last
    common = 0
    while all(len(parts) > common + 1 and parts[common] == split[0][common] for parts in split):
        common += 1
    return [str(PurePosixPath(*parts[common:])) for parts in split]


def map_system(where: str, text: str) -> tuple[str | None, float | None]:
    """The coordinate reference system of a definition, and metres per unit of it.

    Raises:
        BadInput: It is none, in degrees, in which a rotation says nothing, or about the Earth's centre.
    """
    degrees = f"{where} is in degrees; export in a projected or a local coordinate system"
    if text.startswith("ENU:"):
        origin = text.removeprefix("ENU:").split(",")
        latitude, longitude, height = numbers(where, [*origin, "0"][:3], 3).tolist()
        return f"+proj=topocentric +ellps=WGS84 +lat_0={latitude!r} +lon_0={longitude!r} +h_0={height!r}", 1.0
    if text.upper().startswith("EPSG:"):
        flat, _, up = text.upper().replace(" ", "").partition("+")
        if up:
            _tell_heights(where, up, flat)
        try:
            return flat, axes_of(flat).metres
        except BadInput as error:
            raise BadInput(f"{where}: {error}; or export in local coordinates") from error
    if "[" in text:
        whole = from_wkt(where, text)
        given = in_plan(whole)
        if given.is_projected:
            return code_in_plan(where, whole) or text, metres_of(given)
        if not given.is_engineering:
            raise BadInput(degrees)
        return None, metres_of(given) if UNIT_PATTERN.search(text) else None
    if text.upper().replace(" ", "") in ("WGS84", "WGS1984"):
        raise BadInput(degrees)
    if "local" not in text.lower():
        emit(Warned(f"{where} is not understood: coordinates are those of the file"))
    return None, None


def code_in_plan(where: str, crs: CRS) -> str | None:
    """The code that the text of a system has for easting and northing; None where it has none. A line says that what is
    written leaves out what heights are above, where the text says that."""
    flat = in_plan(crs)
    code = code_in(flat)
    if code is not None and crs.is_compound:
        _tell_heights(where, repr(crs.sub_crs_list[1].name), code)
    return code


def _tell_heights(where: str, up: str, flat: str) -> None:
    emit(Warned(f"{where}: heights are those of {up}; what is written names {flat} alone"))
