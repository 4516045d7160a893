"""`surfkit evaluate`."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.apps.run_summary import quality_rows, show, show_geometry, show_levels
from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import Warned, emit
from surfkit.core.files import refuse_unwritable
from surfkit.core.lock import locked
from surfkit.evaluate.geometry.comparison import Comparison
from surfkit.evaluate.geometry.measure_geometry import measure_geometry
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface
from surfkit.evaluate.mesh.measure_mesh import measure_mesh
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.raster.select import Device
from surfkit.runs.command import refuse_no_mesh
from surfkit.runs.context import RunContext
from surfkit.runs.folder import Run, note_metrics, refuse_no_run
from surfkit.runs.make_levels import load_levels, measure_levels
from surfkit.runs.measure_run import evaluate, note_compressed
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.pipeline import loaded, opened
from surfkit.runs.resume import read_unchanged
from surfkit.runs.run_method import is_drawn, refuse_not_drawn, splats_of
from surfkit.runs.run_notes import collect_notes
from surfkit.runs.warn import NONE_HELD_OUT
from surfkit.scene.scene import Scene
from surfkit.study.photo_zones import Distance, Zones, measure_zones, rendered_depths, seams_of, true_depths
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.progress_bars import bars

OF_THE_MEASURING = ("file", "cpu_seconds")
"""Of what is measured of a mesh by itself, what says nothing of the mesh."""


@dataclass(frozen=True)
class EvaluateCommand:
    """Measure a finished run on its held-out photographs, or with --gt its mesh against ground truth.

    Without --gt: computes PSNR, SSIM and LPIPS, as they are and with colours aligned, and writes metrics.json and the
    pictures again. With --gt: computes precision, recall, F1, chamfer distances and angles between normals of
    RUN/mesh.ply, or of any mesh or point cloud that is given instead of a run, for the whole surface and for each class
    of places. They are written to metrics.json; the crop volume, the points coloured by error and the pictures are
    written to the folder geometry/ beside it. With and without --gt, a mesh is also measured by itself: edges with one
    triangle, loose parts, edges with more than two triangles, triangles that cross others, triangles per area, and
    roughness on planes. --seen and --seams also measure parts of the photographs; --seams also measures parts of the
    geometry. --lod also measures levels of detail.
    """

    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Run folder that `surfkit train` made; or a mesh, or with --gt also a point cloud."""

    gt: Path | None = None
    """Ground truth: a point cloud or a mesh. PLY, LAS and LAZ of any size; E57; OBJ, STL, GLB and OFF; or a raster of
    heights (GeoTIFF)."""

    views: Path | None = None
    """When a file is measured: run folder or data set whose training views define the crop volume."""

    out: Path | None = None
    """Folder for metrics.json and geometry/. Default: the run folder, or for a file the folder FILE-geometry beside
    it."""

    seen: tuple[int, ...] = ()
    """Also compute PSNR and SSIM over the pixels whose surface point at least this many training views see, such as 3,
    or 3 5 10. With a mesh as --gt, the surface point is on that mesh, and only that mesh can hide it. Otherwise it
    comes from the depth that the model renders, which must agree within 1 % in a training view."""

    seams: Distance | None = None
    """For a run with blocks: also compute PSNR, and with --gt precision, recall and F1, within this distance of the
    block borders, in metres, and elsewhere. `auto` is 2 % of the width of the scene."""

    compressed: bool = False
    """Measure the compressed model of the run (`surfkit compress`), or with --gt the mesh that `surfkit mesh RUN
    --compressed` made of it. Figures and pictures are written to RUN/compressed, and a summary to the run's
    metrics.json."""

    lod: bool = False
    """Also measure the levels of detail of the run: size, frames per second, PSNR and SSIM of each, and of blocks that
    are selected for each view by their error in pixels."""

    lod_pixels: float | None = None
    """Largest error of the blocks that are selected, in pixels; 1 if it is not given."""

    geometry: Annotated[Comparison, tyro.conf.arg(name="")] = Comparison()
    """How the geometry is compared."""

    lpips_weights: str = "auto"
    """Weights of LPIPS: `auto` for those on this machine (`pip install 'surfkit[lpips]'`), `download` to download the
    backbones to torch's cache (760 MB), a folder, or `none`. metrics.json says what was not measured and why."""

    device: Device = "auto"
    """Device for rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    def run(self) -> None:
        """Measure, and print the results."""
        zones = Zones(self.seen, self.seams)
        if self.lod_pixels is not None and not 0 <= self.lod_pixels < float("inf"):
            raise BadInput(f"--lod-pixels {self.lod_pixels:g}: give 0 or more")
        if self.lod_pixels is not None and not self.lod:
            raise BadInput(f"--lod-pixels {self.lod_pixels:g} is for levels of detail; add --lod")
        if self.compressed and (zones != Zones() or self.lod or self.out is not None or not self.target.is_dir()):
            raise BadInput("--compressed is for a run, without --seen, --seams, --lod and --out")
        with collect_notes(), bars():
            if self.gt is not None:
                if self.lod:
                    raise BadInput("--lod is for photographs, and --gt for geometry: leave out one of the two")
                return self._geometry(self.gt, zones)
            if self.geometry != Comparison():
                raise BadInput("the options of the comparison have no effect without --gt; add --gt")
            if self.target.is_file():
                return self._file(zones)
            if (self.views, self.out) != (None, None):
                raise BadInput("--views and --out have no effect without --gt on a run; add --gt, or leave them out")
            refuse_no_run(self.target)
            with locked(self.target), full_disk_in_one_line(self.target):
                with loaded(self.target, self.device, self.compressed) as (ctx, made):
                    self._photographs(ctx, made, zones)

    def _file(self, zones: Zones) -> None:
        """Measure the mesh of a file by itself."""
        if self.lod or zones != Zones() or self.lpips_weights != "auto" or self.device != "auto":
            raise BadInput(
                f"{self.target}: a file; --lod, --seen, --seams, --lpips-weights and --device are for runs; leave them "
                "out"
            )
        out = self._beside()
        refuse_unwritable(out)
        scene = self._scene(None)
        found = mesh_alone(read_surface(self.target), scene)
        if not found:
            raise BadInput(f"{self.target}: a cloud of points, not a mesh; to measure it, name the truth with --gt")
        forget_others(out / "metrics.json", found)
        note_metrics(out / "metrics.json", found)
        print_table(("mesh", "value"), quality_rows(found["mesh"]))

    def _beside(self) -> Path:
        """Where the figures of a file go."""
        return self.out or self.target.with_name(f"{self.target.stem}-geometry")

    def _photographs(self, ctx: RunContext, made: Reconstruction, zones: Zones) -> None:
        run, scene = ctx.run, ctx.scene
        surface = read_surface(run.mesh) if run.mesh_record.exists() and run.mesh.exists() else None
        if surface is not None and not self.lod and zones == Zones() and not is_drawn(run):
            metrics = note_metrics(run.metrics, mesh_alone(surface, scene))
            return print_table(("mesh", "value"), quality_rows(metrics["mesh"]))
        refuse_not_drawn(run)
        zones.refuse_too_many(scene)
        if not scene.held_out:
            emit(Warned(f"{run.out}: {NONE_HELD_OUT}"))
        seams = None if self.seams is None else seams_of(run, scene.frame, self.seams)
        tree = load_levels(run, splats_of(run, made)) if self.lod else None
        metrics = evaluate(run, made, scene, lpips_weights=self.lpips_weights)
        if surface is not None:
            metrics = note_metrics(run.metrics, mesh_alone(surface, scene))
        if zones != Zones():
            assert made.draw is not None, "a run that draws nothing is refused"
            found = measure_zones(scene, made.photographed(made.draw), zones, rendered_depths(made.draw), seams)
            metrics = note_metrics(run.metrics, {"images": metrics["images"] | found})
        if tree is not None:
            pixels = 1.0 if self.lod_pixels is None else self.lod_pixels
            levels = measure_levels(made, tree, scene, ctx.rasterizer, pixels)
            metrics = note_metrics(run.metrics, {"lod": levels})
        if self.compressed:
            note_compressed(opened(self.target), metrics)
        if scene.held_out:
            show(run, metrics)
        else:
            tell(self._measured_without(run, metrics))
        if tree is not None:
            show_levels(metrics["lod"])

    def _measured_without(self, run: Run, metrics: dict[str, Any]) -> str:
        """What was measured of a run without held-out photographs, on one line."""
        fps = f"{metrics['fps']:.1f} frames a second" if metrics.get("fps") else "nothing"
        command = shlex.join(["surfkit", "evaluate", str(self.target), *["--compressed"] * self.compressed, "--gt"])
        mesh = f"; `{command} FILE` measures its mesh" if run.mesh.exists() else ""
        return f"measured: {fps}, and no photographs, as none is held out; written to {run.metrics}{mesh}"

    def _geometry(self, truth: Path, zones: Zones) -> None:
        if self.lpips_weights != "auto" or (self.device != "auto" and zones == Zones()):
            raise BadInput(
                "--lpips-weights has no effect with --gt, and --device only with --seen or --seams; leave them out"
            )
        run = opened(self.target) if self.target.is_dir() else None
        if run is None and zones != Zones():
            raise BadInput(f"{self.target}: a file; --seen and --seams need the run, its photographs and its blocks")
        shown = replace(run, out=run.compressed) if run is not None and self.compressed else run
        if shown is not None:
            refuse_no_mesh(shown)
        if run is not None and zones != Zones():
            refuse_not_drawn(run)
        out = self._beside() if shown is None else self.out or shown.out
        refuse_unwritable(out / "geometry")
        scene = self._scene(run)
        if scene is not None:
            zones.refuse_too_many(scene)
        surface = read_surface(truth) if self.seen else None
        if surface is not None and surface.faces is None:
            raise BadInput(f"{truth}: a cloud of points; --seen needs a mesh, or leave --gt out to use rendered depth")
        seams = None
        if self.seams is not None:
            assert run is not None and scene is not None, "--seams of a file is refused"
            seams = seams_of(run, scene.frame, self.seams)
        measured = measure_geometry(
            (self.target if shown is None else shown.mesh, truth),
            self.geometry,
            out / "geometry",
            scene.train if scene else (),
            scene.frame if scene else None,
            seams,
        )
        found = measured["geometry"]
        forget_others(out / "metrics.json", measured)
        metrics, images = note_metrics(out / "metrics.json", measured), {}
        if scene is not None and scene.held_out and zones != Zones():
            images = self._zones(zones, surface, found["alignments"][found["align"]]["matrix"])
            before = metrics.get("images")
            note_metrics(out / "metrics.json", {"images": (before if isinstance(before, dict) else {}) | images})
        if run is not None and self.compressed:
            note_compressed(run, metrics)
        show_geometry(out, measured, images)

    def _zones(self, zones: Zones, truth: SurfaceFile | None, matrix: list[list[float]]) -> dict[str, Any]:
        """Figures of parts of the held-out photographs of a run; a mesh as truth, else rendered depth, says which."""
        with locked(self.target), full_disk_in_one_line(self.target):
            with loaded(self.target, self.device) as (ctx, made):
                assert made.draw is not None, "a run that draws nothing is refused"
                run, scene = ctx.run, ctx.scene
                depths = rendered_depths(made.draw) if truth is None else true_depths(truth, scene.frame, matrix)
                seams = None if self.seams is None else seams_of(run, scene.frame, self.seams)
                return measure_zones(scene, made.photographed(made.draw), zones, depths, seams)

    def _scene(self, run: Run | None) -> Scene | None:
        """The scene whose views make the crop volume; None where nobody names one."""
        if run is not None and self.views is not None:
            raise BadInput(f"--views {self.views}: a run has views of its own; leave it out, or name a file")
        if run is not None:
            return read_unchanged(run)
        if self.views is None:
            return None
        if (self.views / "run.json").exists():
            return read_unchanged(opened(self.views))
        return read(Data(self.views))


def mesh_alone(surface: SurfaceFile, scene: Scene | None) -> dict[str, Any]:
    """What metrics.json is to say of a mesh by itself; nothing of a cloud."""
    metres = None if scene is None else scene.frame.metres
    return {} if surface.faces is None else {"mesh": measure_mesh(surface, metres).figures}


def forget_others(path: Path, found: dict[str, Any]) -> None:
    """Take out of metrics.json what is there of another surface than that which was measured now: of an earlier file
    of that name, or of mesh.obj where mesh.ply had its place."""
    metrics = read_json(path, dict[str, Any]) if path.exists() else {}
    before, now = (each.get("mesh") or {} for each in (metrics, found))
    own = all(before.get(name) == now.get(name) for name in before.keys() | now.keys() if name not in OF_THE_MEASURING)
    if own or not {"mesh", "geometry"} & metrics.keys():
        return
    if "geometry" in metrics and "geometry" not in found:
        emit(Warned(f"{path}: precision, recall and F1 were of another mesh and are gone; --gt measures this one"))
    write_json(path, {name: it for name, it in metrics.items() if name not in ("mesh", "geometry")})


COMMAND = EvaluateCommand
