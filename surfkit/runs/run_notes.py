"""The warnings of a run: printed, and kept in run.json."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.events import MemoryTaken, PhotoSkipped, Warned, emit, say
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.runs import journal
from surfkit.runs.folder import read_record

NOTES = "notes of the run"
"""Name of the plugin."""


class RunNotes:
    """Prints the warnings of a run; keeps them, the names of skipped photographs and the memory in run.json."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.skipped: list[str] = []
        self.memory: dict[str, int] = {}
        self.gpu: dict[str, int] = {}
        self.path: Path | None = None
        self.facts: dict[str, Any] = {}
        self.prefix = ""

    def begin(self, path: Path, facts: dict[str, Any], before: dict[str, Any]) -> None:
        """Keep all in a file from now on, after what a run that was interrupted had kept there `before`."""
        self.path, self.facts = path, facts
        self.texts = list(dict.fromkeys([*before.get("notes", []), *self.texts]))
        self.skipped = list(dict.fromkeys([*before.get("skipped", []), *self.skipped]))
        self.memory = before.get("memory_bytes") or {}
        self.gpu = before.get("gpu_memory_bytes") or {}
        self.write()

    def write(self) -> None:
        """Save what there is."""
        if self.path is not None:
            found = {"notes": self.texts, "skipped": self.skipped, "memory_bytes": self.memory}
            found |= {"gpu_memory_bytes": self.gpu} if self.gpu else {}
            write_json(self.path, self.facts | found)

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if isinstance(event, Warned):
            if self.prefix and event.text in self.texts:
                return  # the whole run has been warned of it
            say(f"note: {self.prefix}{event.text}")
            self.keep(self.texts, self.prefix + event.text)
        elif isinstance(event, MemoryTaken):
            before = self.memory, self.gpu
            self.memory, self.gpu = higher(self.memory, event.parts), higher(self.gpu, event.gpu)
            if (self.memory, self.gpu) != before:
                self.write()
        elif isinstance(event, PhotoSkipped) and self.keep(self.skipped, event.name):
            say(f"note: {event.reason}; the run goes on without this photograph")

    def keep(self, kept: list[str], text: str) -> bool:
        """Keep a text unless it is there already; True if it is new."""
        if text in kept:
            return False
        kept.append(text)
        self.write()
        return True


def higher(known: Mapping[str, int], found: Mapping[str, int]) -> dict[str, int]:
    """The report with the higher peak; of equal peaks, the later one unless it has fewer parts."""
    best: Mapping[str, int] = max((found, known), key=lambda parts: (parts.get("peak", 0), len(parts)))
    return dict(best)


@contextmanager
def collect_notes() -> Iterator[RunNotes]:
    """Within, warnings are printed and collected.

    Raises:
        BadInput: This process collects those of other work already: who listens could not tell the two apart.
    """
    notes = RunNotes()
    try:
        plugins().register(notes, NOTES)
    except ValueError as error:
        raise BadInput(
            "surfkit: this process is still at other work on a data set or a run, in another thread or around this "
            "call; begin when that has ended, or in another process"
        ) from error
    try:
        yield notes
    finally:
        plugins().unregister(notes)


class _Heard:
    """Keeps the warnings that are told."""

    def __init__(self) -> None:
        self.texts: dict[str, None] = {}

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if isinstance(event, Warned):
            self.texts[event.text] = None


@contextmanager
def hear_warnings() -> Iterator[dict[str, None]]:
    """Within, a dictionary whose keys are the warnings that are told, each once, in their order."""
    heard = _Heard()
    plugins().register(heard)
    try:
        yield heard.texts
    finally:
        plugins().unregister(heard)


@contextmanager
def prefix_notes(prefix: str) -> Iterator[None]:
    """Within, warnings are those of a part of the run, and begin with its name."""
    notes = plugins().get_plugin(NOTES)
    if notes is not None:
        notes.prefix = prefix
    try:
        yield
    finally:
        if notes is not None:
            notes.prefix = ""


def repeat_warnings(out: Path, folder: Path, prefix: str) -> None:
    """Emit for the run in `out` the warnings in the journal of a part of it, which another process has written."""
    record = read_record(out)
    notes, skipped = set(record.get("notes", [])), set(record.get("skipped", []))
    for line in journal.read(folder / journal.JOURNAL_FILE):
        text, name = line.get("text"), line.get("name")
        if line["event"] == "Warned" and isinstance(text, str) and not {text, prefix + text} & notes:
            notes.add(text)
            emit(Warned(prefix + text))
        elif line["event"] == "PhotoSkipped" and isinstance(name, str) and name not in skipped:
            skipped.add(name)
            emit(PhotoSkipped(name, str(line.get("reason"))))
