"""What a person sees while an ablation table is run."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from surfkit.core.check import printable
from surfkit.core.events import say
from surfkit.study.metric_columns import TABLE_COLUMNS
from surfkit.study.rows import Trial, TrialResult
from surfkit.study.table_text import data_names, drawing
from surfkit.train.progress import outer

TOLD = {"psnr": "PSNR {} dB", "ssim": "SSIM {}", "lpips": "LPIPS {}", "f1": "F1 {}", "points": "{} points"}
"""What is told of a run that has ended, as far as it was measured."""


class AblationScreen:
    """A table that fills itself, with the progress of the run at hand below it; lines where there is no terminal."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or Console(stderr=True)
        self.live: Live | None = None
        self.report: Mapping[str, Any] = {}
        self.label, self.heading = "", ""
        self.headings: dict[Path, str] = {}
        self.within = ExitStack()

    def __enter__(self) -> AblationScreen:
        if self.console.is_terminal:
            live = Live(console=self.console, auto_refresh=False, transient=True)
            self.live = self.within.enter_context(live)
            self.within.enter_context(outer(self.progress))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.within.close()

    def begin(self, trial: Trial, at: int, count: int, report: Mapping[str, Any]) -> None:
        """See `Watch.begin`."""
        self.report, self.label = report, trial.label
        paths = [entry["data"]["path"] for entry in report["data_sets"]]
        names = dict(zip(paths, data_names(report), strict=True))
        where = f" on {names[str(trial.data.path.resolve())]}" if len(names) > 1 else ""
        self.heading = f"run {at} of {count}: {trial.label}, seed {trial.seed}{where}"
        self.headings[trial.folder] = self.heading
        if self.live is None:
            say(f"{self.heading}, in {trial.folder}")
        else:
            self.draw(Text(printable(self.heading)))

    def progress(self, stage: str, index: int, steps: int, line: str) -> None:
        """Show how far the run at hand is."""
        bar = Table.grid(padding=(0, 2, 0, 0))
        bar.add_row(stage, ProgressBar(steps, index, width=20), line)
        self.draw(Group(Text(printable(self.heading)), bar))

    def end(self, trial: Trial, outcome: TrialResult, report: Mapping[str, Any]) -> None:
        """See `Watch.end`."""
        self.report, heading = report, self.headings[trial.folder]
        if outcome.failed is not None:
            say(f"{heading}: failed: {outcome.failed}")
        elif self.live is None and outcome.figures is not None:
            found = outcome.figures
            told = [text.format(TABLE_COLUMNS[name].text(found[name])) for name, text in TOLD.items() if name in found]
            say(f"{heading}: {', '.join(told)}, {found['seconds'] / 60:.1f} minutes")

    def draw(self, below: Any) -> None:
        """Show the table with something below it."""
        assert self.live is not None
        self.live.update(Group(drawing(self.report, self.label), Text(), below), refresh=True)
