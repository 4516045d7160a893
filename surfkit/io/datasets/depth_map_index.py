"""Depth maps that runs have made: in the user's cache, as data sets may be read-only."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from surfkit.core.caches import cache_root
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.io.datasets.depth_files import DEPTH_FOLDER

MADE_MAPS_FOLDER = "depth"
"""Of the folder in the cache; one folder in it for each data set, estimator and way to read the data set."""
MADE_MAPS_RECORD = "made.json"


@dataclass(frozen=True)
class DepthMapIndex:
    """What is known of the maps in a folder.

    Attributes:
        maps: How many there are.
        cpu_seconds: CPU time that making them has taken so far.
        without: Names of the photographs of which none could be made.
        unread: Names of those of them that the system could not read then, and that may be whole.
    """

    maps: int = 0
    cpu_seconds: float = 0.0
    without: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()


def folder_of(key: str) -> Path:
    """The folder of maps in the cache, whose estimated_depths/ has the layout of that of a data set."""
    return cache_root() / MADE_MAPS_FOLDER / key


def read_made(folder: Path) -> DepthMapIndex:
    """What is known of the maps in a folder; nothing where there are none, or the file that tells it is damaged."""
    path = folder / MADE_MAPS_RECORD
    with suppress(BadInput):
        return read_json(path, DepthMapIndex) if path.exists() else DepthMapIndex()
    return DepthMapIndex()


def write_made(folder: Path, made: DepthMapIndex) -> None:
    """Write down what is known of them."""
    write_json(folder / MADE_MAPS_RECORD, made)


def is_there(folder: Path) -> bool:
    """Whether maps that a run was given can be found, in this cache or where they were then."""
    return any((place / DEPTH_FOLDER).is_dir() for place in (folder, folder_of(folder.name)))


def located(folder: Path) -> Path:
    """Where the maps of a folder are: there, or, on a machine whose cache lies elsewhere, in its own cache.

    Raises:
        BadInput: They are in neither.
    """
    if not is_there(folder):
        raise BadInput(
            f"the depth maps that were made for the run are neither in {folder} nor in {folder_of(folder.name)}; give "
            "its surfkit train command again, or, on another machine, set SURFKIT_CACHE to a folder that both see"
        )
    return folder if (folder / DEPTH_FOLDER).is_dir() else folder_of(folder.name)
