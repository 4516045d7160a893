"""What a point takes at the peak of a step on a GPU: `python bench/point_memory.py`.

The CUDA kernels run in the emulator, on points of 2DGS of degree 3 that a view of 160 x 120 px shows all of. Every
tensor that torch makes is counted while it lives: of two numbers of points, the difference of the peaks, so that images
do not count. What is held at the peak is listed by the line that made it.
"""

from __future__ import annotations

import sys
import traceback
import weakref
from collections import Counter
from dataclasses import replace
from typing import Any

import torch
from growth import HEIGHT, Noise, survey
from machine import save
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from surfkit.primitives.points import Points
from surfkit.raster.cuda.rasterizer import TileRasterizer, source
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.scene.scene import SparsePoints
from surfkit.study.recipes import SURFELS
from surfkit.train import adam
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.trainer import Trainer

FEW, MANY = 12_000, 24_000


class EmulatedKernels(TileRasterizer):
    """The CUDA rasterizer, on this machine's CPU."""

    def where(self) -> torch.device:
        return torch.device("cpu")

    def program(self, name: str, **defines: int) -> Emulated:
        return Emulated(source(name, **defines))


class Held(TorchDispatchMode):
    """Within, the bytes of all tensors that are made, while they live."""

    def __init__(self) -> None:
        super().__init__()
        self.known: dict[int, tuple[int, str]] = {}
        self.now = self.peak = 0
        self.at_peak: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, torch.Tensor):
                self.see(tensor)
        return out

    def see(self, tensor: torch.Tensor) -> None:
        """Count a tensor once."""
        storage = tensor.untyped_storage()
        key, size = storage._cdata, storage.nbytes()
        if key in self.known or not size:
            return
        lines = [at for at in traceback.extract_stack() if "/surfkit/" in at.filename]
        self.known[key] = size, " ".join(f"{at.filename.rpartition('/')[2]}:{at.lineno}" for at in lines[-2:])
        self.now += size
        if self.now > self.peak:
            self.peak, self.at_peak = self.now, Counter()
            for count, place in self.known.values():
                self.at_peak[place] += count
        weakref.finalize(storage, self.forget, key)

    def forget(self, key: int) -> None:
        """A tensor is gone."""
        self.now -= self.known.pop(key)[0]


def held(count: int, optimizer: Adam) -> Held:
    """Of one step for so many points."""
    draw = torch.Generator().manual_seed(0)
    xyz = torch.rand(count, 3, generator=draw) * torch.tensor([1.0, 1.0, 0.01]) - torch.tensor([0.5, 0.5, 0.0])
    rgb = torch.zeros(count, 3, dtype=torch.uint8)
    cloud = SparsePoints(xyz, rgb, size=torch.full((count,), 1 / count**0.5))
    stage = replace(SURFELS.pretrain, steps=30_000, densify=None, prune=(), optimizer=optimizer, sh_every=1)
    trainer = Trainer(stage, SURFELS.primitive, survey(4)[0], Noise(4), EmulatedKernels())
    meter = Held()
    with meter:
        state = trainer.begin(Points.fresh(SURFELS.primitive.init(cloud, draw)), draw)
        for _ in range(3):  # harmonics of degree 3 by then
            trainer.step(state)
        meter.peak = 0
        trainer.step(state)
    return meter


def main() -> None:
    adam.VALUES_TOGETHER = 20_000  # as a share of the points, as many as of millions
    figures: dict[str, Any] = {}
    for optimizer in (Adam(), Adam(moments="bfloat16"), AdamInView(), AdamInView(moments="bfloat16")):
        few, many = held(FEW, optimizer), held(MANY, optimizer)
        name = f"{type(optimizer).__name__}, {optimizer.moments}"
        figures[name] = (many.peak - few.peak) / (MANY - FEW)
        print(f"{name}: {figures[name]:.0f} bytes a point", file=sys.stderr)
        for place, size in many.at_peak.most_common(8):
            print(f"  {size / MANY:7.1f}  {place}", file=sys.stderr)
    print(f"wrote {save('point_memory', {'bytes a point': figures, 'photograph': [HEIGHT, 160]})}")


if __name__ == "__main__":
    main()
