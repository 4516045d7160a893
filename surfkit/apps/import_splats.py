"""`surfkit import`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.apps.run_summary import show
from surfkit.core.registry import choice
from surfkit.io.datasets.data import ReadSettings
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.io.splats.models import existing_model
from surfkit.mesh.base import Mesher
from surfkit.mesh.tsdf import TSDF
from surfkit.primitives.model import DrawnAs
from surfkit.raster.select import Device
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.folder import Run
from surfkit.runs.methods.imported import SplatImport
from surfkit.runs.pipeline import run
from surfkit.study.recipes import IMPORTED
from surfkit.train.data_cache import CacheSettings


@dataclass(frozen=True)
class ImportCommand:
    """Take splats from a file of any program into a run folder, and measure and mesh them on the photographs.

    Nothing is optimised. `surfkit evaluate`, `mesh` and `export` work on the folder, and `surfkit train recipe:2dgs
    start:splats --start.file FILE` trains the splats further. Coordinates must be those of the data set (its COLMAP
    model).
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File of splats of any format that `surfkit components format` lists, such as a PLY file of 3DGS or 2DGS, or the
    folder of a finished run."""

    data: Path
    """Data set that the splats were made from: images/ and a COLMAP model in sparse/0, or another layout."""

    out: Path | None = None
    """Run folder. Default: runs/DATA-FILE."""

    axes: AxesOrAuto = "auto"
    """Axes of the numbers in the file, as SPZ names them: rdf for right, down, forward, those of a PLY file, which are
    taken as they are. auto: those that the file or its format names, else those that fit the photographs best."""

    drawn_as: DrawnAs = "auto"
    """How the program that trained ellipsoids draws them. 3dgs: with the blur of 3DGS; antialias: with it made up for,
    as gsplat does in its mode antialiased; mip-splatting: likewise with its smaller blur; gof: along rays without blur
    (Gaussian Opacity Fields). auto: as the file says, and as 3DGS where it says nothing."""

    mesh: Annotated[Mesher | None, choice(Mesher, optional=True)] = field(default_factory=TSDF)
    """How the splats become triangles; none for no mesh."""

    reading: Annotated[ReadSettings, tyro.conf.arg(name="")] = ReadSettings()
    """How the data set is read."""

    device: Device = "auto"
    """Device for rendering."""

    cache: str = "auto"
    """Memory for photographs and masks, such as 4GB or 500MB; auto is half of the free memory."""

    def run(self) -> None:
        """Import, and print the results."""
        existing_model(self.file, "FILE")
        data = self.reading.of(self.data)
        out = self.out or Path("runs") / f"{data.path.resolve().name}-{self.file.resolve().stem}"
        recipe = replace(IMPORTED, method=SplatImport(self.file, self.axes, self.drawn_as), mesh=self.mesh)
        metrics = run(recipe, data, out, Compute(self.device), caches=CacheSettings(self.cache))
        show(Run(out, recipe, data), metrics)


COMMAND = ImportCommand
