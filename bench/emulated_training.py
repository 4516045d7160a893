"""A training with emulated CUDA kernels beside the same one on the CPU: `python bench/emulated_training.py`.

A synthetic scene of 64 x 64 pixels, 2D Gaussians with the decomposed gradient, all losses of 2DGS, clones and
splits. Both begin with the same points; sums are taken in other orders, so parameters drift apart. Takes a minute;
tests/train/test_gpu.py compares the first steps more closely.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import torch
from machine import save

from surfkit.densify.adc import ADC
from surfkit.densify.signal import LossGradient
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.surface import Distortion, NormalConsistency
from surfkit.primitives import Surfel2D
from surfkit.primitives.points import Points
from surfkit.raster.base import Rasterizer
from surfkit.raster.cuda.rasterizer import TileRasterizer, source
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.raster.psnr import psnr
from surfkit.raster.select import select
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Scene
from surfkit.testing.simulated_gpu import GPU, simulated_gpu
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.stage import Stage
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer

SIDE = 64


class EmulatedGpu(TileRasterizer):
    """The CUDA kernels, emulated."""

    def __init__(self) -> None:
        super().__init__()
        self.made: dict[object, Emulated] = {}

    def where(self) -> torch.device:
        return GPU

    def program(self, name: str, **defines: int) -> Emulated:
        key = name, *sorted(defines.items())
        if key not in self.made:
            self.made[key] = Emulated(source(name, **defines), device=GPU)
        return self.made[key]


def trained(scene: Scene, stage: Stage, rasterizer: Rasterizer) -> tuple[StageState, float]:
    """The state after all steps, and seconds."""
    primitive, generator = Surfel2D(sh_degree=3), torch.Generator().manual_seed(0)
    photos = [view_photo(view) for view in scene.train]
    trainer = Trainer(stage, primitive, scene.train, photos, rasterizer)
    state = trainer.begin(Points.fresh(primitive.init(scene.cloud, generator)), generator)
    began = time.perf_counter()
    for done in trainer.run(state):
        if done.index % 10 == 0:
            print(f"step {done.index}, {len(state.points)} points, {time.perf_counter() - began:.0f} s", flush=True)
    return state, time.perf_counter() - began


def decibels(scene: Scene, state: StageState, stage: Stage, rasterizer: Rasterizer) -> float:
    """Of the training views, drawn on the CPU."""
    splats = Surfel2D(sh_degree=3).activate(state.points.params, state.sh_degree)
    colors = [rasterizer.render(splats, view.camera, stage.near, geometry=False).maps.color for view in scene.train]
    return psnr(torch.stack(colors), torch.stack([view_photo(view) for view in scene.train]) / 255)


def main() -> None:
    """Train twice, and print and save how far both lie apart."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=50)
    options = parser.parse_args()
    edits = ADC(start=5, until=options.steps - 5, every=10, threshold=2e-4, reset_every=10 * options.steps)
    losses = {"l1": L1(), "ssim": SSIM(), "normal": NormalConsistency(start=0), "distortion": Distortion(1.0, start=0)}
    stage = Stage(steps=options.steps, losses=losses, densify=edits, signal=LossGradient(terms=("ssim",), boost=0.9))
    cpu = select("cpu")[0]
    with tempfile.TemporaryDirectory() as folder:
        write_colmap(Path(folder), photograph(Flight(views=8, width=SIDE, height=SIDE)))
        scene = read(Data(Path(folder)))
        here, seconds = trained(scene, stage, cpu)
        with simulated_gpu():
            there, emulated = trained(scene, stage, EmulatedGpu())
            there.move(torch.device("cpu"))
        figures = {
            "steps": options.steps,
            "points": [len(here.points), len(there.points)],
            "points at the start": len(scene.cloud.xyz),
            "PSNR": [round(decibels(scene, state, stage, cpu), 4) for state in (here, there)],
            "seconds": [round(seconds, 1), round(emulated, 1)],
        }
    if len(here.points) == len(there.points):
        pairs = zip(here.points.params.values(), there.points.params.values(), strict=True)
        apart = {name: (a - b).abs() for name, (a, b) in zip(here.points.params, pairs, strict=True)}
        figures["median difference"] = {name: float(off.median()) for name, off in apart.items()}
        figures["largest difference"] = {name: float(off.max()) for name, off in apart.items()}
    for name, value in figures.items():
        print(f"{name}: {value}")
    print(save("emulated_training", figures))


if __name__ == "__main__":
    main()
