"""The whole model gone through what its recipe wants of it after the blocks are merged."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from surfkit.raster.api import Rasterizer
from surfkit.run.context import RunContext
from surfkit.run.folder import Run, discard_results
from surfkit.run.journal import kept
from surfkit.run.notes import naming
from surfkit.run.stage import InitialModel, Job, drawing, load_state, optimise
from surfkit.scene.cache import Cache
from surfkit.scene.scene import Scene
from surfkit.train.material import TrainingData, read_ahead
from surfkit.train.meter import Meter
from surfkit.train.stage import StageState

DRAWN_AHEAD = 2
"""Pictures of the model that are kept: each is drawn when its turn comes."""


def refine_model(ctx: RunContext, state: StageState) -> tuple[Run, StageState]:
    """The run and its state after all that the recipe refines; what is done already is not done again.

    Args:
        context: The run, as it stands before the first of them.
        state: Its state then.
    """
    run = ctx.run
    for part in run.parts[run.parts.index(run.part) + 1 :]:
        now = replace(run, part=part)
        state = _gone_through(replace(ctx, run=now), run, state)
        run = now
    return run, state


def _gone_through(ctx: RunContext, before: Run, given: StageState) -> StageState:
    """The state after one of them, from the state before it."""
    run, refine, scene = ctx.run, ctx.run.refined[-1], seen_by(ctx.run, ctx.scene)
    state = load_state(run, scene, repair=True)
    if state is not None and state.index >= run.stage.steps:
        return state
    discard_results(run)

    def start() -> InitialModel:
        params = refine.params(before.stage.finished(given))
        return InitialModel({name: value.clone() for name, value in params.items()}, given.sh_degree)

    intervals, folder = replace(ctx.intervals, pictures=0), run.checkpoint.parent
    folder.mkdir(exist_ok=True)
    with kept(folder), naming(f"{run.title}: "):  # its steps are counted anew, and what is known is not told again
        shown = _drawn(before, given, scene, ctx.rasterizer) if refine.taught else None
        shown = shown or read_ahead(run.data, scene, run.stage.losses, ctx.caches)
        return optimise(Job(run, scene, ctx.rasterizer, intervals, shown, Meter(), start, given), state)


def seen_by(run: Run, scene: Scene) -> Scene:
    """The scene with the views that the stage which is spoken of looks from."""
    return replace(scene, train=run.refined[-1].views(scene.train, run.recipe.seed)) if run.refined else scene


def _drawn(before: Run, given: StageState, scene: Scene, rasterizer: Rasterizer) -> TrainingData:
    """Pictures that the model before draws of the views of a scene."""
    draw = drawing(before, given, rasterizer, geometry=False)

    def picture(at: int) -> Tensor:
        return (draw(scene.train[at]).color.clamp(0, 1) * 255).round().to("cpu", dtype=torch.uint8)

    sizes = [3 * view.camera.width * view.camera.height for view in scene.train]
    return TrainingData(Cache(picture, sizes, DRAWN_AHEAD * max(sizes), threads=1))
