"""What asks a process to stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


def asking() -> tuple[signal.Signals, ...]:
    """The signals that ask this process to stop: Ctrl-C, SIGTERM, and SIGHUP of a terminal that is closed, unless the
    process was started to outlive that (`nohup`)."""
    outlives = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM, *([] if outlives else [signal.SIGHUP]))


@contextmanager
def terminable() -> Iterator[None]:
    """Within, SIGTERM and SIGHUP act like Ctrl-C, so that what is begun is put away, and workers save their states."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, signal.default_int_handler)}
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        before[signal.SIGHUP] = signal.signal(signal.SIGHUP, _hung_up)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _hung_up(number: int, frame: FrameType | None) -> None:
    """As Ctrl-C, once: of a terminal that is closed, the shell tells, and the system again when the shell ends."""
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
