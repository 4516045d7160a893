"""Progress of blocks that other processes train: a table on a terminal, else a line from time to time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from surfkit.core.check import BadInput, printable
from surfkit.core.clock import clock
from surfkit.runs.blocks.eta import describe_progress, seconds_elapsed, seconds_left, total_seconds_left
from surfkit.runs.execute.block_state import BlockState, read_state
from surfkit.train.progress import larger

BOARD_EVERY_S = 1.0
BOARD_LINE_EVERY_S = 30.0
"""Between two lines where there is no terminal to draw on."""


@dataclass(frozen=True)
class BlockProgress:
    """The progress of all blocks.

    Attributes:
        states: Of each block with views, by number.
        steps: Of each, up to the end of the round if blocks are tuned in rounds.
        at_once: How many run at a time.
    """

    states: Mapping[int, BlockState]
    steps: int
    at_once: int = 1

    @property
    def done(self) -> int:
        """Blocks that are done, or wait for the others at the end of a round."""
        ended = ("done", "planned")
        return sum(state.status in ended and state.step >= self.steps for state in self.states.values())

    def summary(self) -> str:
        """All blocks in one phrase: 3 of 20 blocks done, about 2:10:00 left."""
        left = total_seconds_left(list(self.states.values()), self.steps, self.at_once)
        text = f"{self.done} of {len(self.states)} blocks done"
        return text if left is None else f"{text}, about {clock(left)} left"

    def line(self) -> str:
        """All running blocks, in one line."""
        working = [f"block {at}: {describe_progress(s)}" for at, s in self.states.items() if s.status == "running"]
        return "; ".join([self.summary(), *working])


def read_state_since(folder: Path, since: float) -> BlockState:
    """The state of the block in a folder; planned if it has sent no heartbeat since then, in seconds since 1970."""
    try:
        state = read_state(folder)
    except (BadInput, OSError):  # damaged, or gone just now
        return BlockState()
    return replace(state, status="planned") if state.heard < since and state.status != "done" else state


class BlockDisplay:
    """Reads the states of blocks periodically, in a thread, and shows their progress."""

    def __init__(self, look: Callable[[], BlockProgress], console: Console | None = None) -> None:
        """Show what `look` returns."""
        self.look = look
        self.console = console or Console(stderr=True)
        self.outer = larger()
        self.live: Live | None = None
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.watch, name="block display", daemon=True)

    def __enter__(self) -> BlockDisplay:
        if self.outer is None and self.console.is_terminal:
            self.live = Live(console=self.console, auto_refresh=False, transient=True)
            self.live.start()
        self.thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.over.set()
        self.thread.join()
        if self.live is not None:
            self.live.stop()

    def watch(self) -> None:
        """Show, until it is over."""
        intervals = BOARD_EVERY_S if self.live or self.outer else BOARD_LINE_EVERY_S
        while not self.over.wait(intervals):
            self.show(self.look())

    def show(self, now: BlockProgress) -> None:
        """Show the progress of the blocks."""
        if self.outer is not None:
            made = sum(min(state.step, now.steps) for state in now.states.values())
            self.outer("blocks", made, len(now.states) * now.steps, now.summary())
        elif self.live is not None:
            self.live.update(progress_table(now), refresh=True)
        else:
            self.console.print(now.line(), highlight=False, soft_wrap=True, markup=False)


def progress_table(now: BlockProgress) -> Table | Text:
    """A row for each block that runs or has failed; the others are only counted."""
    shown = {index: state for index, state in now.states.items() if state.status in ("running", "failed")}
    if not shown:
        return Text(now.summary())
    drawn = Table(title=now.summary(), title_justify="left", box=None, padding=(0, 2, 0, 0))
    for name in ("block", "", "step", "time", "left", ""):
        drawn.add_column(name, justify="right" if name in ("step", "time", "left") else "left")
    for index, state in shown.items():
        times = [clock(s) if s is not None else "" for s in (seconds_elapsed(state), seconds_left(state))]
        silent = time.time() - state.heard
        word = (state.error or "") if state.status == "failed" else f"silent for {clock(silent)}" * (silent > 60)
        notes = "; ".join(filter(None, (word, *state.reduced)))
        bar = ProgressBar(max(1, state.steps), state.step, width=20)
        drawn.add_row(str(index), bar, f"{state.step:,}/{state.steps:,}", *times, Text(printable(notes)))
    return drawn
