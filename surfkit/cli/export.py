"""`surfkit export`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.export.ply import write_splats
from surfkit.pipeline import loaded
from surfkit.primitives.model import SplatModel
from surfkit.run.folder import Run, refuse_no_run
from surfkit.run.method import splats_of
from surfkit.scene.scene import Scene
from surfkit.train.faults import full_disk_in_one_line


@dataclass(frozen=True)
class Export:
    """Write the points of a finished run as PLY, in the data set's own frame, for SuperSplat and other viewers."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    out: Path | None = None
    """File to write, ending in .ply; RUN/point_cloud.ply by default."""

    strict_2dgs: bool = False
    """Leave out the third scale of surfels, as programs written for 2DGS alone expect."""

    def run(self) -> None:
        """Write the file."""
        refuse_no_run(self.run_folder)
        with locked(self.run_folder) if self.out is None else nullcontext(), full_disk_in_one_line(self.run_folder):
            with loaded(self.run_folder, "cpu") as (ctx, made):
                self._write(ctx.run, splats_of(ctx.run, made), ctx.scene)

    def _write(self, run: Run, splats: SplatModel, scene: Scene) -> None:
        path = self.out or run.cloud
        if path.suffix.lower() != ".ply":
            raise BadInput(f"--out {path}: only .ply files can be written; end the name in .ply")
        if path.exists() and self.out is not None and path.is_dir():
            raise BadInput(f"--out {path}: a folder; name a file")
        table = splats.primitive.table(splats.params).in_input_frame(scene.frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_splats(path, table, strict_2dgs=self.strict_2dgs, frame=scene.frame)
        print(f"wrote {len(splats):,} points to {path}")


COMMAND = Export
