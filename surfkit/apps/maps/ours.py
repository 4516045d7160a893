"""Which files in a folder are maps that surfkit drew: nothing else is replaced."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput, few
from surfkit.core.codec import read_json, write_json
from surfkit.core.stages import KEY, delete_parts

FILES = {
    "dsm": "dsm.tif", "orthophoto": "orthophoto.tif", "hillshade": "hillshade.tif", "contours": "contours.gpkg",
    "points": "points.laz", "other": "dsm-other.tif", "difference": "difference.tif", "picture": "difference.png",
}  # fmt: skip
RECORD = "maps.json"
"""What the maps are; written last, so maps without it are not whole."""
WORK = "unfinished"
"""Folder for what is finished of maps, in theirs."""
NAMES = "names.json"
"""In that folder: which files in theirs are ours."""


def own_files(out: Path) -> set[str]:
    """Names of the files in a folder that earlier calls wrote: whole maps, or what an interrupted one finished."""
    known, found = {*FILES.values()}, set()
    record = _read(out / RECORD)
    if "gsd" in record and isinstance(record.get("files"), list):
        found = {RECORD, *(known & {*map(str, record["files"])})}
    if (out / WORK / KEY).is_file():  # versions before this one kept no names
        found |= known & {*_read(out / WORK / NAMES).get("names", known)}
    return found


def keep_names(out: Path, names: Iterable[str]) -> None:
    """Note in the folder for unfinished maps which files are ours."""
    write_json(out / WORK / NAMES, {"names": sorted({*names} - {RECORD})})


def claim(out: Path, name: str) -> None:
    """Note that a file that will be there soon is ours too."""
    keep_names(out, {*own_files(out), name})


def forget_unfinished(out: Path) -> None:
    """Delete what is finished of maps that will not be whole."""
    if not (out / RECORD).exists():
        for name in own_files(out):
            (out / name).unlink(missing_ok=True)
    delete_parts(out / WORK)


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
