"""Somebody who looks at a stage between its steps, such as the page of `surfkit train --view`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from surfkit.core.events import say
from surfkit.raster.api import Maps
from surfkit.scene.scene import Scene, View
from surfkit.train.state import StageState


@dataclass(frozen=True)
class Watched:
    """A stage that runs in this process.

    Attributes:
        title: What is being done, for people.
        folder: Where its journal lies.
        scene: Its data.
        draw: Maps of a view with the points as they are now; the geometry only if the second argument says so. To be
            called between two steps only, in the thread of the training.
        stopping: Whether the run was asked to stop.
    """

    title: str
    folder: Path
    scene: Scene
    draw: Callable[[View, bool], Maps]
    stopping: Callable[[], bool]


class Watcher(Protocol):
    """Who looks. All is called in the thread of the training, which waits meanwhile."""

    def begin(self, stage: Watched) -> None:
        """A stage begins, or goes on after an interruption."""

    def look(self, index: int, psnr: float | None) -> None:
        """Step `index` is done, and no other is made until this returns; PSNR: mean of the last training views, dB."""

    def end(self) -> None:
        """No further step of the stage is made here."""


_WATCHER: ContextVar[Watcher | None] = ContextVar("watcher", default=None)


@contextmanager
def watched_by(watcher: Watcher) -> Iterator[None]:
    """Within, `watcher` is told of all stages that run in this thread. If it fails, the training goes on without it."""
    token = _WATCHER.set(_Guarded(watcher))
    try:
        yield
    finally:
        _WATCHER.reset(token)


@contextmanager
def watched(stage: Watched) -> Iterator[Callable[[int, float | None], None] | None]:
    """Within, a stage is watched; gives `Watcher.look`, or None if nobody looks."""
    watcher = _WATCHER.get()
    if watcher is None:
        yield None
        return
    watcher.begin(stage)
    try:
        yield watcher.look
    finally:
        watcher.end()


class _Guarded:
    """A watcher that is not asked again once it has failed."""

    def __init__(self, watcher: Watcher) -> None:
        self.watcher: Watcher | None = watcher

    def begin(self, stage: Watched) -> None:
        self._tell(lambda watcher: watcher.begin(stage))

    def look(self, index: int, psnr: float | None) -> None:
        self._tell(lambda watcher: watcher.look(index, psnr))

    def end(self) -> None:
        self._tell(lambda watcher: watcher.end())

    def _tell(self, action: Callable[[Watcher], None]) -> None:
        if self.watcher is None:
            return
        try:
            action(self.watcher)
        except Exception as error:
            self.watcher = None
            said = " ".join(f"{type(error).__name__}: {error}".split())
            say(f"surfkit: what watches the training has failed, and the training goes on without it: {said}")


class Stopwatch:
    """Adds the time of steps to a state; time in which it is stopped does not count."""

    def __init__(self, state: StageState) -> None:
        """Begin now."""
        self.state = state
        self.start()

    def start(self) -> None:
        """Count from now on."""
        self.wall, self.cpu = time.perf_counter(), time.process_time()

    def lap(self) -> None:
        """Add what has gone by since it was started, or since the last lap."""
        self.state.seconds += time.perf_counter() - self.wall
        self.state.cpu_seconds += time.process_time() - self.cpu
        self.start()

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Within, no time counts."""
        self.lap()
        try:
            yield
        finally:
            self.start()
