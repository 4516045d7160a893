"""What two processes that train one model together (`surfkit train --processes 2`) save against a single one.

    python bench/divided.py                       # 500,000 surfels, 640 x 480 pixels; some minutes
    python bench/divided.py --spread 2            # each view shows a quarter of them
    python bench/divided.py --points 100000 --steps 6 --no-save

Discs of terrain, all of them in view unless it is spread, with harmonics of degree 3, in the steps of recipe:2dgs after
step 8,000: all its losses, Adam, statistics of densification. One thread for each process. Of each step, after four to
warm up: seconds by the clock, and CPU seconds of the process, with all its threads; medians, of two processes those of
the slower one. On a machine with other work the CPU seconds tell, as then the clock also counts the waiting. Memory:
the highest resident memory while the steps are made, above that after the imports and a step with few points; and what
the points take as tensors.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from machine import save

from surfkit.core.memory import give_back, peak_memory_bytes, reset_peak_memory, resident_bytes
from surfkit.primitives import Surfel2D
from surfkit.primitives.points import Points
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.study.recipes import RECIPES
from surfkit.train.divide import share
from surfkit.train.exchange import DividedRasterizer
from surfkit.train.processes import Processes
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer
from surfkit.train.view_order import ViewOrder

BEGIN, WARM, FEW = 8_000, 4, 200
"""Step to begin after, when every loss of recipe:2dgs counts; steps that are not counted; points of a first trial."""


def views(width: int, height: int) -> list[View]:
    """Cameras above the terrain that see nearly all of it."""
    found = []
    for at in range(4):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
        pose[:3, 3] = -pose[:3, :3] @ torch.tensor([0.02 * at - 0.03, 0.0, 1.0], dtype=torch.float64)
        camera = Camera(pose, width * 0.95, width * 0.95, width / 2, height / 2, width, height)
        found.append(View(f"{at}.png", camera, Path(f"{at}.png")))
    return found


def terrain(count: int, width: int, height: int, rows: slice, spread: float) -> dict[str, torch.Tensor]:
    """Raw parameters of some rows of discs in no order, on hills, `spread` times as wide as a view."""
    draw = torch.Generator().manual_seed(1)
    xy = spread * (torch.rand(count, 2, generator=draw) - 0.5) * torch.tensor([1.0, height / width])
    z = 0.03 * torch.sin(9 * xy[:, :1]) * torch.cos(7 * xy[:, 1:])
    spacing = spread * (height / width / count) ** 0.5
    whole = {
        "means": torch.cat([xy, z], 1),
        "quats": torch.tensor([1.0, 0, 0, 0]) + 0.1 * torch.randn(count, 4, generator=draw),
        "scales": torch.full((count, 2), spacing * 0.8).log() + 0.3 * torch.randn(count, 2, generator=draw),
        "opacities": torch.randn(count, generator=draw),
        "sh0": 0.5 * torch.randn(count, 1, 3, generator=draw),
        "sh_rest": 0.05 * torch.randn(count, 15, 3, generator=draw),
    }
    return {name: value[rows].clone() for name, value in whole.items()}


def measure(args: argparse.Namespace, processes: Processes | None) -> dict[str, Any]:
    """What the steps of this process take."""
    if args.points > FEW:  # what a first step loads and keeps is no memory of the model
        measure(argparse.Namespace(points=FEW, size=(64, 64), steps=1, spread=1.0), processes)
    begin, (width, height) = resident_bytes(), args.size
    rows = slice(0, args.points) if processes is None else share(args.points, processes)
    stage, primitive, shown = RECIPES["2dgs"].pretrain, Surfel2D(3), views(width, height)
    smooth = torch.rand(3, height // 8, width // 8, generator=torch.Generator().manual_seed(3))
    photo = torch.nn.functional.interpolate(smooth[None] * 255, (height, width), mode="bilinear")[0].to(torch.uint8)
    points = Points.fresh(terrain(args.points, width, height, rows, args.spread))
    rasterizer = NativeRasterizer() if processes is None else DividedRasterizer(NativeRasterizer(), processes)
    trainer = Trainer(stage, primitive, shown, [photo] * len(shown), rasterizer)
    state = StageState(points, ViewOrder(len(shown)), torch.Generator().manual_seed(4), index=BEGIN + 1, sh_degree=3)
    wall, cpu = [], []
    give_back()
    reset_peak_memory()
    for at in range(WARM + args.steps):
        if processes is not None:
            dist.barrier()
        began = time.perf_counter(), time.process_time()
        done = trainer.step(state)
        if at >= WARM:
            wall.append(time.perf_counter() - began[0])
            cpu.append(time.process_time() - began[1])
    return {
        "wall_s": statistics.median(wall),
        "cpu_s": statistics.median(cpu),
        "peak_bytes": peak_memory_bytes() - begin,
        "points_bytes": state.points.nbytes,
        "points": len(state.points),
        "loss": sum(done.losses.values()),
    }


def process(rank: int, count: int, folder: str, args: argparse.Namespace, said: Any) -> None:
    """One of them."""
    torch.set_num_threads(1)
    os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
    if count > 1:
        dist.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=count)
    said.put((rank, measure(args, Processes(rank, count) if count > 1 else None)))
    if count > 1:
        dist.destroy_process_group()


def together(count: int, args: argparse.Namespace) -> dict[str, Any]:
    """The figures of the slower and larger of some processes."""
    spawn = multiprocessing.get_context("spawn")
    said = spawn.SimpleQueue()
    with tempfile.TemporaryDirectory() as folder:
        started = [spawn.Process(target=process, args=(rank, count, folder, args, said)) for rank in range(count)]
        for each in started:
            each.start()
        found = [said.get()[1] for _ in started]
        for each in started:
            each.join()
    return {name: max(each[name] for each in found) for name in found[0]}


def main() -> None:
    """Measure one and two processes in turn, and print and keep medians of the rounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--spread", type=float, default=1.0, help="of the terrain, in widths of a view")
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--no-save", action="store_true")
    args = parser.parse_args()
    found: dict[int, list[dict[str, Any]]] = {1: [], 2: []}
    for _ in range(args.rounds):
        for count, each in found.items():
            each.append(together(count, args))
            print(count, {name: round(value, 4) for name, value in each[-1].items()}, flush=True)
    one, two = ({n: statistics.median(each[n] for each in found[count]) for n in found[count][0]} for count in found)
    ratios = {
        "times_the_speed_by_the_clock": one["wall_s"] / two["wall_s"],
        "times_the_speed_by_cpu_seconds_of_a_process": one["cpu_s"] / two["cpu_s"],
        "share_of_peak_memory": two["peak_bytes"] / one["peak_bytes"],
        "share_of_points_memory": two["points_bytes"] / one["points_bytes"],
    }
    print(ratios)
    if not args.no_save:
        shape = {"points": args.points, "width": args.size[0], "height": args.size[1], "spread": args.spread}
        name = "divided" if args.spread == 1 else "divided_spread"
        print(save(name, {**shape, "rounds": args.rounds, "one": one, "two": two, **ratios}))


if __name__ == "__main__":
    main()
