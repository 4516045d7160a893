"""events.jsonl: the events of a run, one JSON object per line, in the order in which they happened."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, from_json
from surfkit.core.events import FileWritten, Progress, StageBegan, StageEnded, Warned
from surfkit.core.files import replacing
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins

JOURNAL_FILE = "events.jsonl"
STEP_EVENTS = {"StepDone", "PointsEdited", "Measured"}
"""Events that have the index of their step."""
REQUIRED_FIELDS: dict[str, type | tuple[type, ...]] = {"event": str, "time": (int, float)}
"""What every line has."""


class Journal:
    """Writes every event at once, so that a killed process loses none, and flushes the file to disk at checkpoints.

    When a stage continues from a checkpoint, the events of later steps are removed: these steps are made again.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / JOURNAL_FILE
        self.file: int | None = None

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """Write one event. Of progress other than steps, only the end is written, as there are many events before."""
        if isinstance(event, Progress) and event.done < event.total:
            return
        if isinstance(event, StageBegan):
            self.close()
        if self.file is None:
            remove_steps(self.path, event.first if isinstance(event, StageBegan) else sys.maxsize)
            self.file = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        facts = dump(event)
        if isinstance(event, FileWritten) and event.path.is_relative_to(self.folder):
            facts["path"] = event.path.relative_to(self.folder).as_posix()
        line = {"time": round(time.time(), 3), "event": type(event).__name__, **facts}
        os.write(self.file, (json.dumps(line, allow_nan=False) + "\n").encode())
        if isinstance(event, (FileWritten, StageEnded)):
            os.fsync(self.file)

    def close(self) -> None:
        """Close the file; the next event opens it again."""
        if self.file is not None:
            os.close(self.file)
            self.file = None


@contextmanager
def record_events(folder: Path, warned: Sequence[str] = ()) -> Iterator[None]:
    """Within, events are written into the journal of a run folder, and not into that of a run around it.

    The journal gets the warnings `warned` first, which the user has seen already.
    """
    journal, name = Journal(folder), "journal of the run"
    for text in warned:
        journal.surfkit_event(Warned(text))
    around = plugins().unregister(name=name) if plugins().has_plugin(name) else None
    plugins().register(journal, name)
    try:
        yield
    finally:
        plugins().unregister(journal)
        journal.close()
        if around is not None:
            plugins().register(around, name)


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of a journal; those that are damaged, or that a dying process did not finish, are left out."""
    return [line for _, line in _lines(path)]


def lines(part: bytes) -> list[dict[str, Any]]:
    """The same of a part of a journal."""
    return [line for _, line in _parsed(part.decode("utf-8", "replace"))]


def remove_steps(path: Path, first: int) -> None:
    """Remove the events of step `first` and of all later ones, and incomplete lines."""
    if not path.exists():
        return
    stays = [text for text, line in _lines(path) if line["event"] not in STEP_EVENTS or line.get("index", 0) < first]
    text = "".join(stays).encode()
    if len(text) != path.stat().st_size:
        with replacing(path) as file:
            file.write(text)


def _lines(path: Path) -> list[tuple[str, dict[str, Any]]]:
    return _parsed(path.read_text(encoding="utf-8", errors="replace")) if path.exists() else []


def _parsed(journal: str) -> list[tuple[str, dict[str, Any]]]:
    found = []
    for text in journal.splitlines(keepends=True):
        try:
            line = from_json(text)
        except BadInput:
            continue
        if text.endswith("\n") and _is_valid(line):
            found.append((text, line))
    return found


def _is_valid(line: Any) -> bool:
    if not isinstance(line, dict) or not all(
        isinstance(line.get(name), kind) for name, kind in REQUIRED_FIELDS.items()
    ):
        return False
    return line["event"] not in STEP_EVENTS or isinstance(line.get("index"), int)
