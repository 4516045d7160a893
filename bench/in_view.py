"""What it saves to update only the points in view: `python bench/in_view.py RUN SCENE --metres-per-unit 1`.

The model of a run takes steps for all points and for those in view, in turns, each pair on the same photograph; nothing
is edited. The median of the ratio of CPU times of all threads, and how many points are in view.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import torch
from machine import save

from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.raster.select import select
from surfkit.scene.photos import view_photo
from surfkit.study.recipes import RECIPES
from surfkit.train import checkpoint
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.in_view import PointsInView
from surfkit.train.trainer import Trainer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run of recipe:surface")
    parser.add_argument("scene", type=Path, help="its data set")
    parser.add_argument("--metres-per-unit", type=float)
    parser.add_argument("--rounds", type=int, default=60)
    options = parser.parse_args()
    scene = read(Data(options.scene, metres_per_unit=options.metres_per_unit))
    recipe = RECIPES["surface"]
    stage = replace(recipe.pretrain, densify=None, losses={n: recipe.pretrain.losses[n] for n in ("l1", "ssim")})
    photos, (rasterizer, _) = [view_photo(view) for view in scene.train], select("cpu")
    ways = {}
    for name, optimizer in (("all", Adam()), ("in-view", AdamInView())):
        state = checkpoint.load(options.run / "pretrain" / "checkpoint.safetensors")
        state.points.stats.clear()
        ways[name] = (
            Trainer(replace(stage, optimizer=optimizer), recipe.primitive, scene.train, photos, rasterizer),
            state,
        )
    times: dict[str, list[float]] = {name: [] for name in ways}
    shares = []
    for index in range(options.rounds + 3):
        for name, (trainer, state) in ways.items():
            state.index = 1_000 + index
            state.order.at = index % len(state.order.queue)  # the same photograph for both
            began = time.process_time()
            done = trainer.step(state)
            times[name] += [time.process_time() - began] * (index >= 3)
        shares.append(
            float(PointsInView.of_step(trainer, state, done.target.view.camera).rows.numel() / len(state.points))
        )
    taken = {name: torch.tensor(each) for name, each in times.items()}
    figures = {
        "points": len(state.points),
        "share in view": round(float(torch.tensor(shares).median()), 3),
        "CPU-s of a step for all": round(float(taken["all"].median()), 4),
        "CPU-s of a step in view": round(float(taken["in-view"].median()), 4),
        "ratio": round(float((taken["in-view"] / taken["all"]).median()), 3),
    }
    for name, value in figures.items():
        print(f"{name} {value:.4g}")
    print(f"wrote {save('in_view', figures)}")


if __name__ == "__main__":
    main()
