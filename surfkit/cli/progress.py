"""Bars for pieces of work that tell how far they are."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from surfkit.core.events import Progress
from surfkit.core.registry import hookimpl, plugins


class Listener:
    """Turns `Progress` events into bars, one for each piece of work."""

    def __init__(self, bars: Bars) -> None:
        self.bars = bars
        self.tasks: dict[str, TaskID] = {}

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if isinstance(event, Progress):
            if event.what not in self.tasks:
                self.tasks[event.what] = self.bars.add_task(event.what, total=event.total)
            self.bars.update(self.tasks[event.what], completed=event.done, total=event.total)


@contextmanager
def shown() -> Iterator[None]:
    """Within, progress is shown on a terminal; where there is none, nothing is."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, console=console, disable=not console.is_terminal) as bars:
        listener = Listener(bars)
        plugins().register(listener, "bars")
        try:
            yield
        finally:
            plugins().unregister(listener)
