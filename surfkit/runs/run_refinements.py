"""The refinements of a recipe, applied to the whole model after the blocks are merged."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json
from surfkit.core.events import Warned, emit
from surfkit.depth.base import DepthEstimator, KnownSurface, KnownSurfaces
from surfkit.depth.depth_map_cache import refuse_unwritable_cache
from surfkit.depth.prepare_depth_maps import DepthPreparation
from surfkit.io.datasets.depth_map_index import read_made
from surfkit.io.datasets.fingerprint import Fingerprint, digest, fingerprint
from surfkit.io.datasets.read import observations
from surfkit.mesh.base import Mesher, MeshInput
from surfkit.primitives.base import refuse_other_params
from surfkit.primitives.model import SplatModel
from surfkit.raster.base import Rasterizer
from surfkit.runs import journal
from surfkit.runs.context import RunContext
from surfkit.runs.ensure_depth_maps import OTHER_MAPS, made_maps, with_priors
from surfkit.runs.folder import Run, RunStage, discard_results
from surfkit.runs.journal import record_events
from surfkit.runs.make_mesh import mesh_input
from surfkit.runs.measure_run import measure_before
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.photo_light import held_out_response
from surfkit.runs.run_cache import versions
from surfkit.runs.run_method import with_drawing
from surfkit.runs.run_notes import prefix_notes
from surfkit.runs.run_stage import StageJob, drawing, load_state, optimise
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.cache import Cache
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Scene
from surfkit.scene.vectors import unit
from surfkit.start.base import InitialModel
from surfkit.train.data_cache import TrainingData, read_ahead
from surfkit.train.memory_meter import MemoryMeter
from surfkit.train.refine.base import Refine
from surfkit.train.state import StageState
from surfkit.train.streaming import open_last

DRAWN_AHEAD = 2
"""Rendered pictures that are cached: each is needed once."""


def refine_model(ctx: RunContext, state: StageState) -> StageState:
    """The state after all refinements of the recipe; those that are done already are not done again.

    Args:
        ctx: The run.
        state: Its state before the first of them.
    """
    for before, stage in itertools.pairwise(ctx.run.stages):
        if stage.refine is not None:
            state = _refine_once(ctx, before, state, stage, stage.refine)
            ctx.keep(stage.name)
    return state


def refuse_unrefinable(ctx: RunContext) -> None:
    """BadInput, before hours are spent on the stages before, if a refinement cannot make the depth maps that it needs.

    Those that are finished, or that another run has made, need none.
    """
    run, shared, done = ctx.run, {} if ctx.shares is None else ctx.shares.found, True
    if not any(refine.estimator for refine in run.recipe.refine):
        return
    for stage in run.stages:
        begun, estimator = open_last(stage.checkpoint), None if stage.refine is None else stage.refine.estimator
        done = done and begun is not None and begun[0].state.index >= stage.stage.steps  # with those before
        if done or estimator is None or stage.name in shared:
            continue
        what = stage.setting.rpartition(".")[0]
        if ctx.caches.maps is None:
            raise BadInput(f"--no-prepare: {what} makes depth maps of what the model draws; leave out one of the two")
        try:
            estimator.refuse_missing()
            estimator.files(ctx.scene.train)  # which are looked for
            maps = DepthPreparation(run.data, estimator, ctx.rasterizer.where())
            maps.refuse_unfit(ctx.scene, observations(run.data, ctx.scene))
        except BadInput as error:
            raise BadInput(f"{what} cannot make its depth maps: {error}") from error
        if begun is None:  # a cache that can only be read may have those of a stage that is begun
            refuse_unwritable_cache(what)


def _refine_once(ctx: RunContext, before: RunStage, given: StageState, stage: RunStage, refine: Refine) -> StageState:
    """The state after one refinement, from the state of the stage before it."""
    run, scene = ctx.run, stage_scene(ctx.run, stage, ctx.scene)
    state = load_state(run, stage, scene, repair=True)
    if state is not None and state.index >= stage.stage.steps:
        return state
    discard_results(run, stage)

    def made() -> Reconstruction:  # made when it is needed, as its activated values take memory
        model = SplatModel(before.primitive, before.stage.finished(given), given.sh_degree, before.stage.near)
        return with_drawing(Reconstruction(splats=model, respond=held_out_response(run, before)), ctx.rasterizer)

    def start(_: torch.Generator) -> InitialModel:
        found = made()
        assert found.splats is not None

        def to_mesh(mesher: Mesher) -> MeshInput:
            return mesh_input(run, found, scene, ctx.rasterizer, cache_bytes("auto"), mesher)

        params = refine.begin(found.splats, to_mesh)
        refuse_other_params(stage.primitive, params, f"{stage.setting}: the points that it begins with")
        return InitialModel({name: value.clone() for name, value in params.items()}, given.sh_degree)

    intervals = replace(ctx.intervals, pictures=0)
    stage.folder.mkdir(exist_ok=True)
    noted = [
        str(line.get("text")) for line in journal.read(stage.folder / journal.JOURNAL_FILE) if line["event"] == "Warned"
    ]
    with ExitStack() as use:
        use.enter_context(record_events(stage.folder))
        use.enter_context(prefix_notes(f"{stage.title}: "))  # steps are counted from 1 again
        if state is None:
            measure_before(stage, made(), scene)
        shown = _rendered_data(before, given, scene, ctx.rasterizer) if refine.taught else None
        own, began = run, time.perf_counter()
        if refine.estimator is not None:
            folder = use.enter_context(_own_maps(ctx, before, given, stage, refine.estimator))
            if state is not None and not any(folder.name in text for text in noted):
                emit(Warned(OTHER_MAPS))
            own, spent = with_priors(run, folder), read_made(folder).cpu_seconds  # also where they were made before
            seconds = given.seconds + time.perf_counter() - began
            given = replace(given, seconds=seconds, cpu_seconds=given.cpu_seconds + spent)
        shown = shown or read_ahead(own.data, scene, stage.stage.losses, ctx.caches)
        meter, points_on = MemoryMeter.of_stage(), ctx.caches.points
        job = StageJob(run, stage, scene, ctx.rasterizer, intervals, shown, meter, start, points_on, given)
        return optimise(job, state)


@contextmanager
def _own_maps(
    ctx: RunContext, before: RunStage, given: StageState, stage: RunStage, estimator: DepthEstimator
) -> Iterator[Path]:
    """Within, there are depth maps that an estimator makes from what the model of the stage before draws: their folder.

    Raises:
        BadInput: They cannot be made.
    """
    run, scene = replace(ctx.run, data=replace(ctx.run.data, priors=None)), ctx.scene
    draw = lru_cache(1)(lambda: drawing(before, given, ctx.rasterizer))

    def see(at: int, camera: Camera) -> KnownSurface:
        maps = draw()(replace(scene.train[at], camera=camera))
        depth, normal = maps.need("median"), unit(maps.need("normal"))
        return KnownSurface(torch.where(depth > 0, 1 / depth.clamp_min(1e-12), 0), normal)

    model = before.stage.finished(given)
    drawn_by = dump(before.primitive), before.stage.near, versions(run.recipe)  # depth is not of the points alone
    prints = fingerprint(scene, read_json(run.inputs, Fingerprint) if run.inputs.exists() else None)
    known = KnownSurfaces(see, digest([str(drawn_by), *(model[name] for name in sorted(model))]))
    device = ctx.rasterizer.where().type
    with made_maps(run, estimator, scene, prints, ctx.caches, device, known) as folder:
        if folder is None:
            raise BadInput(f"{run.data.path}: {stage.setting.rpartition('.')[0]} needs depth maps; leave it out")
        draw.cache_clear()  # activated values of the points take memory
        yield folder


def stage_scene(run: Run, stage: RunStage, scene: Scene) -> Scene:
    """The scene with the training views of a stage."""
    if stage.refine is None:
        return scene
    views = tuple(stage.refine.views(scene.train, run.recipe.seed))
    if not views:
        raise BadInput(f"{stage.setting.rpartition('.')[0]}: views: there are none to look from")
    return replace(scene, train=views)


def _rendered_data(before: RunStage, given: StageState, scene: Scene, rasterizer: Rasterizer) -> TrainingData:
    """The views of a scene as the model of the stage before renders them, in place of photographs."""
    draw = drawing(before, given, rasterizer, geometry=False)

    def picture(at: int) -> Tensor:
        return (draw(scene.train[at]).need("color").clamp(0, 1) * 255).round().to("cpu", dtype=torch.uint8)

    sizes = [3 * view.camera.width * view.camera.height for view in scene.train]
    return TrainingData(Cache(picture, sizes, DRAWN_AHEAD * max(sizes), threads=1))
