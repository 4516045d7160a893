"""What a step costs as a survey grows: `python bench/growth.py --photographs 2000 8000`.

Made-up surveys of flat ground: photographs of 160 x 120 px in rows, so that each point is in about 25 of them, and as
many points in each view whatever the number of photographs. For each survey and each optimizer, a process of its own
takes steps of 2DGS, without densification and between the edits of one. They are spread over all photographs: the
median CPU time of a step, all threads, and the peak of the memory; of the anonymous memory, which the system cannot put
aside, the peak while steps are taken. Points are made at once, not read; photographs are noise, made when they are
asked for, so that neither files nor the cache count. --points-on disk keeps the points in files in --scratch.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from machine import save
from torch import Tensor

from surfkit.core.memory import give_back, peak_memory_bytes
from surfkit.core.registry import find
from surfkit.primitives.points import Points
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints, View
from surfkit.study.recipes import SURFELS
from surfkit.train.optimizer import Optimizer
from surfkit.train.points_on import PointsOn
from surfkit.train.trainer import Trainer

POINTS_PER_PHOTOGRAPH = 198
WIDTH, HEIGHT, FOCAL_PX = 160, 120, 140.0
APART = 0.22
"""Distance of neighbouring cameras, as a share of their height."""


@dataclass(frozen=True)
class Noise(Sequence[Tensor]):
    """Photographs that are made when they are asked for."""

    count: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, at: int) -> Tensor:  # type: ignore[override]
        draw = torch.Generator().manual_seed(at)
        return torch.randint(0, 256, (3, HEIGHT, WIDTH), generator=draw, dtype=torch.uint8)


def survey(photographs: int) -> tuple[tuple[View, ...], SparsePoints]:
    """Cameras that look down, and points on the ground, in a frame whose extent is about 1."""
    across = math.ceil(math.sqrt(photographs))
    height = 2 / (across * APART)
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    views = []
    for at in range(photographs):
        x, y = ((k + 0.5) * APART * height - 1 for k in divmod(at, across))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ torch.tensor([x, y, height], dtype=torch.float64)
        camera = Camera(pose, FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
        views.append(View(f"{at}.png", camera, Path(f"{at}.png")))
    count, draw = POINTS_PER_PHOTOGRAPH * photographs, torch.Generator().manual_seed(0)
    xyz = torch.rand(count, 3, generator=draw) * torch.tensor([2.0, 2.0, 0.02 * height]) - torch.tensor([1.0, 1.0, 0.0])
    rgb = torch.randint(0, 256, (count, 3), generator=draw, dtype=torch.uint8)
    return tuple(views), SparsePoints(xyz, rgb, size=torch.full((count,), 0.5 * 2 / math.sqrt(count)))


@contextmanager
def watched(every_s: float = 0.005) -> Iterator[list[int]]:
    """Within, the anonymous memory of this process is looked at every so often: the bytes held."""
    found, over = [], threading.Event()

    def look() -> None:
        while not over.is_set():
            text = Path("/proc/self/status").read_text()
            found.append(1024 * int(re.search(r"RssAnon:\s*(\d+)", text)[1]))
            over.wait(every_s)

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield found
    finally:
        over.set()
        thread.join()


def measured(
    photographs: int, optimizer: str, steps: int, policies: bool, place: str, scratch: Path | None
) -> dict[str, float]:
    """Median CPU milliseconds of a step, and the peaks of this process."""
    views, cloud = survey(photographs)
    stage = replace(SURFELS.pretrain, steps=30_000, optimizer=find(Optimizer, optimizer)())
    stage = stage if policies else replace(stage, densify=None, prune=())
    rasterizer, _ = select("cpu")
    home = PointsOn(place, scratch).home(Path())
    trainer = Trainer(stage, SURFELS.primitive, views, Noise(photographs), rasterizer, home=home)
    generator = torch.Generator().manual_seed(0)
    state = trainer.begin(Points.fresh(SURFELS.primitive.init(cloud, generator), storage=home), generator)
    del cloud
    give_back()
    times, walls, seen = [], [], []
    with watched() as anonymous:
        for index in range(steps + 5):
            began, clock = time.process_time(), time.perf_counter()
            done = trainer.step(state)
            times += [1e3 * (time.process_time() - began)] * (index >= 5)
            walls += [1e3 * (time.perf_counter() - clock)] * (index >= 5)
            seen.append(float(done.maps.need("alpha").mean()))
    return {
        "ms": sorted(times)[len(times) // 2],
        "mean_ms": sum(times) / len(times),
        "wall_ms": sorted(walls)[len(walls) // 2],
        "mean_wall_ms": sum(walls) / len(walls),
        "points": len(state.points),
        "peak_gb": peak_memory_bytes() / 1e9,
        "anonymous_gb": max(anonymous) / 1e9,
        "points_gb": state.points.nbytes / 1e9,
        "alpha": sum(seen) / len(seen),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=int, nargs="+", default=[2000, 8000])
    parser.add_argument("--optimizers", nargs="+", default=["adam", "adam-in-view"])
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--points-on", default="device", choices=["device", "disk"])
    parser.add_argument("--scratch", type=Path, default=Path())
    parser.add_argument("--policies", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        where = given.points_on, given.scratch if given.points_on == "disk" else None
        print(json.dumps(measured(given.photographs[0], given.optimizers[0], given.steps, given.policies, *where)))
        return
    figures = {}
    for optimizer, photographs, policies in itertools.product(given.optimizers, given.photographs, (False, True)):
        words = [sys.executable, __file__, "--one", "--photographs", str(photographs), "--optimizers", optimizer]
        words += ["--policies"] * policies + ["--steps", str(given.steps)]
        words += ["--points-on", given.points_on, "--scratch", str(given.scratch)]
        found = json.loads(subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True).stdout)
        name = f"{optimizer} {photographs}" + " with policies" * policies + " disk" * (given.points_on == "disk")
        figures[name] = found
        print(name, *(f"{part} {value:.4g}" for part, value in found.items()), flush=True)
    print(f"wrote {save('growth', figures)}")


if __name__ == "__main__":
    main()
