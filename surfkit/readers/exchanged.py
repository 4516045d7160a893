"""What readers of formats for exchange share: paths of another machine, and coordinate reference systems."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath
from urllib.parse import unquote

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.readers.camera_files import numbers
from surfkit.readers.geocentric import LOCAL, PROJECTED
from surfkit.readers.wkt import Node, parse_wkt
from surfkit.scene.crs import axes_of

LENGTH = ("UNIT", "LENGTHUNIT")


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
        BadInput: It is in degrees, in which a rotation says nothing, or about the Earth's centre.
    """
    degrees = f"{where} is in degrees; export in a projected or a local coordinate system"
    if text.startswith("ENU:"):
        origin = text.removeprefix("ENU:").split(",")
        latitude, longitude, height = numbers(where, [*origin, "0"][:3], 3).tolist()
        return f"+proj=topocentric +ellps=WGS84 +lat_0={latitude!r} +lon_0={longitude!r} +h_0={height!r}", 1.0
    if text.upper().startswith("EPSG:"):
        flat, _, up = text.upper().replace(" ", "").partition("+")
        if up:
            emit(Warned(f"{where}: heights are those of {up}; what is written names {flat} alone"))
        try:
            return flat, axes_of(flat).metres
        except BadInput as error:
            raise BadInput(f"{where}: {error}; or export in local coordinates") from error
    if "[" in text:
        node = parse_wkt(where, text)
        flat_node = node if node.keyword in PROJECTED else node.child(*PROJECTED)
        if flat_node is not None:
            return flat_node.code or text, _metres(flat_node)
        if node.keyword not in (*LOCAL, "ENGINEERINGCRS"):
            raise BadInput(degrees)
        return None, _metres(node)
    if text.upper().replace(" ", "") in ("WGS84", "WGS1984"):
        raise BadInput(degrees)
    if "local" not in text.lower():
        emit(Warned(f"{where} is not understood: coordinates are those of the file"))
    return None, None


def _metres(node: Node) -> float | None:
    """Metres per unit of a system, from its text; None where that does not say."""
    axis = node.child("AXIS")
    unit = node.child(*LENGTH) or (axis.child(*LENGTH) if axis is not None else None)
    metres = unit.number(1) if unit is not None else None
    return metres if metres and 0 < metres < 1e6 else None
