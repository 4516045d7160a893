"""Stopping a run between two steps instead of in the middle of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from surfkit.core.signals import asking


@dataclass
class StopRequest:
    """Whether someone asked the run to stop."""

    asked: bool = False


_HERE: ContextVar[StopRequest | None] = ContextVar("here", default=None)
"""Of the work of this thread that stops between two steps."""


def ask_to_stop() -> bool:
    """Ask the work of this thread to stop after its step, as Ctrl-C does; False where there is none that can."""
    request = _HERE.get()
    if request is not None:
        request.asked = True
    return request is not None


@contextmanager
def graceful() -> Iterator[StopRequest]:
    """Within, `ask_to_stop` and the first SIGINT, SIGTERM or SIGHUP only set `asked`; a second signal acts as ever, but
    for SIGHUP, which comes several times when a terminal is closed."""
    request = StopRequest()
    token = _HERE.set(request)
    try:
        with _signals_heard(request):
            yield request
    finally:
        _HERE.reset(token)


@contextmanager
def _signals_heard(request: StopRequest) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield
        return
    previous: dict[int, Any] = {number: signal.getsignal(number) for number in asking()}

    def ask(number: int, frame: object) -> None:
        request.asked = True
        if number != signal.SIGHUP:
            signal.signal(number, previous[number])

    for number in previous:
        signal.signal(number, ask)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
