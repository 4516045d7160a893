"""How numbers of a run went from step to step, from its journal."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from surfkit.core import journal
from surfkit.core.check import BadInput
from surfkit.evaluate.chart import COLORS, Line

What = Literal["points", "loss", "memory"]
DOTS = 300
"""A line has no more of them; each is the mean over the steps since the one before."""


def curve(out: Path, what: What, block: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(T,) steps and (T,) numbers of a run: of its first stage, or of a block. Memory in GB.

    Raises:
        BadInput: There is no such run or block, or it has made no step.
    """
    if not (out / "recipe.json").exists():
        raise BadInput(f"{out}: no run folder (no recipe.json in it); name one that surfkit train made")
    folder = out if block is None else out / "blocks" / f"{block:03}"
    if block is not None and not folder.is_dir():
        there = sorted(int(path.name) for path in (out / "blocks").glob("[0-9]*"))
        raise BadInput(
            f"{out}: no block {block} is begun; {f'there are {there[0]} to {there[-1]}' if there else 'none is'}"
        )
    done = [line for line in journal.read(folder / journal.NAME) if line["event"] == "StepDone"]
    try:
        rows = np.array([(line["index"], _number(line, what)) for line in done], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{folder / journal.NAME}: a step without its {what}; the file is damaged") from error
    if not len(rows):
        raise BadInput(f"{folder / journal.NAME}: no step is made yet")
    pieces = np.array_split(rows, min(DOTS, len(rows)))
    steps, values = np.array([(piece[-1, 0], piece[:, 1].mean()) for piece in pieces]).T
    return steps, values


def lines(outs: tuple[Path, ...], what: What, block: int | None = None) -> list[Line]:
    """A line for each run, named after its folder."""
    if not outs:
        raise BadInput("curves: name one or more run folders")
    found = []
    for at, out in enumerate(outs):
        steps, values = curve(out, what, block)
        found.append(Line(out.resolve().name, steps, values, COLORS[at % len(COLORS)]))
    return found


def _number(line: dict, what: What) -> float:
    if what == "loss":
        return float(sum(line["losses"].values()))
    return float(line["points"] if what == "points" else line["peak_memory_bytes"] / 1e9)
