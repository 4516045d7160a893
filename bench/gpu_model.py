"""What CUDA kernels should take on GPUs that are not here: `python bench/gpu_model.py`.

A small launch in the emulator gives what each value costs: bytes of global and of shared memory as the threads ask for
them, shuffles. NVRTC gives registers and shared memory of a block, from which follows how many warps a multiprocessor
holds. The time of a full-sized launch is at least that of its busiest part: main memory (each tensor once), the path to
the first cache and shared memory (128 bytes a clock and multiprocessor, a shuffle of a warp counts as 128), arithmetic
(128 fused multiply-adds a clock, in double `doubles`). Nothing here is measured on a GPU.

The rasterizer draws a piece of 64 x 64 pixels of bench/gpu.py's view, with as many surfels a tile, and its launches are
scaled up by the tiles. PTX gives its arithmetic: for each splat once what a kernel has of it, for each warp and splat
what the loops have. torch's sorts are taken as passes over main memory.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from machine import save
from scenes import city

from surfkit.compress.cuda import codes
from surfkit.mesh.cuda import gpu_grid as grid
from surfkit.mesh.cuda.gpu_grid import GpuGrid
from surfkit.mesh.lattice import FusionImage, Lattice
from surfkit.raster.api import Maps
from surfkit.raster.cuda import cuda_ssim as ssim
from surfkit.raster.cuda.rasterizer import TileRasterizer
from surfkit.raster.cuda.rasterizer import source as raster_source
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.raster.nvrtc.nvrtc import nvrtc, resources
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
    doubles: int = 2
    """Fused multiply-adds in double precision, a clock and multiprocessor."""
    registers: int = 65536

    def resident(self, registers: int, shared: int, threads: int) -> int:
        """Warps of a kernel that a multiprocessor holds at a time; CUDA's rules of rounding."""
        warps = (threads + 31) // 32
        a_warp = (registers * 32 + 255) // 256 * 256
        by_registers = self.registers // 4 // a_warp * 4 // warps
        by_shared = self.shared // ((shared + 1024 + 127) // 128 * 128)
        return min(self.blocks, self.warps // warps, by_registers, by_shared) * warps


GPUS = (
    Gpu("H200", "sm_90", 132, 1.98e9, 4.8e12, 64, 32, 228 << 10, 64),
    Gpu("RTX 4090", "sm_89", 128, 2.52e9, 1.008e12, 48, 24, 100 << 10),
)


@dataclass(frozen=True)
class Case:
    """A kernel at work: `run` launches it on a few values, `values` of them; `total` is the full size."""

    kernel: str
    source: CudaSource
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
    GpuGrid(lattice, on.device, on).fuse(FusionImage(depth, shade, camera), carve=False)


def _approach(on: Emulated) -> None:
    none, found = torch.empty(0, dtype=torch.int32), torch.empty(128, dtype=torch.int32)
    on.launch("approach", 1, 256, torch.rand(128, 45), torch.rand(64, 45), 45, 64, none, 1.0, 0.0, found)


IMAGE = 3 * 1600 * 1200
WALL = 90_000 * 512  # voxels of the blocks that a view of 1600 x 1200 pixels of the size of a voxel shows
PAIRS = 400_000 * 8_192  # vectors of 45 numbers, and codes
SURFELS = 1_000_000 * 58  # degree 3
CASES = (
    Case("adam", adam.ADAM_SOURCE, 256, _adam, 64 * 1024, SURFELS, 28, 30),
    Case("ssim_forward", ssim.SSIM_SOURCE, 128, _forward, 128 * 128, IMAGE, 20, 155),
    Case("ssim_backward", ssim.SSIM_SOURCE, 128, _backward, 128 * 128, IMAGE, 24, 95),
    Case("fuse", grid.FUSION_SOURCE, grid.THREADS_PER_BLOCK, _fuse, 64 * 512, WALL, 14, 120),
    Case("approach", codes.CODES_SOURCE, 256, _approach, 128 * 64, PAIRS, 0, 2 * 48),
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


PIECE, TILES = (64, 64), 7500
"""Pixels that are emulated, and tiles of 16 x 16 of 1600 x 1200."""
LISTED = 73
"""Bytes of main memory to list a splat that is seen by its depth."""
SLOW = {"div": 10, "rcp": 6, "sqrt": 10}
"""Multiply-adds that one of these takes."""


class Noted:
    """Kernels of the rasterizer, emulated; notes what their launches did, by kernel."""

    def __init__(self, source: CudaSource, launches: dict[str, Launch]) -> None:
        self.source, self.launches, self.on = source, launches, Emulated(source)

    def launch(self, name: str, grid: int, block: int, *arguments: object) -> None:
        self.on.launch(name, grid, block, *arguments)
        work, tensors = self.on.work, [each for each in arguments if isinstance(each, torch.Tensor)]
        asked = sum(work.global_bytes) + sum(work.shared_bytes) + 128 * work.collectives
        memory = sum(each.nbytes for each in tensors)
        self.launches[name] = Launch(self.source, name, block, grid, asked, memory, work.collectives, tensors)


@dataclass(frozen=True)
class Launch:
    """What a launch did; `memory` is each of its tensors once."""

    source: CudaSource
    kernel: str
    threads: int
    blocks: int
    asked: int
    memory: int
    collectives: int
    tensors: list[torch.Tensor]

    def arithmetic(self) -> tuple[float, float]:
        """Multiply-adds of all lanes, in float and in double: of a thread each, or of a warp and splat."""
        ptx = nvrtc().compile(self.source, "compute_89")[0].decode(errors="replace")
        body = ptx.partition(f".entry {self.kernel}(")[2].partition(".entry ")[0]
        if self.kernel in EVALUATIONS:
            return 32 * EVALUATIONS[self.kernel](self) * instructions(blending(body), "f32"), 0
        floats, doubles = (instructions(body, kind) for kind in ("f32", "f64"))
        threads = self.blocks * self.threads
        return threads * floats, threads * doubles


EVALUATIONS: dict[str, Callable[[Launch], float]] = {
    "forward": lambda launch: launch.collectives,  # a vote after each splat
    "backward": lambda launch: sum((word & 0xFFFFFFFF).bit_count() for word in launch.tensors[-3].tolist()),
    "contribution": lambda launch: launch.collectives / 6,  # five shuffles and a vote
}
"""How often a warp looks at a splat."""


def blending(ptx: str) -> str:
    """The innermost loop with an exponential: what a warp does with a splat."""
    lines = ptx.splitlines()
    labels = {line.rstrip(":"): at for at, line in enumerate(lines) if line.startswith("$") and line.endswith(":")}
    jumps = ((at, re.search(r"bra\S*\s+(\$\w+);", line)) for at, line in enumerate(lines))
    loops = (lines[labels[to[1]] : at] for at, to in jumps if to and labels.get(to[1], at) < at)
    return "\n".join(min((loop for loop in loops if any("ex2." in line for line in loop)), key=len))


def instructions(ptx: str, kind: str) -> int:
    """Arithmetic of a type in PTX, that which takes longer as often as it does; signs come with operands."""
    found = re.findall(rf"^\s+(add|sub|mul|fma|mad|min|max|div|rcp|sqrt|ex2|lg2|setp|selp)\S*\.{kind}\s", ptx, re.M)
    return sum(SLOW.get(name, 1) for name in found)


def sorted_bytes(key: int) -> int:
    """Of main memory, to sort a key of so many bytes with a place of 8: a count, a pass for each that moves both."""
    return key + key * 2 * (key + 8)


def drawn(count: int) -> tuple[dict[str, Launch], dict[str, float]]:
    """The launches of a step on a piece of a view of so many surfels, and how many points and pairs it has."""
    share = PIECE[0] * PIECE[1] / 256 / TILES
    splats, camera = city("surfel", round(count * share), *PIECE)
    wider = 1600 / PIECE[0] * (200_000 / count) ** 0.5  # as large in pixels as in the whole view
    tensors = splats.tensors()
    rest = torch.zeros(len(splats), 15, 3)
    splats = splats.with_named({**tensors, "scales": splats.scales * wider, "sh_rest": rest})
    launches: dict[str, Launch] = {}

    class Emulation(TileRasterizer):
        def where(self) -> torch.device:
            return torch.device("cpu")

        def program(self, name: str, **defines: int) -> Noted:
            return Noted(raster_source(name, **defines), launches)

    on = Emulation()
    render = on.render(splats, camera, 0.2)
    cotangents = Maps(**{name: torch.randn_like(value) for name, value in render.maps.present().items()})
    render.backward(cotangents, Maps(color=cotangents.color))
    step = dict(launches)
    on.contribution(splats, camera, 0.2, 0.5, 0.5)
    lists = render._pass
    facts = {"seen": len(lists.index) / share, "pairs": lists.slots / share}
    return step | {name: launches[name] for name in ("contribution", "total")}, facts


def rasterizer(count: int, gpu: Gpu) -> dict[str, object]:
    """Milliseconds of the kernels of a step at 1600 x 1200, at least."""
    launches, facts = drawn(count)
    scale, clocks = TILES * 256 / (PIECE[0] * PIECE[1]), gpu.multiprocessors * gpu.hertz
    times: dict[str, float] = {}
    limits: dict[str, str] = {}
    for name, each in launches.items():
        floats, doubles = each.arithmetic()
        parts = {
            "main memory": each.memory * scale / gpu.memory,
            "first cache and shared": each.asked * scale / (128 * clocks),
            "arithmetic": floats * scale / (128 * clocks),
            "double precision": doubles * scale / (gpu.doubles * clocks),
        }
        limits[name] = max(parts, key=parts.__getitem__)
        times[name] = 1e3 * parts[limits[name]]
    sorts = facts["pairs"] * sorted_bytes(2) + facts["seen"] * (LISTED + sorted_bytes(4))
    times["sort"], limits["sort"] = 1e3 * sorts / gpu.memory, "main memory"
    forward = sum(times[name] for name in ("measure", "record", "sort", "list", "forward"))
    return {
        "seen": round(facts["seen"]),
        "pairs": round(facts["pairs"]),
        "ms": {name: round(value, 3) for name, value in times.items()},
        "limits": limits,
        "all maps, ms": round(forward, 2),
        "backward, ms": round(times["backward"] + times["gather"], 2),
        "contribution, ms": round(forward - times["forward"] + times["contribution"] + times["total"], 2),
        "pictures a second, at most": round(1e3 / forward, 1),
    }


def main() -> None:
    figures = {}
    for case in CASES:
        for gpu in GPUS:
            found = figures[f"{case.kernel} on {gpu.name}"] = expected(case, gpu)
            print(
                f"{case.kernel:<14} {gpu.name:<9} at least {found['ms']:7.3f} ms ({found['limit']}), "
                f"{found['warps']} warps, {found['registers']} registers, {found['shared']} B shared"
            )
    for count in (1_000_000, 5_000_000, 10_000_000):
        for gpu in GPUS:
            found = figures[f"rasterizer, {count:,} surfels on {gpu.name}"] = rasterizer(count, gpu)
            print(f"{count:,} surfels, {gpu.name}: {found}", flush=True)
    print(save("gpu_model", figures))


if __name__ == "__main__":
    main()
