"""PSNR over the CPU time of steps: `OMP_WAIT_POLICY=passive python bench/optimizers.py SCENE [SCENE ...]`.

For each optimizer a run of `recipe:2dgs` with losses of colours, begun at the sparse points of a data set and shortened
to some hundred steps: with these points alone or, with `--densify`, with those that the recipe adds and drops. Learning
rates but those of positions are multiplied by what stands behind an optimizer, as in `adam*8`; with `adam*8-1` the
factor falls from 8 to 1. CPU time is that of all threads within the steps; without OMP_WAIT_POLICY, threads that wait
for others on a busy machine count as work. PSNR is the mean of the held-out photographs, every eighth.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch
from machine import save

from surfkit.core.registry import find
from surfkit.core.schedule import LearningRate, rescale
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.primitives.points import Points
from surfkit.raster.psnr import psnr
from surfkit.raster.select import select
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Scene
from surfkit.study.recipes import SURFELS
from surfkit.train.optimizer import Optimizer
from surfkit.train.stage import rates_of
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer


def times(rate: LearningRate, first: float, last: float) -> LearningRate:
    """A learning rate that is `first` times as high at the begin, and `last` times at the end."""
    return LearningRate(rate.start * first, (rate.start if rate.end is None else rate.end) * last)


def begun(scene: Scene, steps: int, densify: bool, name: str) -> tuple[Trainer, StageState]:
    """Before the first step; `name` as in `adam*8-1`."""
    optimizer, _, factors = name.partition("*")
    first, _, last = factors.partition("-")
    factor = float(first or 1), float(last or first or 1)
    recipe = rescale(SURFELS, steps / SURFELS.pretrain.steps)
    primitive, stage = recipe.primitive, recipe.pretrain
    rates = {n: r if n == "means" else times(r, *factor) for n, r in rates_of(stage, primitive).items()}
    losses = {key: stage.losses[key] for key in ("l1", "ssim")}
    stage = replace(stage, rates=rates, losses=losses, optimizer=find(Optimizer, optimizer)())
    if not densify:
        stage = replace(stage, densify=None)
    trainer = Trainer(stage, primitive, scene.train, [view_photo(view) for view in scene.train], select("cpu")[0])
    generator = torch.Generator().manual_seed(0)
    return trainer, trainer.begin(Points.fresh(primitive.init(scene.cloud, generator)), generator)


def held_out(scene: Scene, trainer: Trainer, state: StageState) -> float:
    """Mean PSNR of the photographs that are held out, dB."""
    splats, near = trainer.primitive.activate(state.points.params, state.sh_degree), trainer.stage.near
    found = [
        psnr(trainer.draws.render(splats, view.camera, near, geometry=False).maps.need("color"), view_photo(view) / 255)
        for view in scene.held_out
    ]
    return sum(found) / len(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+", help="data sets")
    parser.add_argument("--optimizers", nargs="+", default=["adam", "adam-in-view", "adam*8", "adam-in-view*8"])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--marks", type=int, default=3, help="times at which PSNR is measured")
    parser.add_argument("--densify", action="store_true")
    parser.add_argument("--name", default="optimizers", help="of the result")
    given = parser.parse_args()
    figures = {}
    for path in given.scenes:
        scene = read(Data(path, scale=given.scale, test_every=8))
        for name in given.optimizers:
            trainer, state = begun(scene, given.steps, given.densify, name)
            spent, found = 0.0, []
            while state.index < given.steps:
                began = time.process_time()
                trainer.step(state)
                spent += time.process_time() - began
                if state.index % (given.steps // given.marks) == 0:
                    found.append([state.index, round(spent, 1), round(held_out(scene, trainer, state), 2)])
            figures[f"{path.name} {name}"] = {"points": len(state.points), "steps, CPU-s, dB": found}
            print(path.name, name, figures[f"{path.name} {name}"], flush=True)
            save(given.name, figures)


if __name__ == "__main__":
    main()
