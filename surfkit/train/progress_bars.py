"""Progress of other work than training: a live bar on a terminal, else a line every few seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Live

from surfkit.core.check import printable
from surfkit.core.clock import clock
from surfkit.core.events import Progress
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.train.progress import BAR_LINE_EVERY_S, larger


class ProgressBars:
    """Shows `Progress` events, one bar for each kind of work."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self.live: Live | None = None
        self.tasks: dict[str, TaskID] = {}
        self.told = 0.0
        self.begun: dict[str, tuple[int, float]] = {}

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if not isinstance(event, Progress) or larger() is not None:
            return
        if self.console.is_terminal:
            self.draw(event)
            return
        now, left = time.perf_counter(), self.left(event)
        if event.done == event.total or now - self.told > BAR_LINE_EVERY_S:
            self.told = now
            text = printable(f"{event.what}  {event.done}/{event.total}{left}")
            self.console.print(text, highlight=False, soft_wrap=True, markup=False)

    def left(self, event: Progress) -> str:
        """The time that the event's work will still take, in words, at the pace since it was first told of; nothing at
        its beginning and its end."""
        now = time.perf_counter()
        first, begun = self.begun.setdefault(event.what, (event.done, now))
        if event.done >= event.total:
            del self.begun[event.what]
            return ""
        if event.done <= first:
            return ""
        return f"  {clock((now - begun) * (event.total - event.done) / (event.done - first))} left"

    def draw(self, event: Progress) -> None:
        """Move the bar of the event's work; the last one to end takes the display with it."""
        if self.live is None:
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
            )
            self.live = Live(*columns, console=self.console)
            self.live.start()
        if event.what not in self.tasks:
            self.tasks[event.what] = self.live.add_task(printable(event.what))
        self.live.update(self.tasks[event.what], completed=event.done, total=event.total)
        if self.live.finished:
            self.close()

    def close(self) -> None:
        """Leave the bars as they are; the next event begins new ones."""
        if self.live is not None:
            self.live.stop()
        self.live, self.tasks = None, {}


@contextmanager
def bars(console: Console | None = None) -> Iterator[None]:
    """Within, progress is shown."""
    shown = ProgressBars(console)
    plugins().register(shown, "progress bars")
    try:
        yield
    finally:
        plugins().unregister(shown)
        shown.close()
