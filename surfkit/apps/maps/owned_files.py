"""Which files in a folder are maps that surfkit drew: nothing else is replaced."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput, few
from surfkit.core.codec import read_json, write_json
from surfkit.core.stages import UNFINISHED_FILE, delete_parts

PRODUCT_FILES = {
    "dsm": "dsm.tif", "orthophoto": "orthophoto.tif", "sources": "orthophoto-photographs.tif",
    "hillshade": "hillshade.tif", "contours": "contours.gpkg",
    "points": "points.copc.laz", "precision": "precision.tif", "rays": "rays.tif",
    "terrain": "dtm.tif", "above": "ndsm.tif", "ground": "ground-distance.tif",
    "terrain-contours": "contours-terrain.gpkg",
    "other": "dsm-other.tif", "difference": "difference.tif", "picture": "difference.png",
    "volumes": "volumes.gpkg", "volumes-table": "volumes.csv", "volumes-types": "volumes.csvt",
}  # fmt: skip
FORMER_FILES = {"points.laz"}
"""Files that earlier versions wrote; they are replaced with the rest."""
MAPS_RECORD = "maps.json"
"""What the maps are; written last, so maps without it are not whole."""
UNFINISHED_FOLDER = "unfinished"
"""Folder for what is finished of maps, in theirs."""
NAMES_FILE = "names.json"
"""In that folder: which files in theirs are ours."""


def own_files(out: Path) -> set[str]:
    """Names of the files in a folder that earlier calls wrote: whole maps, or what an interrupted one finished."""
    known, found = {*PRODUCT_FILES.values(), *FORMER_FILES}, set()
    record = _read(out / MAPS_RECORD)
    if "gsd" in record and isinstance(record.get("files"), list):
        found = {MAPS_RECORD, *(known & {*map(str, record["files"])})}
    if (out / UNFINISHED_FOLDER / UNFINISHED_FILE).is_file():  # versions before this one kept no names
        found |= known & {*_read(out / UNFINISHED_FOLDER / NAMES_FILE).get("names", known)}
    return found


def keep_names(out: Path, names: Iterable[str]) -> None:
    """Note in the folder for unfinished maps which files are ours."""
    write_json(out / UNFINISHED_FOLDER / NAMES_FILE, {"names": sorted({*names} - {MAPS_RECORD})})


def claim(out: Path, name: str) -> None:
    """Note that a file that will be there soon is ours too."""
    keep_names(out, {*own_files(out), name})


def forget_unfinished(out: Path) -> None:
    """Delete what is finished of maps that will not be whole."""
    if not (out / MAPS_RECORD).exists():
        for name in own_files(out):
            (out / name).unlink(missing_ok=True)
    delete_parts(out / UNFINISHED_FOLDER)


def refuse_foreign(out: Path, names: Iterable[str]) -> None:
    """OSError if files of some names are there, and are not ours: they would be replaced."""
    own = own_files(out)
    if foreign := [name for name in names if os.path.lexists(out / name) and name not in own]:
        told = f"has files that surfkit did not write, which the maps would replace: {few(foreign)}"
        raise OSError(errno.ENOTEMPTY, f"{told}; name another folder, or move them", str(out))


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_json(path, dict[str, Any])
    except BadInput:  # there is none, or it is of somebody else
        return {}
