"""A folder of finished stages, each under the hash of what determines it, that runs take instead of computing them."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import Warned, emit
from surfkit.core.files import DISK_FULL, being_written, remove, sweep, sync_folder
from surfkit.runs import journal

ENTRY_RECORD = "entry.json"
"""In the folder of an entry, what is in it; written last, before the folder gets its name."""

READ_BYTES = 1 << 20
"""Bytes that are read at a time."""


@dataclass(frozen=True)
class CachedStage:
    """Files of a finished stage.

    Attributes:
        folder: Where they lie, at the same relative paths as in a run folder.
        files: SHA-256 of each, by relative path.
    """

    folder: Path
    files: Mapping[str, str]

    def take(self, out: Path) -> None:
        """Put the files into a run folder, in their order."""
        for name in self.files:
            place(self.folder, out, name)


@dataclass(frozen=True)
class StageCache:
    """The store; several processes may use it at once.

    Attributes:
        folder: Where it lies, on the disk of the run folders if files are to be linked and not copied.
    """

    folder: Path

    def put(self, key: str, out: Path, names: Sequence[str]) -> None:
        """Keep files of a run folder under a key; what is there already stays.

        Args:
            key: Hash of what determines the files.
            out: The run folder.
            names: Paths of the files, relative to it.
        """
        home = self.folder / key
        if home.exists():
            return
        part = being_written(home)
        remove(part)
        try:
            for name in names:
                place(out, part, name)
            write_json(part / ENTRY_RECORD, {name: digest(part / name) for name in names})
            os.rename(part, home)
            sync_folder(self.folder)
        except OSError:
            if not home.exists():  # else another process was faster
                raise
        finally:
            remove(part)

    def find(self, key: str) -> CachedStage | None:
        """The entry of a key, if it is whole; one that is damaged is deleted, with a warning."""
        home = self.folder / key
        if not home.exists():
            return None
        try:
            found = CachedStage(home, read_json(home / ENTRY_RECORD, dict[str, str]))
            wrong = next((name for name, known in found.files.items() if digest(home / name) != known), None)
            why = None if wrong is None else f"{home / wrong}: its checksum does not fit"
        except (BadInput, OSError) as error:
            why = str(error)
        if why is None:
            return found
        emit(Warned(f"a stored stage is damaged and is computed again: {why}"))
        remove(home)
        return None

    def sweep(self) -> None:
        """Delete what dead processes left unfinished; no other process may be writing."""
        if self.folder.is_dir():
            sweep(self.folder, deep=False)


def place(source: Path, target: Path, name: str) -> None:
    """Link a file into another folder, or copy it where it cannot be linked or may be written to in place.

    Args:
        source: Its folder.
        target: The other folder.
        name: Its path relative to both.
    """
    path = target / name
    path.parent.mkdir(parents=True, exist_ok=True)
    part = being_written(path)
    part.unlink(missing_ok=True)
    try:
        if is_changed_in_place(name) or not linked(source / name, part):
            shutil.copyfile(source / name, part)
            with part.open("rb+") as file:
                os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)  # it stays where both names are of one file


def linked(source: Path, target: Path) -> bool:
    """Make a hard link; False where the file system has none."""
    try:
        os.link(source, target)
    except OSError as error:
        if isinstance(error, FileNotFoundError) or error.errno in DISK_FULL:
            raise
        return False
    return True


def is_changed_in_place(name: str) -> bool:
    """Whether a file of a run may be written to without a new one taking its place: journals, and files of methods."""
    return name.endswith(journal.JOURNAL_FILE) or name.startswith("method/")


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(READ_BYTES):
            found.update(piece)
    return found.hexdigest()
