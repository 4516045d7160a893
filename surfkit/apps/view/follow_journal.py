"""What a run tells in its folder while it goes on, whichever process or machine makes its steps."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.runs import journal
from surfkit.runs.execute.block_state import STALE_S, BlockState, read_state
from surfkit.study.run_curves import thinned

SPEED_OVER = 20
"""Steps of whose times the speed is the mean."""


@dataclass
class StageHistory:
    """A stage as its journal tells it, up to now.

    Attributes:
        title: Of the stage, for people.
        steps: How many it has; 0 if that is not known.
        points: After the last step.
        times: Of each step, seconds since 1970.
        rows: Step, then the losses by name, of each step.
        held_out: Step, and mean PSNR of the held-out photographs that were measured then, dB.
    """

    title: str = ""
    steps: int = 0
    points: int = 0
    times: list[float] = field(default_factory=list)
    rows: list[tuple[int, dict[str, float]]] = field(default_factory=list)
    held_out: list[tuple[int, float]] = field(default_factory=list)

    @property
    def index(self) -> int:
        """The last step."""
        return self.rows[-1][0] if self.rows else 0

    @property
    def speed(self) -> float | None:
        """Steps per second, lately; None before there are two."""
        last = self.times[-SPEED_OVER:]
        return (len(last) - 1) / (last[-1] - last[0]) if len(last) > 1 and last[-1] > last[0] else None

    def add(self, line: dict[str, Any]) -> None:
        """Take in a line of a journal."""
        kind = line["event"]
        if kind == "StageBegan":
            block = line.get("block")
            self.title = str(line["stage"]) if block is None else f"block {block}"
            self.steps, self.points = int(line["steps"]), int(line["points"])
        elif kind == "StepDone":
            row = int(line["index"]), {name: float(value) for name, value in line["losses"].items()}
            self.steps, self.points = int(line["steps"]), int(line["points"])
            self.rows.append(row)
            self.times.append(float(line["time"]))
        elif kind == "Measured" and line["psnr"]:
            self.held_out.append((int(line["index"]), float(np.mean(list(line["psnr"].values())))))

    def losses(self) -> dict[str, np.ndarray]:
        """(T,) steps under "step"; by name the (T,) means of each loss, and of all, since the step before."""
        names = sorted({name for _, losses in self.rows for name in losses})
        steps = [index for index, _ in self.rows]
        columns = {"all": [sum(losses.values()) for _, losses in self.rows]}
        if len(names) > 1:
            columns |= {name: [losses.get(name, 0.0) for _, losses in self.rows] for name in names}
        thin = {name: thinned(np.column_stack([steps, values])) for name, values in columns.items()}
        return {"step": thin["all"][0], **{name: values for name, (_, values) in thin.items()}}


class JournalFollower:
    """Reads what a journal got since it was last read, and all of it if steps were taken back."""

    def __init__(self, folder: Path) -> None:
        """Nothing is read yet."""
        self.path = folder / journal.JOURNAL_FILE
        self.history = StageHistory()
        self.file: int | None = None
        self.at = 0

    def read(self) -> bool:
        """Bring `history` up to date; whether there was anything new."""
        try:
            with self.path.open("rb") as file:
                about = os.fstat(file.fileno())
                if about.st_ino != self.file or about.st_size < self.at:
                    self.history, self.file, self.at = StageHistory(), about.st_ino, 0
                file.seek(self.at)
                fresh = file.read()
        except OSError:  # it is being replaced, or the file system is away
            return False
        whole = fresh[: fresh.rfind(b"\n") + 1]
        self.at += len(whole)
        for line in journal.lines(whole):
            try:
                self.history.add(line)
            except (AttributeError, KeyError, TypeError, ValueError):
                continue  # a damaged line is a dot less
        return bool(whole)


def journals(out: Path) -> dict[str, Path]:
    """Folders of the journals of a run by what they are of, the one that was written last at the end."""
    found = [out, *out.glob("partition"), *block_folders(out), *out.glob("refine[0-9]*")]
    times = {}
    for folder in found:
        try:
            times[folder] = (folder / journal.JOURNAL_FILE).stat().st_mtime
        except OSError:
            continue
    return {_name(out, folder): folder for folder in sorted(times, key=times.__getitem__)}


def _name(out: Path, folder: Path) -> str:
    if folder == out:
        return "whole scene"
    return f"block {int(folder.name)}" if folder.parent.name == "blocks" else folder.name


def block_folders(out: Path) -> list[Path]:
    """Folders of the blocks, by number."""
    return sorted(path for path in out.glob("blocks/[0-9]*") if path.name.isdecimal())


def running_blocks(out: Path) -> dict[int, BlockState]:
    """Blocks that are being trained, by any process, by number."""
    found = {}
    for folder in block_folders(out):
        try:
            state = read_state(folder)
        except (BadInput, OSError):
            continue
        if state.status == "running" and time.time() - state.heard < STALE_S:
            found[int(folder.name)] = state
    return found


def newest_pictures(out: Path) -> list[Path]:
    """The pictures of held-out views that the run has written last, in progress/."""
    folders = sorted(path for path in out.glob("progress/[0-9]*") if path.is_dir())
    return sorted(folders[-1].rglob("*.png")) if folders else []
