"""The state of the training of a block, in a small file that any process can read."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from surfkit.core.check import BadInput
from surfkit.core.codec import load, read_json, write_json
from surfkit.core.lock import lock_holder

Status = Literal["planned", "running", "done", "failed"]
Kind = Literal["oom", "nan", "disk", "data", "fault", "crash", "lost", "interrupted"]
"""Why a block failed: out of memory, NaN or Inf, disk full, unusable data, another error with a message, an unexpected
error, its machine was lost, or it was asked to stop."""

STALE_S = 120.0
"""Seconds without a heartbeat after which a block of another machine counts as abandoned."""
FORMER_NAMES = {"rung": "fallback", "eased": "reduced"}
"""Fields of older versions, and what they are called now."""


@dataclass(frozen=True)
class BlockState:
    """The state of one block.

    Attributes:
        status: planned, running, done or failed.
        step: Steps done, at the last heartbeat.
        steps: Steps to do.
        attempts: How often it was started.
        kind: Of the failure.
        error: The reason of the failure, in one line.
        host: The machine that trains or trained it.
        pid: The process.
        heard: Time of the last heartbeat, seconds since 1970.
        began: When it was last started, seconds since 1970.
        first: Step after which it was last started.
        begun_points: Points at its first step.
        fallback: Number of the last fallback that was used after it ran out of memory; 0 for none.
        most_points: Its limit on the number of points, by that fallback; None for none.
        reduced: What each fallback has changed, in a few words.
    """

    status: Status = "planned"
    step: int = 0
    steps: int = 0
    attempts: int = 0
    kind: Kind | None = None
    error: str | None = None
    host: str | None = None
    pid: int | None = None
    heard: float = 0.0
    began: float = 0.0
    first: int = 0
    begun_points: int = 0
    fallback: int = 0
    most_points: int | None = None
    reduced: tuple[str, ...] = ()


def find_worker(folder: Path) -> str | None:
    """The process that trains the block in a folder, as "process PID on HOST": by its lock, or by its heartbeat."""
    return find_remote_worker(folder) or lock_holder(folder)


def find_remote_worker(folder: Path) -> str | None:
    """The process that trains the block on another machine, by its heartbeat: not all file systems share locks."""
    state = read_state(folder)
    if state.status != "running" or state.host == platform.node() or time.time() - state.heard >= STALE_S:
        return None
    return f"process {state.pid} on {state.host}"


def state_path(folder: Path) -> Path:
    """The file of the state in the folder of a block."""
    return folder / "state.json"


def read_state(folder: Path) -> BlockState:
    """The state of the block in a folder; planned if there is no file.

    Raises:
        BadInput: The file is damaged.
    """
    path = state_path(folder)
    try:
        return load_state(read_json(path, dict[str, Any]), str(path)) if path.exists() else BlockState()
    except BadInput as error:
        raise BadInput(f"{error}; delete it, and the block goes on from its last checkpoint") from error


def load_state(content: dict[str, Any], where: str) -> BlockState:
    """A state from the content of its file, also of one that an older version has written.

    Raises:
        BadInput: It is damaged; `where` begins the message.
    """
    return load(BlockState, {FORMER_NAMES.get(name, name): value for name, value in content.items()}, where)


def write_state(folder: Path, state: BlockState, **changes: Any) -> BlockState:
    """Save a state of a block with some changes, as a heartbeat of this process; the new state."""
    heartbeat: dict[str, Any] = {"host": platform.node(), "pid": os.getpid(), "heard": time.time()}
    state = replace(state, **(heartbeat | changes))
    write_json(state_path(folder), state)
    return state
