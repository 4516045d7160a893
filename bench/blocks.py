"""How much faster blocks are tuned by two workers than by one, and how plans of 40 blocks fill 1 to 64 devices.

Two workers have one thread each, as has the one: what is compared is the wall time of tuning the same blocks, start of
the processes included, planning and merging left out. The plans are of a synthetic city, denser in its middle, by the
pixels and points of each block; a device takes the largest block that is left, as `executor:pool` does.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch
from machine import save
from trained import EXAMPLE

from surfkit.cli.recipes import recipes
from surfkit.core.codec import write_json
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.partition import Balanced, CoarseModel, ContractedGrid, Partition, PictureShare, QuantileGrid
from surfkit.partition.plan import BlockMinimums, plan
from surfkit.raster.api import Splats
from surfkit.raster.select import select
from surfkit.runs.blocks.block import load_blocks
from surfkit.runs.blocks.train_blocks import Compute, extract_views, load_or_make_plan, train_waiting
from surfkit.runs.blocks.worker import open_coarse_model
from surfkit.runs.context import RunContext
from surfkit.runs.execute import Pool
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.runs.run_stage import Intervals
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.train.data_cache import CacheSettings


def tuning(steps: int) -> dict[str, float]:
    """Wall seconds of four blocks of the bundled example with one and with two workers."""
    recipe = with_steps(evolve(recipes()["citygs2"], "partition", Balanced(4)), steps)
    for path in ("pretrain.losses", "tune.losses"):
        losses = recipe.pretrain.losses if path.startswith("pretrain") else recipe.tune.losses
        recipe = evolve(recipe, path, {name: loss for name, loss in losses.items() if name != "depth"})
    recipe = evolve(evolve(recipe, "mesh", None), "tune.densify", None)
    seconds = {}
    with tempfile.TemporaryDirectory() as folder:
        data, out = Data(EXAMPLE, scale=2.0), Path(folder) / "run"
        run(replace(recipe, partition=None), data, out, Compute("cpu"), Intervals(pictures=0))
        for workers in (1, 2):
            write_json(out / "recipe.json", recipe)
            for old in ("blocks", "tune"):
                shutil.rmtree(out / old, ignore_errors=True)
            ctx = RunContext(
                Run(out, recipe, data), read(data), select("cpu")[0], Intervals(pictures=0), CacheSettings("1GB")
            )
            blocks = load_blocks(ctx.run, load_or_make_plan(ctx, open_coarse_model(ctx.run)).plan)
            extract_views(ctx, blocks)
            began = time.perf_counter()
            train_waiting(ctx, list(blocks), Compute("cpu", Pool(workers=workers, threads=1)), len(blocks))
            seconds[f"{workers} workers s"] = time.perf_counter() - began
    return seconds | {"faster with 2": seconds["1 workers s"] / seconds["2 workers s"]}


def city(points: int = 20_000, side: int = 20) -> CoarseModel:
    """Discs on the ground, four times as dense in the middle, under a grid of cameras that look down."""
    draws = torch.Generator().manual_seed(0)
    xy = torch.rand(points, 2, generator=draws) * 2 - 1
    xy = xy.sign() * xy.abs() ** 1.5
    means = torch.cat([xy, 0.02 * torch.rand(points, 1, generator=draws)], 1)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(points, 4).contiguous()
    sizes, opaque, grey = torch.full((points, 2), 0.012), torch.full((points,), 0.9), torch.zeros(points, 1, 3)
    views = []
    for at in range(side * side):
        x, y = (-0.9 + 1.8 * place / (side - 1) for place in divmod(at, side))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
        pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, y, 0.25], dtype=torch.float64)
        views.append(View(f"{at:04}", Camera(pose, 60.0, 60.0, 32.0, 24.0, 64, 48), path=EXAMPLE))
    return CoarseModel(Splats("surfel", means, quats, sizes, opaque, grey), views, select("cpu")[0], 0.01)


def efficiency(costs: list[float], devices: int) -> float:
    """Share of the time that devices are busy, when each takes the largest block that is left."""
    busy = [0.0] * devices
    for cost in sorted(costs, reverse=True):
        busy[busy.index(min(busy))] += cost
    return sum(costs) / (devices * max(busy))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_200)
    options = parser.parse_args()
    figures: dict[str, float] = {}
    sight = city()
    plans: dict[str, Partition] = {
        "contracted 8x5": ContractedGrid((8, 5)),
        "quantile 8x5": QuantileGrid((8, 5)),
        "balanced 40": Balanced(40, threshold=0.02),
    }
    for name, partition in plans.items():
        costs = [block.work for block in plan(sight, partition, PictureShare(0.02), BlockMinimums(1, 0, 0)).blocks]
        figures[f"{name}: largest against mean"] = max(costs) * len(costs)
        for devices in (1, 2, 4, 8, 16, 32, 64):
            figures[f"{name}: efficiency on {devices}"] = efficiency(costs, devices)
    figures |= tuning(options.steps)
    for name, value in figures.items():
        print(f"blocks {name} {value:.4g}")
    print(f"wrote {save('blocks', figures)}")


if __name__ == "__main__":
    main()
