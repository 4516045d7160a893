"""How much memory there is to use."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil

from surfkit.core.check import BadInput

CACHE_SHARE = 0.5
"""Of the free memory that the cache takes by default: the points and the rasterizer need the rest."""
BYTE_UNITS = {
    "": 1,
    "k": 10**3,
    "m": 10**6,
    "g": 10**9,
    "t": 10**12,
    "ki": 2**10,
    "mi": 2**20,
    "gi": 2**30,
    "ti": 2**40,
}
MAX_SIZE_BYTES = 10**15
"""Bytes that can be asked for."""
CGROUP_ROOT = Path("/sys/fs/cgroup")
PROCESS_CGROUP = Path("/proc/self/cgroup")
VMSTAT = Path("/proc/vmstat")


def cache_bytes(
    text: str, flag: str = "--cache", auto: Callable[[], int] | None = None, other: str = ", or auto"
) -> int:
    """Bytes of a size such as 4GB, 500 MB or 2GiB; for "auto" what `auto` gives, or a share of the free memory.

    `other`: what messages name beside a size.
    """
    if text.strip().lower() == "auto":
        return int(CACHE_SHARE * free_bytes()) if auto is None else auto()
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?i?)b?\s*", text.lower())
    if not found or found[2] not in BYTE_UNITS:
        raise BadInput(f"{flag} {text}: give a size such as 4GB or 500MB{other}")
    size = float(found[1]) * BYTE_UNITS[found[2]]
    if size > MAX_SIZE_BYTES:
        raise BadInput(f"{flag} {text}: give a size such as 4GB or 500MB, of at most 1000TB{other}")
    return int(size)


def free_bytes() -> int:
    """Memory that this process may still take: what the machine has free, and what its limits allow."""
    return max(0, min([psutil.virtual_memory().available, *_allowed(), *_unreserved()]))


def oom_kills() -> int:
    """How many processes the system has ended for want of memory so far: of our control group, else of the machine."""
    for folder in _groups():
        for name in ("memory.events", "memory.oom_control"):
            if (found := _entry(folder / name, "oom_kill", -1)) >= 0:
                return found
    return _entry(VMSTAT, "oom_kill")


def _allowed() -> Iterator[int]:
    """What each control group above this process still allows; pages that only cache files count as free."""
    for folder in _groups():
        for limit, usage, cached in (
            ("memory.max", "memory.current", "inactive_file"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ):
            most, used = _number(folder / limit), _number(folder / usage)
            if most is not None and used is not None:
                yield most - used + _entry(folder / "memory.stat", cached)


def _unreserved() -> Iterator[int]:
    """What `ulimit -v` still allows."""
    try:
        import resource
    except ImportError:  # Windows
        return
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if most != resource.RLIM_INFINITY:
        yield most - psutil.Process().memory_info().vms


def _groups() -> Iterator[Path]:
    """Folders of the groups that this process is in, and of those around them; version 2, then version 1."""
    try:
        lines = PROCESS_CGROUP.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root = CGROUP_ROOT / "memory" if controllers else CGROUP_ROOT
        path = Path(name.lstrip("/"))
        yield from (root / inner for inner in (path, *path.parents))


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):  # no such file, or "max"
        return None


def _entry(path: Path, name: str, lacking: int = 0) -> int:
    try:
        rows = (line.split() for line in path.read_text().splitlines())
        return next((int(value) for key, value in rows if key == name), lacking)
    except (OSError, ValueError):
        return lacking
