"""What happens in a run, told to whoever listens: progress displays, loggers, viewers.

Events are frozen and hold plain values only. Plugins see them through the `surfkit_event` hook.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from surfkit.core.check import printable
from surfkit.core.registry import plugins


@dataclass(frozen=True)
class StageBegan:
    """An optimisation run begins, or goes on after an interruption.

    Attributes:
        stage: Its name in the recipe, such as "pretrain".
        steps: How many it will have made at its end.
        points: At this moment; 0 for a method without points.
        first: Index of the first step to come; above 1 when the run goes on from a checkpoint.
        block: Number of the block that it is run on, if not on the whole scene.
    """

    stage: str
    steps: int
    points: int
    first: int = 1
    block: int | None = None


@dataclass(frozen=True)
class StepDone:
    """One optimisation step is done.

    Attributes:
        index: Counts from 1.
        steps: How many the stage has.
        losses: Weighted value of each loss, by its name in the recipe.
        points: After the step; 0 for a method without points.
        peak_memory_bytes: Most memory held so far in the stage; 0 where that is not known.
        peak_gpu_bytes: Most memory of the GPU held so far in the stage; 0 without one.
    """

    index: int
    steps: int
    losses: Mapping[str, float]
    points: int
    peak_memory_bytes: int = 0
    peak_gpu_bytes: int = 0


@dataclass(frozen=True)
class PointsEdited:
    """Points were dropped, cloned or split.

    Attributes:
        index: Of the step.
        dropped: How many went.
        cloned: How many were copied once.
        split: How many were replaced by their children.
        points: After the edit.
    """

    index: int
    dropped: int
    cloned: int
    split: int
    points: int


@dataclass(frozen=True)
class FileWritten:
    """A file of the run folder is complete.

    Attributes:
        path: Where it is.
        what: What it is, in a few words.
    """

    path: Path
    what: str


@dataclass(frozen=True)
class Progress:
    """Part of a piece of work with a known end is done. Told as often as there is something to tell.

    Attributes:
        what: The work, in a few words, such as "fusing views".
        done: So far.
        total: When it ends.
    """

    what: str
    done: int
    total: int


@dataclass(frozen=True)
class Warned:
    """Something the user should know that does not stop the run.

    Attributes:
        text: One sentence.
    """

    text: str


@dataclass(frozen=True)
class PhotoSkipped:
    """A photograph cannot be read, and the run goes on without it.

    Attributes:
        name: As the data set spells it.
        reason: What is wrong with it.
    """

    name: str
    reason: str


@dataclass(frozen=True)
class Measured:
    """Renders of held-out photographs were measured along the way.

    Attributes:
        index: Of the step.
        psnr: Of each photograph, dB, by its name.
    """

    index: int
    psnr: Mapping[str, float]


@dataclass(frozen=True)
class MemoryTaken:
    """What the most memory that was held so far in a run, or in a stage of it, was taken by.

    Attributes:
        parts: Bytes by part, and "peak" for all of them together.
        gpu: The same of the memory of the GPU; empty without one.
    """

    parts: Mapping[str, int]
    gpu: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class StageEnded:
    """An optimisation run is complete.

    Attributes:
        stage: Its name in the recipe.
        steps: How many were made.
        points: At the end.
        seconds: Wall time since it began or went on.
    """

    stage: str
    steps: int
    points: int
    seconds: float


Event = (
    StageBegan
    | StepDone
    | PointsEdited
    | FileWritten
    | Progress
    | Warned
    | PhotoSkipped
    | Measured
    | MemoryTaken
    | StageEnded
)


def say(text: str) -> None:
    """Tell the person who watches."""
    print(printable(text), file=sys.stderr)


_silenced: set[tuple[str, int]] = set()
"""Observers that raised, by plugin name and identity of the plugin."""


_READING_AGAIN: ContextVar[bool] = ContextVar("again", default=False)


@contextmanager
def reading_again() -> Iterator[None]:
    """Within, in this thread, nobody hears warnings: they were told when the same files were read before."""
    token = _READING_AGAIN.set(True)
    try:
        yield
    finally:
        _READING_AGAIN.reset(token)


def emit(event: Any) -> None:
    """Tell every plugin what happened. One that raises is reported on stderr and not asked again: logs kill no run."""
    if _READING_AGAIN.get() and isinstance(event, Warned):
        return
    for impl in plugins().hook.surfkit_event.get_hookimpls():
        key = (impl.plugin_name, id(impl.plugin))
        if key in _silenced:
            continue
        try:
            impl.function(*[event] * len(impl.argnames))
        except Exception as error:
            _silenced.add(key)
            say(
                f"surfkit: plugin {impl.plugin_name} failed at {type(event).__name__} and gets no more events: "
                f"{type(error).__name__}: {' '.join(str(error).split())}"
            )
