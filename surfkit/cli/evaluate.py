"""`surfkit evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.cli.result import show
from surfkit.core.lock import held
from surfkit.folder import noted, refuse_no_run
from surfkit.pipeline import drawer, evaluate, load_run
from surfkit.raster.select import Device
from surfkit.train.faults import in_one_line


@dataclass(frozen=True)
class Evaluate:
    """Measure a finished run again on the photographs it has not seen; writes metrics.json and the pictures anew."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    device: Device = "auto"
    """Where to compute."""

    def run(self) -> None:
        """Measure, and show what came out."""
        refuse_no_run(self.run_folder)
        with noted(), held(self.run_folder), in_one_line(self.run_folder):
            this, state, scene = load_run(self.run_folder)
            rasterizer, _ = drawer(self.device)
            show(this, evaluate(this, state, scene, rasterizer))


COMMAND = Evaluate
