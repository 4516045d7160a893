"""`surfkit ablate`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.cli.table import print_table
from surfkit.cli.tables import chosen_table
from surfkit.core.check import BadInput
from surfkit.raster.select import Device
from surfkit.readers.data import Data
from surfkit.report.ablation import Table
from surfkit.report.screen import Screen
from surfkit.report.study import Plan, ablate
from surfkit.report.table import LEGEND, STACKED, drawing, failures, lines
from surfkit.report.truth import Truth


@dataclass(frozen=True)
class Ablate:
    """Train every row of an ablation table on the same data, and compare each row with the one it is built on.

    Rows with the same recipe are trained once. An interrupted table continues when the same command is given again;
    with more seeds or rows, finished runs are kept. A row that fails does not stop the others.
    """

    table: Annotated[Table, chosen_table]
    """Ablation table."""

    data: Annotated[Data, tyro.conf.arg(name="")]
    """Data set."""

    steps: int | None = None
    """Optimisation steps of each run; schedules are scaled by the same factor. With fewer than 1,000 steps the model is
    hardly densified, and rows differ little."""

    max_points: int | None = None
    """Largest number of points of every row, so that rows are compared at equal size and fit into memory."""

    seeds: int = 1
    """Number of runs of each row, with seeds 0, 1, 2 and so on; with several, differences have a standard error."""

    gt: Path | None = None
    """Ground truth, a mesh or a point cloud: the mesh of every row is compared with it, for F1, in the same crop
    volume. Rows without a mesher get mesh:tsdf then."""

    tau: float | None = None
    """With --gt: distance threshold below which a point counts as correct, in units of the ground truth. Required when
    the ground truth is a mesh."""

    rows: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: all)")] = ()
    """Run only these rows, by number or label; finished results of the other rows are shown, too."""

    out: Path | None = None
    """Folder of the results. Default: runs/DATA-ablate-TABLE."""

    device: Device = "auto"
    """Device for training and rendering: auto, cpu, cuda, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    def run(self) -> int:
        """Run the table and show it; 1 if a row failed."""
        out = self.out or Path("runs") / f"{self.data.path.resolve().name}-ablate-{self.table.name}"
        if self.tau is not None and self.gt is None:
            raise BadInput(f"--tau {self.tau:g}: it needs --gt; add --gt, or leave it out")
        truth = None if self.gt is None else Truth(self.gt, self.tau)
        plan = Plan(self.table, self.data, out, self.steps, self.seeds, self.rows, self.device, self.max_points, truth)
        try:
            with Screen() as screen:
                report = ablate(plan, screen)
        except KeyboardInterrupt:
            print(f"{out} keeps what is finished; give the same command again to continue", file=sys.stderr)
            raise
        show(report)
        print()
        written = [("results", out / "ablation.json"), ("table", out / "ablation.md"), ("runs", out / "runs")]
        print_table(("written", "path"), [(what, str(path)) for what, path in written])
        for failure in failures(report):
            print(f"surfkit: {failure}", file=sys.stderr)
        return 1 if failures(report) else 0


def show(report: dict[str, Any]) -> None:
    """Print the table: fitted to a terminal, else one line a row."""
    if not sys.stdout.isatty():
        print_table(*lines(report))
        return
    from rich.console import Console

    console = Console()
    console.print(drawing(report))
    console.print(f"\n{LEGEND} {STACKED}", style="dim")


COMMAND = Ablate
