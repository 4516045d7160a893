"""Quality and cost of a tree of splats (lod:hierarchy) beside merged levels (lod:merge), at as many splats.

    surfkit train recipe:3dgs --data SCENE --scale 4 --steps 600 --out RUN
    python bench/hierarchy.py RUN --steps 600
    python bench/hierarchy.py --million

The first measures against renders of the full model, from the held-out views: PSNR, splats that touch the picture, and
milliseconds of choosing and drawing them. Levels are drawn whole, and the tree at the granularity that shows as many
splats, without and with as many optimisation steps as all the levels together. The second builds the tree of a million
random splats, without optimisation.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from machine import save

from surfkit.compress.levels import Hierarchy, MergedLevels
from surfkit.compress.levels.base import LodInput
from surfkit.compress.levels.hierarchy import merged_tree
from surfkit.primitives import Gaussian3D
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import SplatModel
from surfkit.raster.api import Splats
from surfkit.raster.base import Rasterizer
from surfkit.runs.pipeline import loaded
from surfkit.runs.run_method import splats_of
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints

PIXELS = (2.0, 4.0, 8.0, 16.0, 32.0)
"""Granularities of the first table."""
HALVINGS = 12
"""Of the interval in which the granularity of as many splats is looked for."""


class Comparison:
    """Pictures of the full model from some cameras, and what others come to beside them."""

    def __init__(self, model: SplatModel, cameras: list[Camera], draws: Rasterizer) -> None:
        self.cameras, self.draws, self.near = cameras, draws, model.near
        splats = model.splats.detached()
        self.full = [self.drawn(splats, camera).maps.need("color").clamp(0, 1) for camera in cameras]

    def drawn(self, splats: Splats, camera: Camera):
        """One view."""
        return self.draws.render(splats, camera, self.near, False, False)

    def measured(self, choose: Callable[[Camera], Splats]) -> dict[str, float]:
        """Means over the cameras."""
        psnr, splats, seconds = [], [], []
        for camera, full in zip(self.cameras, self.full, strict=True):
            began = time.perf_counter()
            render = self.drawn(choose(camera), camera)
            color = render.maps.need("color").clamp(0, 1)
            seconds.append(time.perf_counter() - began)
            splats.append(int(render.seen.sum()))
            psnr.append(float(-10 * (color - full).square().mean().clamp_min(1e-14).log10()))
        return {
            "splats": round(float(np.mean(splats))),
            "psnr": round(float(np.mean(psnr)), 2),
            "ms": round(1e3 * float(np.median(seconds)), 1),
        }


def compare(run: Path, steps: int) -> dict:
    """The tables of a run."""
    with loaded(run, "cpu") as (ctx, made), tempfile.TemporaryDirectory() as folder:
        model = splats_of(ctx.run, made)
        draws = drawn_by(model.primitive, ctx.rasterizer)
        views = ctx.scene.held_out or ctx.scene.train
        comparison = Comparison(model, [view.camera for view in views], draws)
        given = LodInput(model, ctx.scene.train, draws, ctx.scene.frame, 0, Path(folder))
        plain, each = MergedLevels(steps=0), {}
        count = len(plain.build(given).levels) - 1
        makers = {
            "merge": plain,
            "merge, optimised": MergedLevels(steps=steps // count),
            "hierarchy": Hierarchy(steps=0),
            "hierarchy, optimised": Hierarchy(steps=steps),
        }
        seconds = {}
        for name, maker in makers.items():
            began = time.process_time()
            each[name] = maker.build(given)
            seconds[name] = round(time.process_time() - began, 1)
            print(name, seconds[name], "CPU s", flush=True)
        trees = {name: tree for name, tree in each.items() if "hierarchy" in name}
        granularities = {
            name: {f"{px:g} px": comparison.measured(lambda c, t=tree, p=px: t.seen(c, p)) for px in PIXELS}
            for name, tree in trees.items()
        }
        rows = []
        for level in range(count + 1):
            shown = {n: t.levels[level].splats.detached() for n, t in each.items() if "merge" in n}
            row = {n: comparison.measured(lambda _, s=s: s) for n, s in shown.items()}
            if level:
                row |= {n: alike(comparison, tree, row["merge"]["splats"]) for n, tree in trees.items()}
            rows.append(row)
            print(row, flush=True)
        return {
            "points": len(model),
            "views": len(views),
            "size": [views[0].camera.width, views[0].camera.height],
            "steps": steps,
            "cpu_seconds": seconds,
            "granularities": granularities,
            "as_many_splats": rows,
        }


def alike(comparison: Comparison, tree, splats: int) -> dict[str, float]:
    """A tree at the granularity with which it shows about so many splats."""
    low, high = 0.1, 1000.0
    for _ in range(HALVINGS):
        middle = (low * high) ** 0.5
        found = comparison.measured(lambda camera, px=middle: tree.seen(camera, px))
        low, high = (middle, high) if found["splats"] > splats else (low, middle)
    return found | {"pixels": round(middle, 2)}


def million(count: int = 1_000_000) -> dict[str, float]:
    """Seconds and memory of a tree of random splats, and of one cut."""
    draw, primitive = torch.Generator().manual_seed(0), Gaussian3D(sh_degree=0)
    xyz = torch.rand(count, 3, generator=draw) * torch.tensor([1.0, 1.0, 0.05])
    cloud = SparsePoints(xyz, torch.full((count, 3), 128, dtype=torch.uint8), size=torch.full((count,), 5e-4))
    model = SplatModel(primitive, primitive.init(cloud, draw))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.process_time()
    tree = merged_tree(model, 8_192)
    seconds = time.process_time() - began
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-0.5, -0.5, 0.4])
    camera = Camera(pose, 1000.0, 1000.0, 500.0, 500.0, 1000, 1000)
    tree.seen(camera, 4.0)  # the boxes are made
    began = time.process_time()
    shown = len(tree.seen(camera, 4.0))
    return {
        "splats": count,
        "cpu_seconds": round(seconds, 1),
        "cut_cpu_seconds": round(time.process_time() - began, 2),
        "cut_splats": shown,
        "peak_gigabytes": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
        "peak_before_gigabytes": round(before / 2**20, 2),
    }


def main() -> None:
    """Measure, and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", type=Path)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--million", action="store_true")
    words = parser.parse_args()
    if words.million:
        figures = million()
        print(figures, save("hierarchy_million", figures))
    elif words.run is not None:
        print(save("hierarchy", compare(words.run, words.steps)))
    else:
        parser.error("give a run folder, or --million")


if __name__ == "__main__":
    main()
