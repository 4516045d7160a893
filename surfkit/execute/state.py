"""Where the work on a block stands, in a small file that whoever looks can read."""

from __future__ import annotations

import os
import platform
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.lock import holder

Status = Literal["planned", "running", "done", "failed"]
Kind = Literal["oom", "nan", "disk", "data", "fault", "crash", "interrupted"]
"""Why a block failed: memory, numbers or disk gave out, its data cannot be used, something else that was foreseen, or
was not, or someone asked it to stop."""

STALE_S = 120.0
"""Seconds without a sign of life after which a block of another machine counts as abandoned."""
_WRITING = threading.Lock()


@dataclass(frozen=True)
class BlockState:
    """Where one block stands.

    Attributes:
        status: planned, running, done or failed.
        step: Steps made, as last heard of.
        steps: Steps to make.
        attempts: How often it was begun.
        kind: Of the failure.
        error: What went wrong, in one line.
        host: The machine that works or worked on it.
        pid: The process.
        heard: When it last gave a sign of life, seconds since 1970.
        began: When it was last begun.
        first: Step after which it was.
        begun_points: At its first step.
        fallback: Of the ladder that it has come down for want of memory; 0 for none.
        most_points: Beyond which it does not grow, on its rung.
        reduced: What each rung has changed, in a few words.
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


def worked_on(folder: Path) -> str | None:
    """Who works on the block in a folder, as "process PID on HOST": it holds the lock, or was heard of elsewhere."""
    return heard_elsewhere(folder) or holder(folder)


def heard_elsewhere(folder: Path) -> str | None:
    """Who works on the block on another machine, as far as signs of life tell: not all file systems share locks."""
    state = read_state(folder)
    if state.status != "running" or state.host == platform.node() or time.time() - state.heard >= STALE_S:
        return None
    return f"process {state.pid} on {state.host}"


def state_path(folder: Path) -> Path:
    """Where the state of a block lies in its folder."""
    return folder / "state.json"


def read_state(folder: Path) -> BlockState:
    """The state of the block in a folder; planned if nothing is there.

    Raises:
        BadInput: The file is damaged.
    """
    path = state_path(folder)
    try:
        return read_json(path, BlockState) if path.exists() else BlockState()
    except BadInput as error:
        raise BadInput(f"{error}; delete it, and the block goes on from its last checkpoint") from error


def write_state(folder: Path, **changes: object) -> BlockState:
    """Change some of the state of a block, and sign it. Only one process does, but any of its threads."""
    signed = {"host": platform.node(), "pid": os.getpid(), "heard": time.time()}
    with _WRITING:
        state = replace(read_state(folder), **(signed | changes))
        write_json(state_path(folder), state)
    return state
