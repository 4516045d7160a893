"""The most memory that was held: what was freed before does not count, and what is not known is not told.

Measured in new processes: this one may hand back at any time what other tests held.
"""

import multiprocessing
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from surfkit.core import memory
from surfkit.core.memory import highest_memory_bytes, peak_memory_bytes, reset_peak_memory, resident_bytes

LARGE = 300_000_000


def hold(count: int) -> int:
    """Hold as many bytes for a moment; the peak then."""
    held = np.ones(count, np.uint8)
    return int(held[-1]) * peak_memory_bytes()


def measured(function: Callable[..., list[int]], *args) -> list[int]:
    """What a function measures in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as new:
        return new.submit(function, *args).result()


def large_then_small() -> list[int]:
    before = resident_bytes()
    peaks = [hold(LARGE), peak_memory_bytes()]
    reset_peak_memory()
    if memory._passed:
        return []
    peaks.append(peak_memory_bytes())
    peaks.append(hold(LARGE // 5))  # more than 32 MiB, so that it is not a piece of what was freed before
    return [peak - before for peak in peaks]


def test_what_was_freed_does_not_count():
    peaks = measured(large_then_small)
    if not peaks:
        pytest.skip(f"{memory.CLEAR} cannot be written here, so the peak of a process never falls")
    large, then, reset, small = peaks
    assert min(large, then) > 0.9 * LARGE and reset < 0.2 * LARGE
    assert 0.1 * LARGE < small < 0.4 * LARGE


def without_resets(none: Path) -> list[int]:
    memory.CLEAR = none
    highest = highest_memory_bytes()
    peaks = [highest, peak_memory_bytes(), hold(LARGE)]
    reset_peak_memory()
    peaks += [peak_memory_bytes(), hold(LARGE // 10), hold(2 * LARGE)]
    return [*peaks, peak_memory_bytes(), highest_memory_bytes()]


def test_a_peak_that_cannot_be_reset_is_not_told(tmp_path):
    highest, peak, large, reset, small, larger, now, of_all = measured(without_resets, tmp_path / "none" / "clear_refs")
    near = 0.05 * LARGE  # the system counts in batches
    assert highest > 0 and abs(peak - highest) < near and large > highest
    assert reset == 0, "whatever is held now may be less than before"
    assert small == 0
    assert larger > highest + 1.5 * LARGE, "more than ever before is known"
    assert abs(now - of_all) < near and abs(now - larger) < near


def test_the_peak_is_not_that_of_the_process_which_started_this_one():
    held = np.ones(LARGE, np.uint8)
    told = subprocess.run(
        [sys.executable, "-c", "from surfkit.core.memory import peak_memory_bytes as peak; print(peak())"],
        capture_output=True,
        check=True,
        text=True,
    ).stdout
    assert 0 < int(told) < 0.5 * len(held)
