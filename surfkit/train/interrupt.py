"""Stopping a run between two steps instead of in the middle of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from surfkit.core.signals import asking


@dataclass
class StopRequest:
    """Whether someone asked the run to stop."""

    asked: bool = False


@contextmanager
def graceful() -> Iterator[StopRequest]:
    """Within, the first SIGINT, SIGTERM or SIGHUP only sets `asked`; a second one acts as ever, but for SIGHUP, which
    comes several times when a terminal is closed."""
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield request
        return
    previous: dict[int, Any] = {number: signal.getsignal(number) for number in asking()}

    def ask(number: int, frame: object) -> None:
        request.asked = True
        if number != signal.SIGHUP:
            signal.signal(number, previous[number])

    for number in previous:
        signal.signal(number, ask)
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
