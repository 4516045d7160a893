"""What is told while something runs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins


class Listener:
    """Keeps what `keep` makes of the events of a kind, in their order."""

    def __init__(self, kind: type, keep: Callable[[Any], Any]) -> None:
        self.kind, self.keep, self.heard = kind, keep, []

    @hookimpl
    def surfkit_event(self, event: object) -> None:
        if isinstance(event, self.kind):
            self.heard.append(self.keep(event))


@contextmanager
def listening(kind: type, keep: Callable[[Any], Any] = lambda event: event) -> Iterator[list]:
    """Within, a list that grows with each event of a kind; of what `keep` makes of it."""
    listener = Listener(kind, keep)
    plugins().register(listener)
    try:
        yield listener.heard
    finally:
        plugins().unregister(listener)
