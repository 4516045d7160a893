"""How much memory this process takes."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress


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
