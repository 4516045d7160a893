"""How much memory this process takes, and whether it gave out."""

from __future__ import annotations

import ctypes
import errno
import re
import sys
from contextlib import suppress
from pathlib import Path

from surfkit.core.check import Fault

NO_MEMORY = (
    "not enough memory", "can't allocate memory", "cannot allocate memory", "out of memory", "alloc_cpu",
    "insufficient memory", "bad_alloc", "bad allocation", "can't start new thread", "failed to map segment",
)  # fmt: skip
"""Words of torch, Qhull, C++, threads and shared libraries, whose errors have no class of their own."""
ASKED = re.compile(r"allocate ([\d.]+ ?\w+)")
"""How numpy and torch say what they wanted."""
CAPACITY = re.compile(r"total capacity of ([\d.]+ \w+)")
"""How torch says what a GPU has."""
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
"""What Linux tells of this process, and where it is asked to count its peak anew."""
PEAK = re.compile(r"^VmHWM:\s*(\d+) kB", re.MULTILINE)
MAPPED = re.compile(r"^Rss(?:File|Shmem):\s*(\d+) kB", re.MULTILINE)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ran out, of the CPU or of the device."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    known = isinstance(error, (RuntimeError, ImportError)) and not isinstance(error, Fault)
    return known and any(words in str(error).lower() for words in NO_MEMORY)


def is_out_of_gpu_memory(error: BaseException | None) -> bool:
    """Whether the memory of the GPU ran out, as torch or the driver says it, and not that of the CPU."""
    text = str(error).lower() if isinstance(error, RuntimeError) else ""
    return type(error).__name__ == "OutOfMemoryError" or ("cuda" in text and "out of memory" in text)


def out_of_memory(error: BaseException | None = None) -> str:
    """What to say when memory gave out: how much is held, and how much more was wanted if the error tells."""
    on_gpu = is_out_of_gpu_memory(error)
    parts = [f"{peak / 2**30:.1f} GiB held"] if (peak := peak_memory_bytes()) and not on_gpu else []
    if found := ASKED.search(str(error)):
        number, _, unit = found[1].partition(" ")
        wanted = f"{float(number) / 2**30:.1f} GiB" if unit == "bytes" else found[1]
        parts.append(f"{wanted} more wanted")
    if on_gpu and (found := CAPACITY.search(str(error))):
        parts.append(f"{found[1]} there in all")
    return f"out of{' GPU' * on_gpu} memory{' with ' if parts else ''}{' and '.join(parts)}"


_passed = 0
"""The peak at the last `reset_peak_memory` that the system refused: up to there, none since then can be told."""


def peak_memory_bytes() -> int:
    """The most memory this process has held since the last `reset_peak_memory`; 0 where that is not known.

    It is never known on Windows. Where the system cannot reset its count, it is known when more is held than ever
    before.
    """
    peak = highest_memory_bytes()
    return peak if peak > _passed else 0


def reset_peak_memory() -> None:
    """Let `peak_memory_bytes` count from what is held now; what was freed is handed back to the system before."""
    global _passed
    give_back()
    try:
        CLEAR.write_text("5", encoding="ascii")
        _passed = 0
    except OSError:
        _passed = highest_memory_bytes()


def highest_memory_bytes() -> int:
    """The peak that the system has counted, of whatever was ever held in this process; 0 where it counts none.

    The one that `getrusage` gives is at least what the parent process held when it started this one.
    """
    with suppress(OSError):
        if found := PEAK.search(STATUS.read_text(encoding="ascii", errors="replace")):
            return int(found[1]) * 1024
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


def mapped_bytes() -> int:
    """Of what is held, what is mapped from files, which the system takes back where it needs the memory; 0 where it is
    not known."""
    with suppress(OSError):
        text = STATUS.read_text(encoding="ascii", errors="replace")
        return sum(int(found) * 1024 for found in MAPPED.findall(text))
    return 0


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
