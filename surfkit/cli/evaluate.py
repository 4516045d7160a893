"""`surfkit evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.cli.result import show, show_geometry
from surfkit.core.check import BadInput
from surfkit.core.lock import held
from surfkit.evaluate.comparison import Comparison
from surfkit.evaluate.geometry import measure_geometry
from surfkit.folder import Run, note_metrics, refuse_no_run
from surfkit.notes import noted
from surfkit.pipeline import drawer, evaluate, load_run, opened
from surfkit.raster.select import Device
from surfkit.scene.data import Data
from surfkit.scene.read import read
from surfkit.scene.scene import Scene
from surfkit.train.bars import bars
from surfkit.train.faults import full_disk_in_one_line


@dataclass(frozen=True)
class Evaluate:
    """Measure a finished run again on the photographs it has not seen, or with --gt its mesh against the true geometry.

    Without --gt: PSNR, SSIM and LPIPS; writes metrics.json and the pictures anew. With --gt: precision, recall, F1 and
    chamfer distances of RUN/mesh.ply, or of any mesh or cloud of points that is named instead of a run, into
    metrics.json; the crop volume, error clouds and pictures into the folder geometry/ beside it.
    """

    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Folder that `surfkit train` made, or a mesh or cloud of points to compare with --gt."""

    gt: Path | None = None
    """True geometry: a cloud of points or a mesh. PLY of any size; OBJ, STL, GLB and OFF through trimesh."""

    views: Path | None = None
    """Run folder or data set whose training views make the crop volume, when a file is measured."""

    out: Path | None = None
    """Folder for metrics.json and geometry/; the run folder, or for a file FILE-geometry beside it."""

    geometry: Annotated[Comparison, tyro.conf.arg(name="")] = Comparison()
    """How the geometry is compared."""

    lpips_weights: str = "auto"
    """Weights of LPIPS: `auto` for what lies on this machine (`pip install 'surfkit[lpips]'`), `download` to fetch the
    backbones into torch's cache (760 MB), a folder, or `none`. What is not measured is said in metrics.json."""

    device: Device = "auto"
    """Where to compute the pictures."""

    def run(self) -> None:
        """Measure, and show what came out."""
        with noted(), bars():
            if self.gt is not None:
                return self._geometry(self.gt)
            if (self.views, self.out, self.geometry) != (None, None, Comparison()):
                raise BadInput("--views, --out and the options of the comparison are for geometry: give --gt, too")
            if self.target.is_file():
                raise BadInput(f"{self.target}: a file; to measure its geometry, name the truth with --gt")
            refuse_no_run(self.target)
            with held(self.target), full_disk_in_one_line(self.target):
                this, state, scene = load_run(self.target)
                rasterizer, _ = drawer(self.device)
                show(this, evaluate(this, state, scene, rasterizer, lpips_weights=self.lpips_weights))

    def _geometry(self, truth: Path) -> None:
        if self.lpips_weights != "auto" or self.device != "auto":
            raise BadInput("--lpips-weights and --device are for photographs: leave them out, or --gt")
        this = opened(self.target) if self.target.is_dir() else None
        if this is not None and not this.mesh.exists():
            raise BadInput(f"{self.target}: no {this.mesh.name} in it; make it with surfkit mesh, or name a file")
        if this is not None and not this.mesh_record.exists():
            raise BadInput(
                f"{this.mesh}: without {this.mesh_record.name} it is of an earlier model, or half made; make it with "
                "surfkit mesh, or name the file"
            )
        out = self.out or (self.target.with_name(f"{self.target.stem}-geometry") if this is None else this.out)
        scene = self._scene(this)
        found = measure_geometry(
            (self.target if this is None else this.mesh, truth),
            self.geometry,
            out / "geometry",
            scene.train if scene else (),
            scene.frame if scene else None,
        )
        note_metrics(out / "metrics.json", {"geometry": found})
        show_geometry(out, found)

    def _scene(self, this: Run | None) -> Scene | None:
        """The scene whose views make the crop volume; None where nobody names one."""
        if this is not None and self.views is not None:
            raise BadInput(f"--views {self.views}: a run has views of its own; leave it out, or name a file")
        if this is not None:
            return read(this.data)
        if self.views is None:
            return None
        return read(opened(self.views).data if (self.views / "run.json").exists() else Data(self.views))


COMMAND = Evaluate
