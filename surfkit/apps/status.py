"""`surfkit status`."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput
from surfkit.core.clock import clock
from surfkit.runs.blocks.eta import seconds_elapsed, seconds_left
from surfkit.runs.run_status import BlockStatus, Status, as_json, status

UNFINISHED_STATUS = 3
MAX_SILENT_S = 60.0
"""A block that is worked on gives signs of life more often."""


@dataclass(frozen=True)
class StatusCommand:
    """Show the progress of a run: step, speed, time left, memory, measurements, notes, and its processes.

    Exit status: 0 when the run is finished, 3 when it is not, 2 when there is no run.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    json: bool = False
    """Print JSON instead of a table."""

    def run(self) -> int:
        """Print the progress."""
        found = status(self.run_folder)
        if self.json:
            print(as_json(found))
        else:
            print_table(("what", "value"), rows(found))
            if found.state == "stopped":
                tell_how_to_go_on(self.run_folder)
        return 0 if found.state == "finished" else UNFINISHED_STATUS


def rows(found: Status) -> list[tuple[str, str]]:
    """The rows of the table; what is not known is left out."""
    table: list[tuple[str, str]] = [("state", f"{found.state}{f', {found.process}' if found.process else ''}")]
    if found.steps:
        table.append(("step", f"{found.step:,} of {found.steps:,}{f' of {found.stage}' if found.stage else ''}"))
    if found.saved_step is not None:
        table.append(("last checkpoint", f"step {found.saved_step:,}"))
    if found.steps_per_second is not None:
        table.append(("speed", f"{found.steps_per_second:.1f} it/s"))
    if found.seconds_left is not None:
        minutes, seconds = divmod(round(found.seconds_left), 60)
        table.append(("time left", f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"))
    if found.points:
        table.append(("points", f"{found.points:,}"))
    if found.loss is not None:
        table.append(("loss", f"{found.loss:.4f}"))
    if found.peak_memory_bytes:
        table.append(("peak memory", f"{found.peak_memory_bytes / 1e6:.0f} MB"))
    if found.peak_gpu_bytes:
        table.append(("peak GPU memory", f"{found.peak_gpu_bytes / 1e6:.0f} MB"))
    if found.metrics and found.metrics["psnr"] is not None:
        when = f" after step {found.metrics['step']:,}" if "step" in found.metrics else ""
        table.append(("PSNR", f"{found.metrics['psnr']:.2f} dB of {found.metrics['views']} views{when}"))
    if found.blocks:
        done = sum(block.status == "done" for block in found.blocks)
        table.append(("blocks", f"{done} of {sum(block.views > 0 for block in found.blocks)} done"))
        table += [(f"block {block.index}", _where(block)) for block in found.blocks]
    table += [("skipped", name) for name in found.skipped]
    return table + [("note", text) for text in found.notes]


def tell_how_to_go_on(out: Path) -> None:
    """Print the command that finishes a run; nothing where run.json is of a version that kept less."""
    from surfkit.runs.command import train_command
    from surfkit.runs.pipeline import opened  # loads torch, which takes seconds

    with suppress(BadInput):
        tell(f"next: `{train_command(opened(out))}` goes on with the run")


def _where(block: BlockStatus) -> str:
    if not block.views:
        return "no views; stays as it is in the coarse model"
    kind = f" ({block.kind})" if block.kind else ""
    parts = [f"{block.status}{kind}{f': {block.error}' if block.error else ''}"]
    silent = time.time() - block.heard if block.status == "running" else 0.0
    left = seconds_left(block) if silent <= MAX_SILENT_S else None
    parts += [f"but silent for {clock(silent)}"] * (silent > MAX_SILENT_S)
    parts.append(f"step {block.step:,} of {block.steps:,}")
    parts += [clock(seconds) for seconds in [seconds_elapsed(block)] if seconds is not None]
    parts += [f"{clock(seconds)} left" for seconds in [left] if seconds is not None]
    parts.append(f"{block.views} views")
    parts += [f"attempt {block.attempts}"] * (block.attempts > 1)
    parts += [f"after running out of memory: {'; then '.join(block.reduced)}"] * bool(block.reduced)
    return ", ".join(parts)


COMMAND = StatusCommand
