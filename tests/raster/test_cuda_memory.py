"""What the CUDA rasterizer takes of the memory of a GPU: all its tensors, counted on a simulated one."""

import gc
import shutil
from functools import cache

import pytest
import torch

from surfkit.raster.api import Maps, Splats
from surfkit.raster.cuda.rasterizer import TileRasterizer, source
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.scene.camera import Camera
from surfkit.testing.simulated_gpu import GPU, simulated_gpu

pytestmark = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "c++", "clang++")), reason="the emulator needs a C++ compiler"
)
SIDE = 64
TILES = (SIDE // 16) ** 2
SORT = 24
"""Bytes a pair that torch's stable sort takes beside its results: keys (4) and places (8), in and out of each pass."""
GOAL = 250


@cache
def emulated(name, **defines):
    return Emulated(source(name, **defines), device=GPU)


class EmulatedGpu(TileRasterizer):
    def where(self):
        return GPU

    def program(self, name, **defines):
        return emulated(name, **defines)


def splats(kind, count, size, geometry):
    """In front of a camera, each of about `size` pixels; faint, so that none hides another."""
    draw = torch.Generator().manual_seed(1)
    xy = (torch.rand(count, 2, generator=draw) - 0.5) * 0.6
    means = torch.cat([xy, torch.full((count, 1), 2.0)], 1)
    scales = torch.full((count, 2 if kind == "surfel" else 3), size * 2.0 / SIDE)
    given = means, torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), scales, torch.full((count,), 0.02)
    sh = torch.rand(count, 4, 3, generator=draw)
    return Splats(kind, *given, sh[:, :1], sh[:, 1:], geometry=geometry)


def taken(kind, count, size, chosen, geometry="axis"):
    """Pairs of a splat and a tile, and bytes at the peak of a render with its way back, and at that of the lists."""
    camera = Camera(torch.eye(4, dtype=torch.float64), SIDE, SIDE, SIDE / 2, SIDE / 2, SIDE, SIDE)
    with simulated_gpu() as gpu:
        there = splats(kind, count, size, geometry)
        there = there.with_named({name: value.to(GPU) for name, value in there.named().items()})
        given = gpu.held
        render = EmulatedGpu().render(there, camera, 0.01)
        listed = gpu.peak - given
        total = Maps(**{name: torch.ones_like(value) for name, value in render.maps.present().items()})
        render.backward(total, Maps(color=total.color) if chosen else None)
        return render._pass.slots, gpu.peak - given, listed


@pytest.mark.parametrize(("kind", "geometry"), [("surfel", "axis"), ("gaussian", "axis"), ("gaussian", "ray")])
@pytest.mark.parametrize("chosen", [False, True])
def test_bytes_of_a_pair_of_a_splat_and_a_tile(kind, geometry, chosen):
    (few, small, listed), (many, large, relisted) = (taken(kind, 120, size, chosen, geometry) for size in (1, 12))
    assert many > 4 * few
    a_pair, in_lists = (large - small) / (many - few), (relisted - listed) / (many - few)
    assert 60 < a_pair <= GOAL / 2, f"{a_pair:.0f} B"
    assert in_lists + SORT <= GOAL / 2, f"{in_lists:.0f} B"


def test_bytes_of_a_point_that_is_seen():
    """Beside its pairs: its record, its gradients and a few numbers."""
    (few, small, _), (many, large, _) = (taken("surfel", count, 1, True) for count in (100, 300))
    a_pair = 4 * (20 + 4) + 8 + 1 + 1  # sums with chosen losses, entry, whether it was touched, bits of who was blended
    each = (large - small - a_pair * (many - few)) / 200
    gradients, facts = 4 * (3 + 4 + 2 + 1 + 4 * 3 + 2 + 2), 4 * (2 + 1 + 1 + 1 + 1 + 1) + 1
    record = 192  # at another time than the gradients
    assert each == pytest.approx(max(record + facts, gradients + facts), rel=0.15)


@pytest.mark.parametrize("kind", ["surfel", "gaussian"])
def test_a_view_that_is_no_longer_needed_frees_its_memory_at_once(kind):
    """Not when Python next collects cycles of references, which it does by the number of objects, not their bytes."""
    camera = Camera(torch.eye(4, dtype=torch.float64), SIDE, SIDE, SIDE / 2, SIDE / 2, SIDE, SIDE)
    with simulated_gpu() as gpu:
        there = splats(kind, 50, 4.0, "axis")
        there = there.with_named({name: value.to(GPU) for name, value in there.named().items()})
        given = gpu.held
        gc.collect()
        gc.disable()
        try:
            render = EmulatedGpu().render(there, camera, 0.01)
            assert render.maps.color.sum() > 0 and gpu.held > given
            del render
            assert gpu.held == given
        finally:
            gc.enable()
