"""Names of photographs: files that are called otherwise than their data set says, and names as paths of other files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from surfkit.core.events import Warned, emit

T = TypeVar("T")
HEIF_SUFFIXES = frozenset({".heic", ".heif"})
"""Photographs of telephones, that Pillow reads with pillow-heif only."""
PICTURE_SUFFIXES = (
    frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".jp2", ".ppm", ".exr"}) | HEIF_SUFFIXES
)
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm"})
"""Videos that frames can be taken of."""
SPELLINGS: tuple[Callable[[PurePosixPath], str], ...] = (
    lambda path: str(path).lower(),
    lambda path: str(path).removesuffix(path.suffix).lower(),
    lambda path: path.name.lower(),
    lambda path: path.stem.lower(),
)
"""What of a name must agree: all but the case, nor the ending, nor the folders."""
OUTSIDE = "_outside"
"""Folder for files named after photographs whose own names lead elsewhere."""


def named_file(folder: Path, name: str) -> Path:
    """The file below a folder that a data set names; a backslash is a slash, as on Windows, unless a file has it."""
    path = folder / name
    return path if "\\" not in name or path.is_file() else folder / name.replace("\\", "/")


def name_below(root: Path, path: Path) -> str:
    """What a photograph of a data set is called: its path from there, without the `..` of what lies beside it."""
    return "/".join(part for part in Path(os.path.relpath(path, root)).parts if part != "..")


def safe_path(name: str) -> PurePosixPath:
    """A relative path, below whatever folder it is joined to, for a file that is named after a photograph.

    Names of photographs come from files of others. A usual one, such as left/a.jpg, is its own path; a backslash is a
    slash, as in `find_files`. One with `..`, `.` or an empty part, or from the root of a disk, gets a folder of its own
    in `_outside/`, so that two names never share a path.
    """
    parts = name.replace("\\", "/").split("/")
    if not any(part in ("", ".", "..") for part in parts) and parts[0][1:2] != ":":
        return PurePosixPath(*parts)
    own = hashlib.blake2b(name.encode(errors="surrogateescape"), digest_size=8).hexdigest()
    last = next((part for part in reversed(parts) if part not in ("", ".", "..")), "photograph")
    return PurePosixPath(OUTSIDE, own, last.replace(":", "_"))


def is_video(path: Path) -> bool:
    """Whether a path is that of a video, by its ending."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def find_files(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """The file of each name that has one, by name; one note lists all that are spelt otherwise.

    Another spelling counts when it fits one file only and no other name. A name without an ending is no other spelling.
    """
    found = {name: path for name in names if (path := named_file(folder, name)).is_file()}
    lost = [name for name in names if name not in found]
    if not lost:
        return found
    taken = set(found.values())
    spare = [
        p for p in sorted(folder.rglob("*")) if p.suffix.lower() in PICTURE_SUFFIXES and p not in taken and p.is_file()
    ]
    for spelling in SPELLINGS:
        files = _groups({path: spelling(PurePosixPath(path.relative_to(folder).as_posix())) for path in spare})
        wanted = _groups({name: spelling(PurePosixPath(name.replace("\\", "/"))) for name in lost})
        pairs = {same[0]: files[key][0] for key, same in wanted.items() if len(same) == 1 == len(files.get(key, ()))}
        found |= pairs
        used = set(pairs.values())
        lost = [name for name in lost if name not in pairs]
        spare = [path for path in spare if path not in used]
    otherwise = {name: path for name, path in found.items() if path not in taken}
    _warn(folder, {name: path for name, path in otherwise.items() if path != folder / f"{name}{path.suffix}"})
    return found


def _groups(keys: Mapping[T, str]) -> dict[str, list[T]]:
    groups: dict[str, list[T]] = {}
    for item, key in keys.items():
        groups.setdefault(key, []).append(item)
    return groups


def _warn(folder: Path, otherwise: dict[str, Path]) -> None:
    if otherwise:
        name, path = next(iter(otherwise.items()))
        there = path.relative_to(folder).as_posix()
        emit(
            Warned(f"{len(otherwise)} photographs in {folder} are spelt otherwise in the model: {there} is {name}, say")
        )
