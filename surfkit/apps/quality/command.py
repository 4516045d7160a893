"""`surfkit quality`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.apps.quality.pdf_writer import require_reportlab
from surfkit.apps.quality.report import DEFAULT_HTML, write_quality
from surfkit.cli.console_table import print_table
from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.runs.run_notes import collect_notes
from surfkit.train.progress_bars import bars


@dataclass(frozen=True)
class QualityCommand:
    """Write the quality report of a survey, as surveyors know it, as one HTML file and as PDF.

    Its first page is for the client: maps, area, ground sampling distance, accuracy, warnings. Then follow the overlap,
    residuals of positions and of control and check points, the calibration of the cameras with standard deviations,
    tie points, the surface, and how all was made. What is not known is named, with how to get it.

    `surfkit report` tells of training instead: losses, views, memory, comparisons of runs.
    """

    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DELIVERY|RUN")]
    """Folder that `surfkit make` or `surfkit train` made, or a scene of `surfkit prepare photos`."""

    out: Path | None = None
    """HTML file to write; the PDF has the same name with .pdf. Default: quality_report.html in the folder."""

    pdf: bool = True
    """Write the PDF too. It needs the package reportlab."""

    def run(self) -> None:
        """Write the files, and print their paths and sizes."""
        out = self.out or self.target / DEFAULT_HTML
        if out.is_dir():
            raise BadInput(f"--out {out}: a folder; name a file, such as {out / DEFAULT_HTML}")
        if out.suffix.lower() not in (".html", ".htm"):
            raise BadInput(f"--out {out}: it names the HTML file, so it ends with .html; the PDF is written beside it")
        with collect_notes(), bars():
            written = write_quality(self.target, out, self.pdf and can_write_pdf())
        print_table(("written", "size"), [(str(path), f"{path.stat().st_size / 1e6:.2f} MB") for path in written])


def can_write_pdf() -> bool:
    """Whether reportlab is there; says what to install where it is not."""
    try:
        require_reportlab()
    except BadInput as error:
        say(f"no PDF: {error}; the HTML file prints well too")
        return False
    return True


COMMAND = QualityCommand
