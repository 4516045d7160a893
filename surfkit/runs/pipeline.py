"""Recipe and data to a run folder: what happens, from top to bottom."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load, read_json
from surfkit.core.events import FileWritten, Warned, emit, say
from surfkit.core.files import sweep
from surfkit.core.lock import locked
from surfkit.core.registry import name_of
from surfkit.evaluate.metrics import read_metrics
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read
from surfkit.io.splats.cameras import write_cameras
from surfkit.io.splats.ply import write_splats
from surfkit.primitives.model import SplatModel
from surfkit.raster.select import Device
from surfkit.runs.blocks.block import plan_file
from surfkit.runs.blocks.train_blocks import Compute, tune_blocks
from surfkit.runs.command import train_command
from surfkit.runs.compress_model import decompressed, has_compressed, make_wanted_compressed
from surfkit.runs.context import RunContext
from surfkit.runs.divided import optimise_divided, refuse_processes
from surfkit.runs.ensure_depth_maps import with_maps, with_maps_to_mesh
from surfkit.runs.folder import (
    Run,
    discard_results,
    read_data,
    refuse_file,
    refuse_foreign,
    refuse_links,
    refuse_no_run,
)
from surfkit.runs.journal import record_events
from surfkit.runs.make_levels import has_levels, make_wanted_levels
from surfkit.runs.make_mesh import has_mesh, make_mesh, mesh_input
from surfkit.runs.measure_run import evaluate, measure_compressed
from surfkit.runs.mesh_output import MeshOutput
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.photo_light import LightRecord, light_in_short, needed_light, warn_of_light, write_light
from surfkit.runs.recipe import Recipe, complete, refuse_unused
from surfkit.runs.resume import read_unchanged, refuse_changed, refuse_other_run, write_run_files
from surfkit.runs.run_cache import RunCache
from surfkit.runs.run_method import (
    is_begun,
    method_input,
    optimised,
    reconstruct,
    reopened,
    result_path,
    with_drawing,
)
from surfkit.runs.run_notes import collect_notes, prefix_notes
from surfkit.runs.run_refinements import refine_model, refuse_unrefinable, stage_scene
from surfkit.runs.run_stage import Intervals, StageJob, load_state, optimise, select_rasterizer
from surfkit.runs.stage_cache import StageCache
from surfkit.runs.start import InitialPointBuilder, align_priors
from surfkit.runs.warn import warn_before
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.scene import Scene
from surfkit.train.data_cache import CacheSettings, read_ahead
from surfkit.train.faults import in_one_line
from surfkit.train.memory_meter import MemoryMeter
from surfkit.train.progress_bars import bars
from surfkit.train.state import StageState


def run(
    recipe: Recipe,
    data: Data,
    out: Path,
    compute: Compute | None = None,
    intervals: Intervals | None = None,
    caches: CacheSettings | None = None,
    store: StageCache | None = None,
) -> dict[str, Any]:
    """Train, write the results into `out` and return the metrics; an interrupted run goes on where it stopped.

    Args:
        recipe: What to do.
        data: What to do it with.
        out: Run folder.
        compute: Who computes.
        intervals: When checkpoints and pictures are written.
        caches: Where photographs, masks and depth priors are kept at hand; the result does not depend on it.
        store: Finished stages are taken from here if another run has made the same, and put here if not. In `out`,
            there must be no run of fewer steps that this one makes longer.

    Raises:
        BadInput: `out` holds a run of another recipe or of other data, another process works in it, or the data cannot
            be used.
        Fault: Memory, disk or numbers gave out; the last checkpoint is whole.
        KeyboardInterrupt: The run was asked to stop, and has saved its state.
    """
    recipe = complete(recipe)
    run = Run(out, recipe, replace(data, path=data.path.resolve()))
    compute, intervals, caches = compute or Compute(), intervals or Intervals(), caches or CacheSettings()
    meter = MemoryMeter()
    if intervals.pictures is None:
        intervals = replace(intervals, pictures=max(1, recipe.pretrain.steps // 5))
    refuse_unready(run, compute, caches)
    with collect_notes() as notes, locked(out), in_one_line(out), bars(), ExitStack() as use:
        recipe.refuse_unfit()
        sweep(out, out / "blocks")
        refuse_other_run(run)
        scene = read(run.data)
        meter.scene_read()
        rasterizer, backend = select_rasterizer(compute.device)
        refuse_processes(run, compute.processes, rasterizer, caches)
        state = load_state(run, run.pretrain, scene, repair=True) if recipe.has_stages else None
        prints = refuse_changed(run, scene, {scene.train[at].name for at in state.skipped} if state else set())
        for mesher in recipe.meshers:
            mesher.refuse_unfit(scene.frame)
        refuse_unplannable(run, scene)
        warn_before(run, scene, state)
        if state is None:
            warn_of_light(run, scene)
        warn_of_idle(run, compute)
        begun = state is not None or is_begun(run)
        run = use.enter_context(with_maps(run, scene, prints, caches, compute.device, begun))
        shares = RunCache.of(run, store, backend, prints, scene.train)
        ctx = RunContext(run, scene, rasterizer, intervals, caches, shares)
        refuse_unrefinable(ctx)
        stages = RecipeStages(ctx, compute, meter, state)
        given = use.enter_context(method_input(ctx, compute.device, stages))
        recipe.method.refuse_unfit(given)
        known = len(notes.texts)
        stages.begin()
        warned = notes.texts[known:]  # runs that take the stage repeat what its journal warns of
        write_run_files(run, backend, caches, prints, notes, scene.frame, light_in_short(run, stages.light))
        shares.take()
        with record_events(out, warned):
            made = reconstruct(run, given)
            if not recipe.has_stages:
                ctx.keep("result")
            return results(ctx, made, compute.device, meter)


class RecipeStages:
    """The stages of a recipe, to be optimised one after the other.

    Args:
        ctx: The run, before its first stage.
        compute: Who computes.
        meter: Sees what memory is taken by.
        state: Of the first stage, where it goes on.
    """

    def __init__(self, ctx: RunContext, compute: Compute, meter: MemoryMeter, state: StageState | None) -> None:
        self.ctx, self.compute, self.meter, self.state = ctx, compute, meter, state
        self.start: InitialPointBuilder | None = None
        self.light: LightRecord | None = None

    def begin(self) -> None:
        """Find where the first stage begins, and the light of the photographs, or BadInput; nothing is written."""
        if self.ctx.run.recipe.has_stages:
            self.light = needed_light(self.ctx.run, self.ctx.scene)
        if self.ctx.run.recipe.has_stages and not self.is_shared:
            self.start = initial_points(self.ctx.run, self.ctx.scene, self.ctx.caches, self.state)

    @property
    def is_shared(self) -> bool:
        """Whether another run has made the first stage, so that its state is taken from there."""
        return self.ctx.shares is not None and "pretrain" in self.ctx.shares.found

    def __call__(self) -> Reconstruction:
        """Optimise what is not finished yet."""
        ctx, run, state, start = self.ctx, self.ctx.run, self.state, self.start
        self.start = self.state = None
        write_light(run, self.light)
        if start is not None:
            discard_results(run, run.pretrain)
            given, count = start.given, self.compute.processes
            parts = ctx.scene, ctx.rasterizer, ctx.intervals, given, self.meter, start
            job = StageJob(run, run.pretrain, *parts, ctx.caches.points)
            state = optimise(job, state) if count == 1 else optimise_divided(job, state, count, ctx.caches)
            del start, given, parts, job  # to free the memory of the photographs
        elif self.is_shared and run.recipe.partition is None:
            state = load_state(run, run.pretrain, ctx.scene)
        ctx.keep("pretrain")
        if run.recipe.partition is not None:
            state = None  # it is in the folder
            state = tune_blocks(ctx, self.compute, self.optimise_partition)
        assert state is not None, "a first stage that needs no start is finished"
        return optimised(run, refine_model(ctx, state))

    def optimise_partition(self, run: Run) -> None:
        """Optimise the model that decides the partition, where another than that of pretraining does."""
        ctx = replace(self.ctx, run=run, intervals=replace(self.ctx.intervals, pictures=0))
        run.out.mkdir(exist_ok=True)
        with prefix_notes("partition: "), record_events(run.out):
            state = load_state(run, run.pretrain, ctx.scene, repair=True)
            if (start := initial_points(run, ctx.scene, ctx.caches, state)) is not None:
                write_light(run, needed_light(run, ctx.scene))
                given, points_on = start.given, ctx.caches.points
                job = StageJob(
                    run, run.pretrain, ctx.scene, ctx.rasterizer, ctx.intervals, given, self.meter, start, points_on
                )
                optimise(job, state)


def refuse_unready(run: Run, compute: Compute, caches: CacheSettings) -> None:
    """BadInput for what can be told before anything is read or written."""
    refuse_file(run.out)
    refuse_foreign(run.out)
    refuse_unused(run.recipe)
    refuse_unsaved(run.recipe)
    caches.bytes(), caches.maps_bytes()
    caches.points.refuse_unfit((at.setting, at.stage, at.primitive) for at in run.optimised_stages())
    if run.recipe.partition is not None:
        compute.workers.ready()
    for mesher in run.recipe.meshers:
        mesher.ready()


def refuse_unsaved(recipe: Recipe) -> None:
    """BadInput if recipe.json could not be read again: JSON has no place for a setting, as of a part of a plugin."""
    try:
        load(Recipe, dump(recipe))
    except TypeError as error:
        raise BadInput(f"the recipe cannot be saved: {error}; give another value, or change the part") from error


def refuse_unplannable(run: Run, scene: Scene) -> None:
    """BadInput, before hours are spent on pretraining, if the data set lacks what the blocks will be planned by."""
    recipe = run.recipe
    if recipe.partition is None or plan_file(run).exists():
        return
    recipe.partition.refuse_unfit(scene.frame)
    if recipe.assign.needs_observations and observations(run.data, scene).is_empty:
        raise BadInput(
            f"{run.data.path}: assign {name_of(recipe.assign)} needs the sparse points that each photograph shows, "
            "and the data set has none; choose another assign, such as assign:picture-share"
        )


def initial_points(
    run: Run, scene: Scene, caches: CacheSettings, state: StageState | None
) -> InitialPointBuilder | None:
    """The initial points of pretraining and its photographs, also if it is resumed; None if it has all its steps."""
    if state is not None and state.index >= run.recipe.pretrain.steps:
        return None
    if state is None:
        run.recipe.start.refuse_unfit(run.recipe.primitive, scene)
    known = align_priors(run, scene, begun=state is not None)
    return InitialPointBuilder(
        run, scene, read_ahead(run.data, scene, run.recipe.pretrain.losses, caches, known), known
    )


def results(ctx: RunContext, made: Reconstruction, device: Device, meter: MemoryMeter) -> dict[str, Any]:
    """Write the results that are missing, as further steps have deleted them, and return all the metrics."""
    run, scene = ctx.run, ctx.scene
    meshed = has_mesh(run, made.last_steps, made.mesh is not None)
    has_lod, has_file = has_levels(run, made.last_steps), has_compressed(run, made.last_steps)
    if run.metrics.exists() and has_cloud(run, made) and meshed and has_lod and has_file:
        again = f"; `{run.to_paste('evaluate')}` measures it again" if made.draw is not None else ""
        say(f"{run.out} is finished, and nothing is left to do{again}")
        return read_metrics(run.out)
    if made.splats is not None and not has_cloud(run, made):
        export(run, made.splats, scene)
    if not meshed:
        mesh(ctx, made, device)
        if run.recipe.mesh is not None:
            ctx.keep("mesh")
    if not has_lod:
        make_wanted_levels(ctx, made)
        ctx.keep("lod")
    if not has_file:
        make_wanted_compressed(ctx, made)
        ctx.keep("compress")
    metrics = evaluate(run, made, scene, meter, lpips_weights="gpu")
    return measure_compressed(ctx, made) if run.recipe.compress and has_compressed(run, made.last_steps) else metrics


def has_cloud(run: Run, made: Reconstruction) -> bool:
    """Whether the points are written, if there are any and they can be."""
    if made.splats is None:
        return True
    return run.cloud.exists() or (not made.splats.primitive.in_ply and run.cameras.exists())


def export(run: Run, splats: SplatModel, scene: Scene) -> None:
    """Write the points and the cameras in the frame of the input."""
    write_cameras(run.cameras, scene)
    emit(FileWritten(run.cameras, "cameras"))
    if not splats.primitive.in_ply:
        emit(Warned(f"no {run.cloud.name}: PLY files of splats have no place for {name_of(splats.primitive)}"))
        return
    table = splats.primitive.table(splats.params).in_input_frame(scene.frame)
    table.refuse_unsound(run.cloud)
    write_splats(run.cloud, table, frame=scene.frame)
    emit(FileWritten(run.cloud, "points"))


def mesh(ctx: RunContext, made: Reconstruction, device: Device) -> None:
    """Write the mesh of the method, or make the one that the recipe wants, with depth maps if it wants some, also for a
    run that was trained without.

    A surface that cannot be had is told, and costs no measurements.
    """
    mesher, budget = ctx.run.recipe.mesh, cache_bytes("auto")
    try:
        if made.mesh is not None:
            what = mesh_input(ctx.run, made, ctx.scene, ctx.rasterizer, budget)
            make_mesh(ctx.run, made.mesh, MeshOutput(), what, made.last_steps)
            return
        assert mesher is not None, "a run without a mesh of its own comes here if its recipe wants one"
        with with_maps_to_mesh(ctx.run, mesher, ctx.scene, ctx.caches, device) as run:
            what = mesh_input(run, made, ctx.scene, ctx.rasterizer, budget, mesher)
            make_mesh(run, mesher, MeshOutput(), what, made.last_steps)
    except BadInput as error:
        emit(Warned(f"there is no mesh: {error}; `{ctx.run.to_paste('mesh')}` tries again with other settings"))


def opened(out: Path) -> Run:
    """A run folder and what it was made from, finished or not.

    Raises:
        BadInput: The folder holds no run.
    """
    refuse_no_run(out)
    refuse_links(out)
    return Run(out, read_json(out / "recipe.json", Recipe), read_data(out))


@contextmanager
def loaded(
    out: Path, device: Device, compressed: bool = False, read_data: Callable[[Run], Scene] = read_unchanged
) -> Iterator[tuple[RunContext, Reconstruction]]:
    """Within, what a finished run has come to, and what it was made from.

    Args:
        out: Run folder.
        device: For rendering.
        compressed: Give its compressed model instead, and the folder of that one for results.
        read_data: Reads the data set; by default, one that has changed since the run was trained is refused.

    Raises:
        BadInput: The folder holds no run, or one that is not finished, or no compressed model; or the data set is gone
            or has changed.
    """
    with _loaded(out, device, read_data) as (ctx, made):
        yield decompressed(ctx, made) if compressed else (ctx, made)


@contextmanager
def _loaded(
    out: Path, device: Device, read_data: Callable[[Run], Scene]
) -> Iterator[tuple[RunContext, Reconstruction]]:
    run = opened(out)
    if run.recipe.has_stages:
        run, state, scene = load_run(out, read_data)
        ctx = RunContext(run, scene, select_rasterizer(device)[0], Intervals(), CacheSettings())
        yield ctx, with_drawing(optimised(run, state), ctx.rasterizer)
        return
    if not result_path(run).exists():
        raise BadInput(
            f"{out}: method:{name_of(run.recipe.method)} has not finished; `{train_command(run)}` finishes it"
        )
    ctx = RunContext(run, read_data(run), select_rasterizer(device)[0], Intervals(), CacheSettings())
    with method_input(ctx, device) as given:
        yield ctx, reopened(run, given)


def load_run(out: Path, read_data: Callable[[Run], Scene] = read_unchanged) -> tuple[Run, StageState, Scene]:
    """The folder of a run in stages, the state of its optimisation, and the scene that it was made from.

    Raises:
        BadInput: The folder holds no run, or one that is not finished; or the data set is gone or has changed.
    """
    run = opened(out)
    if not run.recipe.has_stages:
        raise BadInput(f"{out}: method:{name_of(run.recipe.method)} has no stages, and so no state of an optimisation")
    scene = read_data(run)
    state, missing = None, None
    for stage in reversed(run.stages):
        if (state := load_state(run, stage, stage_scene(run, stage, scene))) is not None:
            break
        missing = stage
    step, again = state.index if state else 0, f"`{train_command(run)}` finishes it"
    if step < stage.stage.steps:
        raise BadInput(f"{out}: the run stopped after step {step} of {stage.stage.steps}; {again}")
    if missing is not None:
        what = "not all blocks are tuned" if missing.name == "tune" else f"{missing.name} is not begun"
        raise BadInput(f"{out}: {what}; {again}")
    assert state is not None, "a stage without a state is missing"
    return run, state, scene


def warn_of_idle(run: Run, compute: Compute) -> None:
    """Say that an executor was chosen for nothing."""
    if run.recipe.partition is None and not compute.workers.in_process:
        emit(Warned("the recipe cuts the scene into no blocks, so the executor has nothing to do; see partition"))
