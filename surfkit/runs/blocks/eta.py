"""Time left for running blocks, from their last heartbeats; needs no torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from surfkit.core.clock import clock

MIN_MEASURED_S = 3.0
"""The first steps are slower than the others."""


class TimedBlock(Protocol):
    """The fields of `surfkit.runs.execute.block_state.BlockState` that are needed."""

    @property
    def status(self) -> str: ...
    @property
    def step(self) -> int: ...
    @property
    def steps(self) -> int: ...
    @property
    def first(self) -> int: ...
    @property
    def began(self) -> float: ...
    @property
    def heard(self) -> float: ...


def seconds_elapsed(block: TimedBlock) -> float | None:
    """Seconds from the last start of a block to its last heartbeat; None if not known."""
    return max(0.0, block.heard - block.began) if block.began > 0 and block.status in ("running", "done") else None


def steps_per_second(block: TimedBlock) -> float | None:
    """Steps per second since the last start; None if there are too few steps yet."""
    seconds, made = seconds_elapsed(block) or 0.0, block.step - block.first
    return made / seconds if made > 0 and (seconds > MIN_MEASURED_S or block.status == "done" and seconds > 0) else None


def seconds_left(block: TimedBlock) -> float | None:
    """Seconds until a running block is done, at its speed."""
    speed = steps_per_second(block)
    return (block.steps - block.step) / speed if speed and block.status == "running" else None


def total_seconds_left(blocks: Sequence[TimedBlock], steps: int, at_once: int = 1) -> float | None:
    """Seconds until all blocks are done, at the mean speed of the running blocks, or else of those that are done.

    Args:
        blocks: Those with views.
        steps: Of each, also if it has not been started.
        at_once: How many run at a time, if not more.

    Returns:
        None if no speed is known, or all are done.
    """
    rest = [block for block in blocks if block.status != "done"]
    running = [block for block in rest if block.status == "running"]
    paces = [speed for speed in map(steps_per_second, running) if speed] or [
        speed for speed in map(steps_per_second, blocks) if speed
    ]
    if not paces or not rest:
        return None
    together = sum(paces) / len(paces) * max(len(running), min(at_once, len(rest)))
    lasts = max((left for left in map(seconds_left, running) if left), default=0.0)
    return max(lasts, sum(max(0, steps - block.step) for block in rest) / together)


def describe_progress(block: TimedBlock) -> str:
    """Step, time and time left of a running block: step 120/300, 0:12, 0:20 left."""
    parts = [f"step {block.step:,}/{block.steps:,}"]
    parts += [clock(seconds) for seconds in [seconds_elapsed(block)] if seconds is not None]
    parts += [f"{clock(seconds)} left" for seconds in [seconds_left(block)] if seconds is not None]
    return ", ".join(parts)
