"""A work that is interrupted after each of its parts, and a process that is killed."""

import hashlib
import os
import signal
from collections.abc import Callable
from pathlib import Path

from surfkit.core.events import Progress
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins


class Watch:
    """Does something when progress is reported."""

    def __init__(self, then: Callable[[Progress], None]) -> None:
        self.then = then

    @hookimpl
    def surfkit_event(self, event: object) -> None:
        if isinstance(event, Progress):
            self.then(event)


def interrupted_often(work: Callable[[], object]) -> int:
    """Call `work` until it comes to its end; the number of calls.

    Each call is interrupted by what Ctrl-C raises: where it first comes further than all before, then at its third
    report of progress, its fourth, and so on, as later parts report what earlier ones did.
    """
    known, calls = set(), 0

    def stop(event: Progress) -> None:
        nonlocal left
        left -= 1
        if event not in known or left == 0:
            known.add(event)
            raise KeyboardInterrupt

    watch = Watch(stop)
    plugins().register(watch)
    try:
        while True:
            calls, left = calls + 1, calls + 3
            try:
                work()
                return calls
            except KeyboardInterrupt:
                assert calls < 1000, "it comes no further"
    finally:
        plugins().unregister(watch)


def kill_at(what: str, done: int) -> None:
    """From now on, this process dies by SIGKILL when this progress is reported."""

    def kill(event: Progress) -> None:
        if (event.what, event.done) == (what, done):
            os.kill(os.getpid(), signal.SIGKILL)

    plugins().register(Watch(kill))


def digests(folder: Path) -> dict[str, str]:
    """What the files of a folder hold, by name."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
