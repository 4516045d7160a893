"""`surfkit curves`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.line_plot import write_lines
from surfkit.study.run_curves import StageRef, What, lines

TITLES = {"points": "points", "loss": "sum of the weighted losses", "memory": "most memory held so far, GB"}


@dataclass(frozen=True)
class CurvesCommand:
    """Draw a chart of the points, the loss or the memory of runs over the steps.

    Example: the number of points while a block is trained, with and without a filter (CityGaussianV2, figure 3).
    """

    run_folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folders that `surfkit train` made."""

    of: What = "points"
    """Quantity to draw."""

    block: int | None = None
    """Draw the training of this block instead of the first stage of the run."""

    refinement: int | None = None
    """Draw this refinement of the model, counted from 0, instead."""

    out: Path = Path("curves.png")
    """PNG file to write."""

    def run(self) -> None:
        """Draw, and print the first, highest and last value of each line."""
        if self.block is not None and self.refinement is not None:
            raise BadInput("--block and --refinement: give one of them")
        place = None if self.block is None else StageRef("block", self.block)
        place = place if self.refinement is None else StageRef("refinement", self.refinement)
        found = lines(self.run_folders, self.of, place)
        where = f" of {place.kind} {place.index}" if place else ""
        write_lines(self.out, found, TITLES[self.of] + where, "steps")
        shown = "{:,.0f}".format if self.of == "points" else "{:.4g}".format
        rows = [(line.name, *map(shown, (line.y[0], line.y.max(), line.y[-1]))) for line in found]
        print_table(("run", "first", "highest", "last"), rows)
        tell(f"wrote {self.out}")


COMMAND = CurvesCommand
