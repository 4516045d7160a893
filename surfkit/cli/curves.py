"""`surfkit curves`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.cli.table import print_table
from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.chart import write_lines
from surfkit.report.curves import Place, What, lines

TITLES = {"points": "points", "loss": "sum of the weighted losses", "memory": "most memory held so far, GB"}


@dataclass(frozen=True)
class Curves:
    """Draw how the points, the loss or the memory of runs went, step by step, into one chart.

    Such as the count of points while a block is tuned, with and without a filter (CityGaussianV2, figure 3).
    """

    run_folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folders that `surfkit train` made."""

    of: What = "points"
    """What to draw."""

    block: int | None = None
    """Draw the tuning of this block, instead of the first stage of the run."""

    refinement: int | None = None
    """Draw this refinement of the model, such as 0, instead."""

    out: Path = Path("curves.png")
    """The picture."""

    def run(self) -> None:
        """Draw, and tell where each line began, was highest and ended."""
        if self.block is not None and self.refinement is not None:
            raise BadInput("--block and --refinement: give one of them")
        place = None if self.block is None else Place("block", self.block)
        place = place if self.refinement is None else Place("refinement", self.refinement)
        found = lines(self.run_folders, self.of, place)
        where = f" of {place.kind} {place.index}" if place else ""
        write_lines(self.out, found, TITLES[self.of] + where, "steps")
        shown = "{:,.0f}".format if self.of == "points" else "{:.4g}".format
        rows = [(line.name, *map(shown, (line.y[0], line.y.max(), line.y[-1]))) for line in found]
        print_table(("run", "first", "highest", "last"), rows)
        print(f"wrote {self.out}")


COMMAND = Curves
