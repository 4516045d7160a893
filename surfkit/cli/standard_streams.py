"""Standard streams that take nothing: closed, on a disk that is full, or with a reader that has ended."""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

READER_LEFT = 141
"""What a shell reports for a program that SIGPIPE ends, and so what a command returns whose output nobody reads."""
STREAMS = ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w"))


class ScreenRecord(io.StringIO):
    """What was printed, in the colours and the letters of a screen."""

    def __init__(self, screen: TextIO) -> None:
        super().__init__()
        self.screen = screen

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Of the screen; where there is none, boxes are drawn in ASCII."""
        return self.screen.encoding

    def isatty(self) -> bool:
        """Whether the screen is a terminal."""
        return self.screen.isatty()


@contextmanager
def recorded() -> Iterator[ScreenRecord]:
    """Within, what would go to stdout is recorded, and does not appear."""
    screen = sys.stdout
    sys.stdout = record = ScreenRecord(screen)
    try:
        yield record
    finally:
        sys.stdout = screen


def reopen_closed() -> None:
    """Give streams that were closed before the process began (`>&-`) to /dev/null.

    Without, printing to them would fail, and the next file that is opened would take their number: what a library
    writes to stdout or stderr would then land in it.
    """
    for number, name, mode in STREAMS:
        if getattr(sys, name) is not None:
            continue
        try:
            os.fstat(number)
        except OSError:
            _give_to_null(number)
        setattr(sys, name, open(os.devnull, mode))


def replace_unknown_letters() -> None:
    """Let output have a question mark for what its encoding lacks: a name of other bytes, or ± where there is ASCII."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")


def outlive_terminal() -> None:
    """Let output to a terminal go nowhere once that is closed: an error of writing must not end what is to be saved.

    SIGHUP, which asks to stop, comes a moment later, or never to a process that a shell has disowned.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper) or not stream.isatty():
            continue
        if not isinstance(getattr(stream.buffer, "raw", None), _Terminal):
            file = io.BufferedWriter(_Terminal(stream.fileno(), "wb", closefd=False))
            setattr(sys, name, io.TextIOWrapper(file, stream.encoding, stream.errors, line_buffering=True))


class _Terminal(io.FileIO):
    """Writes to a terminal, and to nobody when it is gone."""

    def write(self, content: ReadableBuffer, /) -> int:
        """As FileIO does."""
        try:
            return super().write(content)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            _give_to_null(self.fileno())
            return super().write(content)


def silence_lost_streams() -> list[str]:
    """Give the output streams that take nothing any more to /dev/null, so that Python ends without a word of its own.

    Returns:
        Which they were: "output" and "error".
    """
    lost = []
    for name, stream in (("output", sys.stdout), ("error", sys.stderr)):
        try:
            number = stream.fileno()
        except (OSError, ValueError):  # not a file, so nothing can be wrong with it
            continue
        if _has_no_reader(number) or _is_refused(stream, number):
            _give_to_null(number)
            lost.append(name)
    return lost


def _has_no_reader(number: int) -> bool:
    watch = select.poll()
    watch.register(number, 0)
    return any(state & (select.POLLERR | select.POLLHUP) for _, state in watch.poll(0))


def _is_refused(stream: TextIO, number: int) -> bool:
    """Whether what is still in the buffer, or nothing at all, cannot be written."""
    try:
        stream.flush()
        os.write(number, b"")
    except OSError:
        return True
    return False


def _give_to_null(number: int) -> None:
    null = os.open(os.devnull, os.O_RDWR)
    if null == number:
        os.set_inheritable(number, True)
    else:
        os.dup2(null, number)
        os.close(null)
