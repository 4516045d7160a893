"""What CUDA kernels should take on GPUs that are not here: `python bench/gpu_model.py`.

A small launch in the emulator gives what each value costs: bytes of global and of shared memory as the threads ask for
them, shuffles. NVRTC gives registers and shared memory of a block, from which follows how many warps a multiprocessor
holds. The time of a full-sized launch is at least that of its busiest part: main memory (each tensor once), the path to
the first cache and shared memory (128 bytes a clock and multiprocessor, a shuffle of a warp counts as 128), arithmetic
(128 fused multiply-adds a clock). Nothing here is measured on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from machine import save

from surfkit.compress.cuda import codes
from surfkit.cuda.emulated import Emulated
from surfkit.cuda.nvrtc import nvrtc, resources
from surfkit.cuda.source import Source
from surfkit.mesh.cuda import grid
from surfkit.mesh.cuda.grid import GpuGrid
from surfkit.mesh.lattice import Lattice, Picture
from surfkit.raster.cuda import ssim
from surfkit.scene.camera import Camera
from surfkit.train import adam


@dataclass(frozen=True)
class Gpu:
    """Figures of its data sheet; memory in bytes per second, registers and shared memory of a multiprocessor."""

    name: str
    architecture: str
    multiprocessors: int
    hertz: float
    memory: float
    warps: int
    blocks: int
    shared: int
    registers: int = 65536

    def resident(self, registers: int, shared: int, threads: int) -> int:
        """Warps of a kernel that a multiprocessor holds at a time; CUDA's rules of rounding."""
        warps = (threads + 31) // 32
        a_warp = (registers * 32 + 255) // 256 * 256
        by_registers = self.registers // 4 // a_warp * 4 // warps
        by_shared = self.shared // ((shared + 1024 + 127) // 128 * 128)
        return min(self.blocks, self.warps // warps, by_registers, by_shared) * warps


GPUS = (
    Gpu("H200", "sm_90", 132, 1.98e9, 4.8e12, 64, 32, 228 << 10),
    Gpu("RTX 4090", "sm_89", 128, 2.52e9, 1.008e12, 48, 24, 100 << 10),
)


@dataclass(frozen=True)
class Case:
    """A kernel at work: `run` launches it on a few values, `values` of them; `total` is the full size."""

    kernel: str
    source: Source
    threads: int
    run: Callable[[Emulated], None]
    values: int
    total: int
    tensors: int
    """Bytes of main memory a value: each tensor read or written once."""
    arithmetic: int
    """Fused multiply-adds a value, or what takes as long."""


def _adam(on: Emulated) -> None:
    adam.launch_update(on, *torch.rand(4, 64 * 1024), 0.1, 5)


def _forward(on: Emulated) -> tuple:
    x, y = torch.rand(2, 1, 128, 128)
    return x, y, ssim.forward(x, y, True, on)[1]


def _backward(on: Emulated) -> None:
    ssim.backward(*_forward(on), torch.tensor(1.0), on)


def _fuse(on: Emulated) -> None:
    """A wall, seen by all voxels of 8 x 8 blocks."""
    lattice = Lattice(0.01, 0.04, low=(-4, -4, 12), high=(4, 4, 13))
    camera = Camera(torch.eye(4, dtype=torch.float64), 100.0, 100.0, 48.0, 48.0, 96, 96)
    depth, shade = np.full((96, 96), 1.0, np.float32), np.full((96, 96), 32 << 24, np.uint32)
    GpuGrid(lattice, on.device, on).fuse(Picture(depth, shade, camera), carve=False)


def _approach(on: Emulated) -> None:
    none, found = torch.empty(0, dtype=torch.int32), torch.empty(128, dtype=torch.int32)
    on.launch("approach", 1, 256, torch.rand(128, 45), torch.rand(64, 45), 45, 64, none, 1.0, 0.0, found)


IMAGE = 3 * 1600 * 1200
WALL = 90_000 * 512  # voxels of the blocks that a view of 1600 x 1200 pixels of the size of a voxel shows
PAIRS = 400_000 * 8_192  # vectors of 45 numbers, and codes
SURFELS = 1_000_000 * 58  # degree 3
CASES = (
    Case("adam", adam.SOURCE, 256, _adam, 64 * 1024, SURFELS, 28, 30),
    Case("ssim_forward", ssim.SOURCE, 128, _forward, 128 * 128, IMAGE, 20, 155),
    Case("ssim_backward", ssim.SOURCE, 128, _backward, 128 * 128, IMAGE, 24, 95),
    Case("fuse", grid.SOURCE, grid.THREADS, _fuse, 64 * 512, WALL, 14, 120),
    Case("approach", codes.SOURCE, 256, _approach, 128 * 64, PAIRS, 0, 2 * 48),
)


def expected(case: Case, gpu: Gpu) -> dict[str, float | int | str]:
    """Milliseconds of each part, the longest of them, and the warps that a multiprocessor holds."""
    on = Emulated(case.source)
    case.run(on)
    work, scale = on.work, case.total / case.values
    used = resources(nvrtc().compile(case.source, gpu.architecture)[1])[case.kernel]
    clocks = gpu.multiprocessors * gpu.hertz
    asked = sum(work.global_bytes) + sum(work.shared_bytes) + 128 * work.collectives
    parts = {
        "main memory": case.total * case.tensors / gpu.memory,
        "first cache and shared": asked * scale / (128 * clocks),
        "arithmetic": case.total * case.arithmetic / (128 * clocks),
    }
    resident = gpu.resident(used["registers"], used["shared"], case.threads)
    times = {name: round(1e3 * seconds, 4) for name, seconds in parts.items()}
    longest = max(times, key=times.get)
    return {"ms": times[longest], "limit": longest, "warps": f"{resident} of {gpu.warps}", **used, "parts_ms": times}


def main() -> None:
    figures = {}
    for case in CASES:
        for gpu in GPUS:
            found = figures[f"{case.kernel} on {gpu.name}"] = expected(case, gpu)
            print(
                f"{case.kernel:<14} {gpu.name:<9} at least {found['ms']:7.3f} ms ({found['limit']}), "
                f"{found['warps']} warps, {found['registers']} registers, {found['shared']} B shared"
            )
    print(save("gpu_model", figures))


if __name__ == "__main__":
    main()
