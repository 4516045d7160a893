"""A half-trained scene to measure on: by default the bundled example at half size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.primitives.points import Points
from surfkit.raster.select import select
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.scene.photos import photo_cache
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer

EXAMPLE = Path(__file__).parents[1] / "examples" / "boruszyn"


def halfway(recipe: Recipe, steps: int, data: Data | None = None) -> tuple[Trainer, StageState]:
    """A trainer of `recipe` in a run of `steps` steps, and its state after half of them."""
    scene = read(data or Data(EXAMPLE, scale=2.0))
    recipe = with_steps(recipe, steps)
    rasterizer, _ = select("cpu")
    trainer = Trainer(recipe.pretrain, recipe.primitive, scene.train, photo_cache(scene.train), rasterizer)
    generator = torch.Generator().manual_seed(0)
    state = trainer.begin(Points.fresh(recipe.primitive.init(scene.cloud, generator)), generator)
    for done in trainer.run(state):
        if done.index == steps // 2:
            return trainer, state
    raise AssertionError("a run has a middle")


def copied(state: StageState) -> StageState:
    """The state with points of its own."""
    return replace(state, points=state.points.take(torch.arange(len(state.points))))
