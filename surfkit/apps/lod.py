"""`surfkit lod`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.apps.run_summary import lod_rows
from surfkit.cli.console_table import print_table
from surfkit.cli.recipes import part_of_run
from surfkit.compress.levels.base import LevelsOfDetail
from surfkit.compress.levels.merged_levels import MergedLevels
from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.core.registry import choice
from surfkit.raster.select import Device
from surfkit.runs.folder import Run
from surfkit.runs.journal import record_events
from surfkit.runs.make_levels import make_levels
from surfkit.runs.pipeline import loaded
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.available_memory import cache_bytes
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.progress_bars import bars


@dataclass(frozen=True)
class LodCommand:
    """Make levels of detail of a finished run, or make them again with other settings; writes the folder RUN/lod.

    Settings that are not given are those of the run's recipe. Example: `surfkit lod RUN lod:merge --lod.steps 100`.
    `surfkit evaluate RUN --lod` measures them.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    lod: Annotated[LevelsOfDetail, choice(LevelsOfDetail)] = field(
        default_factory=partial(part_of_run, "lod", MergedLevels)
    )
    """How levels are made."""

    memory: str = "auto"
    """Memory for rendered pictures, such as 1GB; auto is half of the free memory. It does not change the result."""

    metres_per_unit: float | None = None
    """Metres per unit of the data set's coordinates, if the data set does not state it. Settings in metres need it."""

    device: Device = "auto"
    """Device for rendering."""

    def __post_init__(self) -> None:
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < float("inf"):
            raise BadInput(f"--metres-per-unit {self.metres_per_unit:g}: it must be more than 0")

    def run(self) -> None:
        """Make the levels, and print what they are."""
        budget = cache_bytes(self.memory, "--memory")
        with collect_notes(), bars(), loaded(self.run_folder, self.device) as (ctx, made):
            run, scene = ctx.run, ctx.scene
            if self.metres_per_unit is not None:
                scene = replace(scene, frame=replace(scene.frame, metres=self.metres_per_unit))
            with locked(run.out), full_disk_in_one_line(run.out), record_events(run.out):
                record = make_levels(run, self.lod, made, scene, ctx.rasterizer, budget)
        show(run, record)


def show(run: Run, record: dict[str, Any]) -> None:
    """Print what the levels are, and the paths of what was written."""
    print_table(("level", "points"), lod_rows(record))
    print()
    paths = [run.lod / name for name in record["files"]] + [run.lod_record]
    print_table(("written",), [(str(path),) for path in paths])


COMMAND = LodCommand
