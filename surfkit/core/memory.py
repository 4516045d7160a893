"""How much memory this process takes, and whether it gave out."""

from __future__ import annotations

import ctypes
import errno
import re
import sys
from contextlib import suppress

from surfkit.core.check import Fault

NO_MEMORY = (
    "not enough memory", "can't allocate memory", "cannot allocate memory", "out of memory", "alloc_cpu",
    "insufficient memory", "bad_alloc", "bad allocation", "can't start new thread", "failed to map segment",
)  # fmt: skip
"""Words of torch, Qhull, C++, threads and shared libraries, whose errors have no class of their own."""
ASKED = re.compile(r"allocate ([\d.]+ ?\w+)")
"""How numpy and torch say what they wanted."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ran out, of the CPU or of the device."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    known = isinstance(error, (RuntimeError, ImportError)) and not isinstance(error, Fault)
    return known and any(words in str(error).lower() for words in NO_MEMORY)


def out_of_memory(error: BaseException | None = None) -> str:
    """What to say when memory gave out: how much is held, and how much more was wanted if the error tells."""
    parts = [f"{peak / 2**30:.1f} GiB held"] if (peak := peak_memory_bytes()) else []
    if found := ASKED.search(str(error)):
        number, _, unit = found[1].partition(" ")
        wanted = f"{float(number) / 2**30:.1f} GiB" if unit == "bytes" else found[1]
        parts.append(f"{wanted} more wanted")
    return f"out of memory{' with ' if parts else ''}{' and '.join(parts)}"


def peak_memory_bytes() -> int:
    """The most memory this process has held so far; 0 where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def resident_bytes() -> int:
    """The memory that this process holds now."""
    import psutil

    return psutil.Process().memory_info().rss


def give_back() -> None:
    """Hand memory that was freed back to the system, where the C library keeps it for itself (glibc)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def size(count: float, digits: int = 1) -> str:
    """Bytes in words: 1.5 GB, with so many digits after the point, or whole MB."""
    for unit, per in (("TB", 1e12), ("GB", 1e9)):
        if count >= per:
            return f"{count / per:.{digits}f} {unit}"
    return f"{count / 1e6:.0f} MB"
