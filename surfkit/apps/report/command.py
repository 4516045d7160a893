"""`surfkit report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.apps.report.report_page import DEFAULT_FILE, ReportOptions, write_report
from surfkit.cli.console_table import print_table
from surfkit.core.check import BadInput


@dataclass(frozen=True)
class ReportCommand:
    """Write a report of runs or of an ablation table as one HTML file, which needs no network.

    It shows figures, notes, held-out views against their photographs, mesh and geometry, curves, time and memory,
    blocks, settings and what runs differ in, from what the folders hold: no model is loaded and nothing is measured
    again. A run that is not finished is shown as far as it has come.
    """

    targets: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN|TABLE")]
    """Folders that `surfkit train` made, or one folder that `surfkit ablate` made."""

    out: Path | None = None
    """HTML file to write. Default: report.html in the first folder."""

    views: int = 3
    """Number of held-out views that are shown as pictures, from the lowest PSNR to the highest."""

    pictures: bool = True
    """Show pictures. Without them the file is small."""

    def run(self) -> None:
        """Write the file, and print its path and size."""
        if not self.targets:
            raise BadInput("report: name one or more run folders, or the folder of a table")
        out = self.out or self.targets[0] / DEFAULT_FILE
        if out.is_dir():
            raise BadInput(f"--out {out}: a folder; name a file, such as {out / DEFAULT_FILE}")
        size = write_report(self.targets, out, ReportOptions(self.views, self.pictures))
        print_table(("written", "size"), [(str(out), f"{size / 1e6:.2f} MB")])


COMMAND = ReportCommand
