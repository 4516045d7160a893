"""A finished run in Python."""

from __future__ import annotations

from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from surfkit.api.compare_surfaces import Surface, surface_file
from surfkit.api.dataset import Dataset, view_of
from surfkit.api.results import Figures, RunMesh
from surfkit.api.splats import format_of_words, write_told
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.fit import fit, settings_of
from surfkit.core.lock import locked
from surfkit.core.registry import find
from surfkit.core.tree import evolve
from surfkit.evaluate.geometry.comparison import Comparison
from surfkit.evaluate.geometry.measure_geometry import measure_geometry
from surfkit.io.splats.base import Format
from surfkit.io.splats.splat_table import SplatTable
from surfkit.mesh.base import Mesher
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.api import Maps
from surfkit.raster.select import Device
from surfkit.runs import journal, pipeline
from surfkit.runs.context import RunContext
from surfkit.runs.ensure_depth_maps import with_maps_to_mesh
from surfkit.runs.folder import note_metrics
from surfkit.runs.make_levels import load_levels
from surfkit.runs.make_mesh import make_mesh, mesh_input
from surfkit.runs.measure_run import evaluate
from surfkit.runs.mesh_output import MeshOutput
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_method import refuse_mesher, refuse_not_drawn, splats_of
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.progress_bars import bars


def open_run(out: str | Path, *, device: Device = "auto") -> TrainedRun:
    """A finished run in a folder. That it is finished, and its data are unchanged, is looked at when it is first used.

    Raises:
        BadInput: It holds no run.
    """
    return TrainedRun(fit(Path, out, "open"), device)


@dataclass
class TrainedRun:
    """A finished run. It is read when it is first needed, and kept until `close` or the end of a `with` block.

    Attributes:
        out: Its folder.
        device: For drawing.
    """

    out: Path
    device: Device = "auto"
    _use: ExitStack = field(default_factory=ExitStack, repr=False)

    def __post_init__(self) -> None:
        self.out, self.device = self.out.absolute(), str(self.device)  # also where the current folder changes
        pipeline.opened(self.out)

    def __reduce__(self) -> tuple[Any, ...]:
        """To another process goes where it is, and not what is in memory."""
        return TrainedRun, (self.out, self.device)

    def __enter__(self) -> TrainedRun:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Free what is in memory."""
        self._use.close()
        self.__dict__.pop("_loaded", None)

    @cached_property
    def _loaded(self) -> tuple[RunContext, Reconstruction]:
        return self._use.enter_context(pipeline.loaded(self.out, self.device))

    @property
    def recipe(self) -> Recipe:
        """What it was trained by."""
        return pipeline.opened(self.out).recipe

    @property
    def dataset(self) -> Dataset:
        """What it was trained on."""
        ctx = self._loaded[0]
        return Dataset(ctx.run.data, ctx.scene)

    @property
    def metrics(self) -> dict[str, Any]:
        """All that has been measured, as metrics.json has it; empty where nothing was."""
        path = pipeline.opened(self.out).metrics
        return read_json(path, dict[str, Any]) if path.exists() else {}

    @property
    def steps(self) -> list[dict[str, Any]]:
        """The optimisation steps so far, as events.jsonl has them: `index`, `losses` by their names, `points`, `time`
        (seconds since 1970) and so on; also of a run that is not finished.
        """
        return [line for line in journal.read(self.out / journal.JOURNAL_FILE) if line["event"] == "StepDone"]

    @property
    def splats(self) -> SplatTable:
        """The splats, frame of the input: `means` (N, 3), `opacities` (N,), `scales` (N, 2 or 3), `quats` (N, 4) w x y
        z, `sh0` (N, 3), `sh_rest` (N, K - 1, 3); float32, positions float64.

        Raises:
            BadInput: Its method makes none.
        """
        ctx, made = self._loaded
        model = splats_of(ctx.run, made)
        return model.primitive.table(model.params).in_input_frame(ctx.scene.frame)

    def render(self, camera: Camera | View) -> Maps:
        """What a camera sees: `color` (3, H, W) in [0, 1], `alpha`, `depth` and `median` (H, W), `normal` (3, H, W).

        Depths are in local units: divided by `dataset.frame.scale` they are those of the input.

        Args:
            camera: A view of the data set, or a camera in the local frame; `dataset.camera(...)` makes one.

        Raises:
            BadInput: Nothing can be drawn of what its method makes.
        """
        view, (ctx, made) = view_of(camera, "render"), self._loaded
        refuse_not_drawn(ctx.run)
        assert made.draw is not None, "what is drawn has a way to draw"
        with torch.no_grad():
            return made.draw(view)

    def mesh(self, mesher: str | Mesher | None = None, *, memory: str = "auto", **settings: Any) -> RunMesh:
        """Make the mesh again, write it to the run folder as `surfkit mesh` does, and return it.

        Args:
            mesher: "tsdf", "visibility" or another by its name, or itself; by default that of the recipe.
            memory: To be used, such as "4GB".
            settings: Of the mesher (`voxel=0.2`), and of what is written (`triangles=100_000`, `watertight=True`,
                `area="site.gpkg"`).

        Raises:
            BadInput: A setting that neither has, or there is no surface, or a mesher where the method has made
                the mesh itself.
        """
        ctx, made = self._loaded
        run, scene = ctx.run, ctx.scene
        written = {each.name for each in fields(MeshOutput)}
        output = settings_of(MeshOutput, {name: it for name, it in settings.items() if name in written}, "mesh")
        own = {name: value for name, value in settings.items() if name not in written}
        if mesher is not None or own:
            refuse_mesher(run.out)
        chosen = None if made.mesh is not None else _mesher(mesher, self.recipe.mesh or TSDF())
        for name, value in own.items():
            chosen = evolve(chosen, name, value)
        if chosen is not None:
            chosen.ready()
        maker = made.mesh if chosen is None else chosen
        assert maker is not None, "where the method has made no mesh, a mesher does"
        budget = cache_bytes(fit(str, memory, "mesh: memory"), "memory")
        maps = nullcontext(run) if chosen is None else with_maps_to_mesh(run, chosen, scene, ctx.caches, self.device)
        with (
            collect_notes(),
            bars(),
            locked(run.out),
            full_disk_in_one_line(run.out),
            maps as with_maps,
            journal.record_events(run.out),
        ):
            what = mesh_input(with_maps, made, scene, ctx.rasterizer, budget, chosen)
            record = make_mesh(with_maps, maker, output, what, made.last_steps)
        return RunMesh.read(run.out / record["files"][0])

    def evaluate(self, gt: Surface | None = None, **settings: Any) -> Figures:
        """Measure: on the held-out photographs, or the run's mesh against the truth.

        Args:
            gt: The truth: a file (point cloud, mesh, raster of heights), (P, 3) points, or a mesh.
            settings: With `gt`: of the comparison, `tau=0.5`, `crop="none"`, `area="site.gpkg"`; see
                `Comparison`.

        Raises:
            BadInput: Nothing to measure, or files that do not belong together.

        Returns:
            What was measured now; `metrics` has what was measured before, too.
        """
        ctx, made = self._loaded
        run = ctx.run
        with collect_notes(), bars(), locked(run.out), full_disk_in_one_line(run.out):
            if gt is None:
                if settings:
                    raise BadInput(f"evaluate: {next(iter(settings))} has no effect without gt; leave it out")
                refuse_not_drawn(run)
                found = evaluate(run, made, ctx.scene)
                return Figures({name: value for name, value in found.items() if name not in ("geometry", "mesh")})
            comparison = settings_of(Comparison, settings, "evaluate")
            if not (run.mesh.exists() and run.mesh_record.exists()):
                raise BadInput(f"{run.out}: no {run.mesh.name} of its model in it; mesh() makes it")
            folder = run.out / "geometry"
            truth = surface_file(gt, folder, "truth")
            found = measure_geometry((run.mesh, truth), comparison, folder, ctx.scene.train, ctx.scene.frame)
            note_metrics(run.metrics, found)
            return Figures(found)

    def export(self, path: str | Path, format: str | Format | None = None) -> Path:  # noqa: A002 (the word that fits)
        """Write the splats to a file for other programs.

        Args:
            path: File; its suffix says the format: .ply, .spz, .sog, .splat, and so on.
            format: Its name, or itself, where the suffix does not say.

        Raises:
            BadInput: No such format, or the splats have no place in it.
        """
        file: Path = fit(Path, path, "export")
        form, (ctx, made) = format_of_words(file, format, "export"), self._loaded
        tree = None
        if form.wants_tree:
            if not ctx.run.lod_record.exists():
                raise BadInput(
                    f"{file}: this format takes levels of detail, and there are none; surfkit lod makes them"
                )
            tree = load_levels(ctx.run, splats_of(ctx.run, made)).tiles(ctx.scene.frame)
        write_told(file, form, self.splats, ctx.scene.frame, tree)
        return file


def _mesher(given: str | Mesher | None, default: Mesher) -> Mesher:
    if given is None or isinstance(given, Mesher):
        return given or default
    return find(Mesher, given.removeprefix("mesh:"))()
