"""How long blocks that are worked on will take, from what each has last told of itself; needs no torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from surfkit.core.clock import clock

LEAST_S = 3.0
"""The first steps are slower than the others."""


class Clocked(Protocol):
    """What a block tells of itself; see `surfkit.execute.state.BlockState`."""

    status: str
    step: int
    steps: int
    first: int
    began: float
    heard: float


def so_far(block: Clocked) -> float | None:
    """Seconds since a block was last begun, when it was last heard of; None if that is not known."""
    return max(0.0, block.heard - block.began) if block.began > 0 and block.status in ("running", "done") else None


def pace(block: Clocked) -> float | None:
    """Steps a second since it was last begun; None before there is something to tell from."""
    seconds, made = so_far(block) or 0.0, block.step - block.first
    return made / seconds if made > 0 and (seconds > LEAST_S or block.status == "done" and seconds > 0) else None


def seconds_left(block: Clocked) -> float | None:
    """Until a block that is worked on is done, at its pace."""
    speed = pace(block)
    return (block.steps - block.step) / speed if speed and block.status == "running" else None


def all_left(blocks: Sequence[Clocked], steps: int, at_once: int = 1) -> float | None:
    """Seconds until all blocks are done, at the pace of those that are worked on, or else of those that are done.

    Args:
        blocks: Those that are tuned at all.
        steps: That each has to make, also if it has not been begun.
        at_once: How many are worked on at a time, where it is not more.

    Returns:
        None where no block tells its pace, and when all are done.
    """
    rest = [block for block in blocks if block.status != "done"]
    running = [block for block in rest if block.status == "running"]
    paces = [speed for speed in map(pace, running) if speed] or [speed for speed in map(pace, blocks) if speed]
    if not paces or not rest:
        return None
    together = sum(paces) / len(paces) * max(len(running), min(at_once, len(rest)))
    lasts = max((left for left in map(seconds_left, running) if left), default=0.0)
    return max(lasts, sum(max(0, steps - block.step) for block in rest) / together)


def in_words(block: Clocked) -> str:
    """Step, time and time left of a block that is worked on: step 120/300, 0:12, 0:20 left."""
    parts = [f"step {block.step:,}/{block.steps:,}"]
    parts += [clock(seconds) for seconds in [so_far(block)] if seconds is not None]
    parts += [f"{clock(seconds)} left" for seconds in [seconds_left(block)] if seconds is not None]
    return ", ".join(parts)
