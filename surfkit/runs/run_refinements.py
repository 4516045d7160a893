"""The refinements of a recipe, applied to the whole model after the blocks are merged."""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch
from torch import Tensor

from surfkit.mesh.base import Mesher, MeshInput
from surfkit.primitives.model import SplatModel
from surfkit.raster.base import Rasterizer
from surfkit.runs.context import RunContext
from surfkit.runs.folder import Run, RunStage, discard_results
from surfkit.runs.journal import record_events
from surfkit.runs.make_mesh import mesh_input
from surfkit.runs.measure_run import measure_before
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.photo_light import held_out_response
from surfkit.runs.run_method import with_drawing
from surfkit.runs.run_notes import prefix_notes
from surfkit.runs.run_stage import StageJob, drawing, load_state, optimise
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.cache import Cache
from surfkit.scene.scene import Scene
from surfkit.start.base import InitialModel
from surfkit.train.data_cache import TrainingData, read_ahead
from surfkit.train.memory_meter import MemoryMeter
from surfkit.train.refine.base import Refine
from surfkit.train.state import StageState

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
        return InitialModel({name: value.clone() for name, value in params.items()}, given.sh_degree)

    intervals = replace(ctx.intervals, pictures=0)
    stage.folder.mkdir(exist_ok=True)
    with record_events(stage.folder), prefix_notes(f"{stage.title}: "):  # steps are counted from 1 again
        if state is None:
            measure_before(stage, made(), scene)
        shown = _rendered_data(before, given, scene, ctx.rasterizer) if refine.taught else None
        shown = shown or read_ahead(run.data, scene, stage.stage.losses, ctx.caches)
        meter, points_on = MemoryMeter.of_stage(), ctx.caches.points
        job = StageJob(run, stage, scene, ctx.rasterizer, intervals, shown, meter, start, points_on, given)
        return optimise(job, state)


def stage_scene(run: Run, stage: RunStage, scene: Scene) -> Scene:
    """The scene with the training views of a stage."""
    return scene if stage.refine is None else replace(scene, train=stage.refine.views(scene.train, run.recipe.seed))


def _rendered_data(before: RunStage, given: StageState, scene: Scene, rasterizer: Rasterizer) -> TrainingData:
    """The views of a scene as the model of the stage before renders them, in place of photographs."""
    draw = drawing(before, given, rasterizer, geometry=False)

    def picture(at: int) -> Tensor:
        return (draw(scene.train[at]).need("color").clamp(0, 1) * 255).round().to("cpu", dtype=torch.uint8)

    sizes = [3 * view.camera.width * view.camera.height for view in scene.train]
    return TrainingData(Cache(picture, sizes, DRAWN_AHEAD * max(sizes), threads=1))
