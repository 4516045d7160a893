"""`surfkit evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.cli.result import show, show_geometry
from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.evaluate.geometry.comparison import Comparison
from surfkit.evaluate.geometry.measure import measure_geometry
from surfkit.evaluate.geometry.surface import Surface, read_surface
from surfkit.pipeline import evaluate, load_run, opened
from surfkit.raster.select import Device
from surfkit.readers.data import Data
from surfkit.readers.read import read
from surfkit.report.regions import Distance, Zones, measure_zones, rendered_depths, seams_of, true_depths
from surfkit.run.folder import Run, note_metrics, refuse_no_run
from surfkit.run.notes import collect_notes
from surfkit.run.stage import drawing, select_rasterizer
from surfkit.scene.scene import Scene
from surfkit.train.bars import bars
from surfkit.train.faults import full_disk_in_one_line


@dataclass(frozen=True)
class Evaluate:
    """Measure a finished run again on the photographs it has not seen, or with --gt its mesh against the true geometry.

    Without --gt: PSNR, SSIM and LPIPS; writes metrics.json and the pictures anew. With --gt: precision, recall, F1 and
    chamfer distances of RUN/mesh.ply, or of any mesh or cloud of points that is named instead of a run, into
    metrics.json, in all and by classes of places; the crop volume, error clouds and pictures into the folder geometry/
    beside it. --seen and --seams measure parts of the photographs, and --seams those of the geometry.
    """

    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Folder that `surfkit train` made, or a mesh or cloud of points to compare with --gt."""

    gt: Path | None = None
    """True geometry: a cloud of points or a mesh. PLY of any size; OBJ, STL, GLB and OFF through trimesh."""

    views: Path | None = None
    """Run folder or data set whose training views make the crop volume, when a file is measured."""

    out: Path | None = None
    """Folder for metrics.json and geometry/; the run folder, or for a file FILE-geometry beside it."""

    seen: tuple[int, ...] = ()
    """Also PSNR and SSIM over the pixels whose place at least so many training views see, such as 3, or 3 5 10. With a
    mesh as --gt, that is the place on it, and it alone hides; else the depth that the model renders, which must agree
    in a training view within 1 %."""

    seams: Distance | None = None
    """Of a run in blocks: also PSNR, and with --gt precision, recall and F1, within so many metres of the borders of
    blocks, and elsewhere. `auto` for 2 % of the width of the scene."""

    geometry: Annotated[Comparison, tyro.conf.arg(name="")] = Comparison()
    """How the geometry is compared."""

    lpips_weights: str = "auto"
    """Weights of LPIPS: `auto` for what lies on this machine (`pip install 'surfkit[lpips]'`), `download` to fetch the
    backbones into torch's cache (760 MB), a folder, or `none`. What is not measured is said in metrics.json."""

    device: Device = "auto"
    """Where to compute the pictures."""

    def run(self) -> None:
        """Measure, and show what came out."""
        zones = Zones(self.seen, self.seams)
        with collect_notes(), bars():
            if self.gt is not None:
                return self._geometry(self.gt, zones)
            if (self.views, self.out, self.geometry) != (None, None, Comparison()):
                raise BadInput("--views, --out and the options of the comparison are for geometry: give --gt, too")
            if self.target.is_file():
                raise BadInput(f"{self.target}: a file; to measure its geometry, name the truth with --gt")
            refuse_no_run(self.target)
            with locked(self.target), full_disk_in_one_line(self.target):
                run, state, scene = load_run(self.target)
                zones.refuse_too_many(scene)
                seams = None if self.seams is None else seams_of(run, scene.frame, self.seams)
                rasterizer, _ = select_rasterizer(self.device)
                metrics = evaluate(run, state, scene, rasterizer, lpips_weights=self.lpips_weights)
                if zones != Zones():
                    draw = drawing(run.last, state, rasterizer)
                    found = measure_zones(scene, draw, zones, rendered_depths(draw), seams)
                    metrics = note_metrics(run.metrics, {"images": metrics["images"] | found})
                show(run, metrics)

    def _geometry(self, truth: Path, zones: Zones) -> None:
        if self.lpips_weights != "auto" or (self.device != "auto" and zones == Zones()):
            raise BadInput("--lpips-weights and --device are for photographs: leave them out, or --gt")
        run = opened(self.target) if self.target.is_dir() else None
        if run is None and zones != Zones():
            raise BadInput(f"{self.target}: a file; --seen and --seams need the run, its photographs and its blocks")
        if run is not None:
            refuse_no_mesh(run)
        out = self.out or (self.target.with_name(f"{self.target.stem}-geometry") if run is None else run.out)
        scene = self._scene(run)
        if scene is not None:
            zones.refuse_too_many(scene)
        surface = read_surface(truth) if self.seen else None
        if surface is not None and surface.faces is None:
            raise BadInput(f"{truth}: a cloud of points; --seen needs a mesh, or leave --gt out to use rendered depth")
        seams = None if self.seams is None else seams_of(run, scene.frame, self.seams)
        found = measure_geometry(
            (self.target if run is None else run.mesh, truth),
            self.geometry,
            out / "geometry",
            scene.train if scene else (),
            scene.frame if scene else None,
            seams,
        )
        metrics, images = note_metrics(out / "metrics.json", {"geometry": found}), {}
        if zones != Zones() and scene.held_out:
            images = self._zones(zones, surface, found["alignments"][found["align"]]["matrix"])
            before = metrics.get("images")
            note_metrics(out / "metrics.json", {"images": (before if isinstance(before, dict) else {}) | images})
        show_geometry(out, found, images)

    def _zones(self, zones: Zones, truth: Surface | None, matrix: list[list[float]]) -> dict[str, Any]:
        """Figures of parts of the held-out photographs of a run; a mesh as truth, else rendered depth, says which."""
        with locked(self.target), full_disk_in_one_line(self.target):
            run, state, scene = load_run(self.target)
            draw = drawing(run.last, state, select_rasterizer(self.device)[0])
            depths = rendered_depths(draw) if truth is None else true_depths(truth, scene.frame, matrix)
            seams = None if self.seams is None else seams_of(run, scene.frame, self.seams)
            return measure_zones(scene, draw, zones, depths, seams)

    def _scene(self, run: Run | None) -> Scene | None:
        """The scene whose views make the crop volume; None where nobody names one."""
        if run is not None and self.views is not None:
            raise BadInput(f"--views {self.views}: a run has views of its own; leave it out, or name a file")
        if run is not None:
            return read(run.data)
        if self.views is None:
            return None
        return read(opened(self.views).data if (self.views / "run.json").exists() else Data(self.views))


def refuse_no_mesh(run: Run) -> None:
    """BadInput if a run has no mesh of its model."""
    if not run.mesh.exists():
        raise BadInput(f"{run.out}: no {run.mesh.name} in it; make it with surfkit mesh, or name a file")
    if not run.mesh_record.exists():
        raise BadInput(
            f"{run.mesh}: without {run.mesh_record.name} it is of an earlier model, or half made; make it with "
            "surfkit mesh, or name the file"
        )


COMMAND = Evaluate
