"""How numbers of a run went from step to step, from its journal."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.line_plot import PlotLine
from surfkit.runs import journal

What = Literal["points", "loss", "memory"]
DOTS = 300
"""A line has no more of them; each is the mean over the steps since the one before."""


@dataclass(frozen=True)
class StageRef:
    """A part of a run whose steps are counted on their own.

    Attributes:
        kind: "block" or "refinement".
        index: Which one, counted from 0.
    """

    kind: Literal["block", "refinement"]
    index: int

    def folder(self, out: Path) -> Path:
        """Where its journal lies.

        Raises:
            BadInput: It is not begun.
        """
        before = {"block": "blocks/", "refinement": "refine"}[self.kind]
        names = {path: path.name.removeprefix("refine") for path in out.glob(f"{before}[0-9]*")}
        found = {int(name): path for path, name in names.items() if name.isdecimal()}
        if self.index not in found:
            there = f"there are {min(found)} to {max(found)}" if found else "none is"
            raise BadInput(f"{out}: no {self.kind} {self.index} is begun; {there}")
        return found[self.index]


def curve(out: Path, what: What, place: StageRef | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(T,) steps and (T,) numbers of a run: of its first stage, or of one of its parts. Memory in GB.

    Raises:
        BadInput: There is no such run or part, or it has made no step.
    """
    if not (out / "recipe.json").exists():
        raise BadInput(f"{out}: no run folder (no recipe.json in it); name one that surfkit train made")
    folder = out if place is None else place.folder(out)
    done = [line for line in journal.read(folder / journal.JOURNAL_FILE) if line["event"] == "StepDone"]
    try:
        rows = np.array([(line["index"], _number(line, what)) for line in done], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{folder / journal.JOURNAL_FILE}: a step without its {what}; the file is damaged") from error
    if not len(rows):
        raise BadInput(f"{folder / journal.JOURNAL_FILE}: no step is made yet, or the method of the run makes none")
    if what == "points" and not rows[:, 1].any():
        raise BadInput(f"{out}: the method of the run has no points; draw --of loss")
    return thinned(rows)


def thinned(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T,) steps and (T,) values of at most `DOTS` dots, out of (N, 2) steps and values, N at least 1."""
    pieces = np.array_split(rows, min(DOTS, len(rows)))
    steps, values = np.array([(piece[-1, 0], piece[:, 1].mean()) for piece in pieces]).T
    return steps, values


def lines(outs: tuple[Path, ...], what: What, place: StageRef | None = None) -> list[PlotLine]:
    """A line for each run, named after its folder."""
    if not outs:
        raise BadInput("curves: name one or more run folders")
    found = []
    for out in outs:
        steps, values = curve(out, what, place)
        found.append(PlotLine(out.resolve().name, steps, values))
    return found


def _number(line: dict, what: What) -> float:
    if what == "loss":
        return float(sum(line["losses"].values()))
    return float(line["points"] if what == "points" else line["peak_memory_bytes"] / 1e9)
