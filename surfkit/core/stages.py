"""Work that is not repeated after an interruption: stages that keep their results, and folders of finished parts."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json, write_json
from surfkit.core.events import Warned, emit
from surfkit.core.files import sweep
from surfkit.core.lock import LOCK_FILE as LOCK

T = TypeVar("T")
STAGES_RECORD = "stages.json"
UNFINISHED_FILE = "unfinished.json"
"""What the parts in a folder belong to."""


@dataclass(frozen=True)
class StageRecord:
    """A stage that is complete.

    Attributes:
        key: Of all that its result depends on.
        seconds: That it took, all calls with this key together.
        complete: Whether it came to its end.
    """

    key: str
    seconds: float
    complete: bool = True


class StageFolder:
    """The stages of a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            self.known = read_json(folder / STAGES_RECORD, dict[str, StageRecord])
        except BadInput:
            self.known = {}

    def run(self, name: str, key: str, make: Callable[[], T], load: Callable[[], T] | None = None) -> T:
        """What a stage comes to: loaded if it was complete with the same key, else made.

        Args:
            name: Of the stage.
            key: Of all that its result depends on.
            make: Makes and keeps the result.
            load: Reads what was kept; BadInput if it is gone. None makes it each time, where `make` itself knows what
                is there.
        """
        before = self.known.get(name)
        if load is not None and before is not None and before.key == key and before.complete:
            try:
                return load()
            except BadInput:
                before = None
        spent = before.seconds if before is not None and before.key == key else 0.0
        began, ended = time.perf_counter(), False
        try:
            result = make()
            ended = True
        finally:
            self.known[name] = StageRecord(key, round(spent + time.perf_counter() - began, 2), ended)
            write_json(self.folder / STAGES_RECORD, self.known)
        return result

    def seconds(self) -> dict[str, float]:
        """The time of each stage, in their order."""
        return {name: stage.seconds for name, stage in self.known.items()}


def key_of(*values: Any) -> str:
    """A digest of values that the codec knows."""
    text = json.dumps([dump(value) for value in values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


@contextmanager
def kept_parts(folder: Path, key: str) -> Iterator[None]:
    """Within, there is a folder for finished parts of a work, which a later call with the same key finds again.

    The folder is deleted when the work is done, or nothing of it is finished. Parts of another key are deleted at the
    beginning, and a line says so; half-written files of dead processes are too. The caller sees to it that no other
    process works in the folder.

    Raises:
        BadInput: The folder has files of somebody else.
    """
    if folder.is_symlink():
        raise BadInput(f"{folder}: a link, where surfkit makes and deletes a folder; move it away")
    folder.mkdir(parents=True, exist_ok=True)
    ours = (folder / UNFINISHED_FILE).exists()
    sweep(folder, deep=ours)
    if ours and _key(folder) != key:
        emit(Warned(f"{folder}: what an interrupted command left there is of other inputs or settings; begun anew"))
        delete_parts(folder)
    elif not ours and _parts(folder):
        raise BadInput(
            f"{folder}: it has files but no {UNFINISHED_FILE}, so they are not surfkit's; move the folder away"
        )
    write_json(folder / UNFINISHED_FILE, {"key": key})
    try:
        yield
        delete_parts(folder)
    finally:
        if not _parts(folder):
            shutil.rmtree(folder)


def delete_parts(folder: Path) -> None:
    """Delete what is finished. What it belongs to stays until the last part is gone: this can be interrupted too."""
    for path in _parts(folder):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _key(folder: Path) -> str | None:
    try:
        return read_json(folder / UNFINISHED_FILE, dict[str, str]).get("key")
    except BadInput:
        return None


def _parts(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.name not in (UNFINISHED_FILE, LOCK)]
