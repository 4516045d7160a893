"""What a command runs within: watched, with bounds, and with an output and a memory that may be damaged."""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import resource
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import surfkit

from .damage import OUTPUTS, Damage

CPU_SECONDS = 60
"""Of CPU time of this process, within which a command must end: on a machine that is busy with others, too."""
GROWTH = 3 << 30
"""Bytes of address space that a command may add."""
WRITES = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod"}
FLAGS = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
MOST_CALLS = 100_000
"""Calls of functions of surfkit that a command makes at most before memory gives out, where it is damaged."""
PACKAGE = f"{Path(surfkit.__file__).parent}{os.sep}"
"""Not every folder of this name: a clone may have it."""
GUARD = tuple(f"{PACKAGE}{name}" for name in ("cli/__init__.py", "cli/standard_streams.py", "core/check.py"))
"""Where errors become lines: memory does not give out in there."""


class Watch:
    """Notes what this process writes outside some folders, while it is asked to."""

    def __init__(self) -> None:
        self.allowed: tuple[str, ...] | None = None
        self.found: list[str] = []
        sys.addaudithook(self.see)

    def see(self, event: str, args: tuple) -> None:
        """See what Python is about to do."""
        if self.allowed is None or event not in WRITES:
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & FLAGS):
            return
        for name in args[:2] if event in ("os.rename", "os.link", "os.symlink") else args[:1]:
            if isinstance(name, (str, bytes, os.PathLike)):
                below = args[-1] if event in ("os.remove", "os.rmdir") and args[-1] >= 0 else None  # an open folder
                base = "" if below is None else os.readlink(f"/proc/self/fd/{below}")
                path = os.path.realpath(os.path.join(base, os.fsdecode(name)))
                is_process = path.startswith(("/dev/", f"/proc/{os.getpid()}/"))  # such as the count of its memory
                if not (path.startswith(self.allowed) or "__pycache__" in path or is_process):
                    self.found.append(f"{event} {path}")


@contextlib.contextmanager
def damaged_output(damage: Damage | None, sound: io.StringIO) -> Iterator[Any]:
    """What stands for stdout: a file that takes nothing, or nothing at all."""
    kind = None if damage is None else OUTPUTS[damage.what % len(OUTPUTS)]
    if kind in (None, "closed"):
        yield sound if kind is None else None
        return
    if kind == "full":
        file = open("/dev/full", "w")
    else:
        reader, writer = os.pipe()
        os.close(reader)
        file = open(writer, "w")
    try:
        yield file
    finally:
        with contextlib.suppress(OSError):
            file.close()


@contextlib.contextmanager
def giving_out(damage: Damage | None) -> Iterator[None]:
    """Within, one of the calls of surfkit's functions fails for want of memory, as Python, numpy and torch say it."""
    if damage is None:
        yield
        return
    errors = (MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"))
    left = int(MOST_CALLS**damage.at)

    def called(frame: Any, event: str, argument: object) -> None:
        nonlocal left
        code = frame.f_code
        ours = code.co_filename.startswith(PACKAGE) and not code.co_filename.startswith(GUARD)
        if ours and not code.co_flags & inspect.CO_GENERATOR:  # which are also called to be closed
            left -= 1
            if left == 0:
                sys.settrace(None)
                raise errors[damage.what % 2]

    sys.settrace(called)
    try:
        yield
    finally:
        sys.settrace(None)


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Within, CPU time and address space are bounded."""

    def late(number: int, frame: object) -> None:
        raise TimeoutError(f"no end after {CPU_SECONDS} s of CPU time")

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + GROWTH, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, handler)
