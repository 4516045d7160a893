"""What a person sees while a stage runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from surfkit.core.clock import clock
from surfkit.core.memory import peak_memory_bytes
from surfkit.raster.nvrtc.gpu_memory import peak_gpu_bytes
from surfkit.raster.psnr import psnr
from surfkit.train.trainer import CompletedStep

BAR_LINE_EVERY_S = 5.0
"""Between two lines where there is no terminal to draw on."""
BAR_EVERY_S = 0.1
OUTER_EVERY_S = 0.5
"""Between two looks of a larger display, which has more to draw."""
PSNR_EVERY = 10
"""Steps between two looks at the PSNR of the training view at hand."""
SMOOTHING = 0.95
"""Share of the past in a smoothed number."""

Draw = Callable[[str, int, int, str], None]
"""Gets a stage, its step, its number of steps, and its other numbers in words."""
_OUTER: ContextVar[Draw | None] = ContextVar("outer", default=None)


@contextmanager
def outer(draw: Draw) -> Iterator[None]:
    """Within, displays hand their numbers to `draw` instead of drawing: a terminal has room for one live display."""
    token = _OUTER.set(draw)
    try:
        yield
    finally:
        _OUTER.reset(token)


def larger() -> Draw | None:
    """The larger display that has the terminal, if there is one."""
    return _OUTER.get()


class TrainingDisplay:
    """Step, speed, time left, points, loss, PSNR and memory: a live bar on a terminal, else a line every few seconds.

    Loss, PSNR and speed are running means; the PSNR is that of training views.
    """

    def __init__(self, stage: str, steps: int, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self.stage, self.steps = stage, steps
        self.outer = _OUTER.get()
        self.every = OUTER_EVERY_S if self.outer else BAR_EVERY_S if self.console.is_terminal else BAR_LINE_EVERY_S
        self.loss, self.psnr, self.pace = RunningMean(), RunningMean(), RunningMean()
        self.last, self.drawn = time.perf_counter(), 0.0
        self.bar: Progress | None = None
        self.task: TaskID | None = None

    def __enter__(self) -> TrainingDisplay:
        if self.outer is None and self.console.is_terminal:
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=20),
                TextColumn("{task.fields[line]}", markup=False),
            )
            self.bar = Progress(*columns, console=self.console, auto_refresh=False)
            self.task = self.bar.add_task(self.stage, total=self.steps, line="")
            self.bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self.bar is not None:
            self.bar.stop()

    def show(self, done: CompletedStep) -> None:
        """Take in one step; draw when it is time."""
        self.loss.add(sum(done.losses.values()))
        last = done.index == self.steps
        if done.index % PSNR_EVERY == 0 or last:
            self.psnr.add(psnr(done.shown(), done.target.photo))
        now = time.perf_counter()
        self.pace.add(now - self.last)
        self.last = now
        if now - self.drawn < self.every and not last:
            return
        self.drawn = now
        line = self.line(done)
        if self.outer is not None:
            self.outer(self.stage, done.index, self.steps, line)
        elif self.bar is None or self.task is None:
            self.console.print(f"{self.stage}  {line}", highlight=False, soft_wrap=True, markup=False)
        else:
            self.bar.update(self.task, completed=done.index, line=line)
            self.bar.refresh()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Within, time does not count for the speed."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.last += time.perf_counter() - began

    def line(self, done: CompletedStep) -> str:
        """The numbers of a step, in words."""
        parts = [
            f"step {done.index}/{self.steps}",
            f"{1 / max(self.pace.value, 1e-9):.1f} it/s",
            f"{clock((self.steps - done.index) * self.pace.value)} left",
            f"{done.points:,} points",
            f"loss {self.loss.value:.4f}",
        ]
        parts += [f"training PSNR {self.psnr.value:.2f} dB"] * (self.psnr.count > 0)
        parts += [f"{memory / 2**30:.1f} GiB" for memory in [peak_memory_bytes()] if memory]
        parts += [f"GPU {memory / 2**30:.1f} GiB" for memory in [peak_gpu_bytes()] if memory]
        return "  ".join(parts)


class RunningMean:
    """A running mean that forgets; exact over its first values."""

    def __init__(self) -> None:
        self.value, self.count = 0.0, 0

    def add(self, value: float) -> None:
        """Take in a value."""
        self.count += 1
        self.value += (value - self.value) * max(1 - SMOOTHING, 1 / self.count)
