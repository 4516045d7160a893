"""The whole model gone through what its recipe wants of it after the blocks are merged."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from surfkit.raster.api import Rasterizer
from surfkit.run.context import Site
from surfkit.run.folder import Run, discard_results
from surfkit.run.journal import kept
from surfkit.run.notes import naming
from surfkit.run.stage import Begun, Job, drawing, optimise, saved
from surfkit.scene.cache import Cache
from surfkit.scene.scene import Scene
from surfkit.train.material import Material, read_ahead
from surfkit.train.meter import Meter
from surfkit.train.stage import StageState

DRAWN_AHEAD = 2
"""Pictures of the model that are kept: each is drawn when its turn comes."""


def refined(site: Site, state: StageState) -> tuple[Run, StageState]:
    """The run and its state after all that the recipe refines; what is done already is not done again.

    Args:
        site: The run, as it stands before the first of them.
        state: Its state then.
    """
    this = site.this
    for part in this.parts[this.parts.index(this.part) + 1 :]:
        now = replace(this, part=part)
        state = _gone_through(replace(site, this=now), this, state)
        this = now
    return this, state


def _gone_through(site: Site, before: Run, given: StageState) -> StageState:
    """The state after one of them, from the state before it."""
    this, refine, scene = site.this, site.this.refined[-1], seen_by(site.this, site.scene)
    state = saved(this, scene, repair=True)
    if state is not None and state.index >= this.stage.steps:
        return state
    discard_results(this)

    def start() -> Begun:
        params = refine.params(before.stage.finished(given))
        return Begun({name: value.clone() for name, value in params.items()}, given.sh_degree)

    every, folder = replace(site.every, pictures=0), this.checkpoint.parent
    folder.mkdir(exist_ok=True)
    with kept(folder), naming(f"{this.title}: "):  # its steps are counted anew, and what is known is not told again
        shown = _drawn(before, given, scene, site.rasterizer) if refine.taught else None
        shown = shown or read_ahead(this.data, scene, this.stage.losses, site.store)
        return optimise(Job(this, scene, site.rasterizer, every, shown, Meter(), start, given), state)


def seen_by(this: Run, scene: Scene) -> Scene:
    """The scene with the views that the stage which is spoken of looks from."""
    return replace(scene, train=this.refined[-1].views(scene.train, this.recipe.seed)) if this.refined else scene


def _drawn(before: Run, given: StageState, scene: Scene, rasterizer: Rasterizer) -> Material:
    """Pictures that the model before draws of the views of a scene."""
    draw = drawing(before, given, rasterizer, geometry=False)

    def picture(at: int) -> Tensor:
        return (draw(scene.train[at]).color.clamp(0, 1) * 255).round().to("cpu", dtype=torch.uint8)

    sizes = [3 * view.camera.width * view.camera.height for view in scene.train]
    return Material(Cache(picture, sizes, DRAWN_AHEAD * max(sizes), threads=1))
