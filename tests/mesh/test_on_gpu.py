"""Depth maps fused on a GPU that is simulated: the surface of the CPU, to the same bits, with few waits."""

import shutil

import numpy as np
import pytest
import torch

from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh import fusion, tsdf
from surfkit.mesh.cuda import gpu_grid as gpu_grid
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.stereo import Stereo
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.reference import Reference
from surfkit.testing.simulated_gpu import OnSimulatedGpu, simulated_gpu

from .shapes import around, subject, torus
from .test_tsdf import faces_by_place

pytestmark = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "c++", "clang++")), reason="the emulator needs a C++ compiler"
)
THERE = OnSimulatedGpu(Reference())
VIEWS = 6


@pytest.fixture(autouse=True)
def free_memory(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device=None: (1 << 34, 1 << 34))


def both(mesher, **changes):
    """The meshes of the CPU and of the GPU, and what was waited for there."""
    here = mesher.mesh(subject(around(VIEWS), torus, **changes))
    with simulated_gpu() as gpu:
        there = mesher.mesh(subject(around(VIEWS), torus, rasterizer=THERE, **changes))
    assert len(here.faces) > 500 and here.facts == there.facts
    for name in ("vertices", "faces", "colors"):
        assert np.array_equal(getattr(here, name), getattr(there, name)), name
    return there, gpu.waits


@pytest.mark.parametrize("carve", [True, False])
def test_same_surface_with_few_waits(carve):
    mesh, waits = both(TSDF(voxel=0.5, carve=carve))
    assert mesh.facts["tiles"] == 1
    picks = 2 if carve else 3  # the blocks that pixels show, the new ones among them, and those that are known
    views = {"unique": 2 * VIEWS, "__getitem__": picks * VIEWS} | ({} if carve else {"tolist": VIEWS})
    assert waits == views | {"to cpu": 4}, "voxels are downloaded once"


def test_trust_and_floaters():
    both(TSDF(voxel=0.5, least_views=0.25, trust=GeometricConsistency(neighbours=3), floaters=1.0))


def test_tiles(monkeypatch):
    monkeypatch.setattr(tsdf, "GRID_BUDGET_SHARE", 100 * tsdf.GRID_BYTES / 2**30)
    mesh, waits = both(TSDF(voxel=0.3))
    assert mesh.facts["tiles"] > 2 and waits["to cpu"] == 4 * mesh.facts["tiles"]


def test_tiles_are_as_small_as_the_gpu_is(monkeypatch):
    """It has less memory than the CPU: the mesh is the same, of more tiles."""
    given = subject(around(VIEWS), torus)
    whole = TSDF(voxel=0.3).mesh(given)
    monkeypatch.setattr(gpu_grid, "most_blocks", lambda device: 100)
    made, plain = [], gpu_grid.GpuGrid
    monkeypatch.setattr(fusion, "GpuGrid", lambda *given: made.append(plain(*given)) or made[-1])
    with simulated_gpu():
        tiled = TSDF(voxel=0.3).mesh(subject(around(VIEWS), torus, rasterizer=THERE))
    assert whole.facts["tiles"] == 1 < tiled.facts["tiles"] <= len(made) and max(each.blocks for each in made) <= 100
    assert np.array_equal(faces_by_place(whole), faces_by_place(tiled))


def test_memory_that_runs_out_leads_to_smaller_tiles(monkeypatch):
    """Another program takes the memory in the meantime."""
    whole, zeros = TSDF(voxel=0.3).mesh(subject(around(VIEWS), torus)), torch.zeros
    monkeypatch.setattr(gpu_grid, "CHUNK_BLOCKS", 50)
    held, plain = [], gpu_grid.GpuGrid._has_room

    def limited(grid, blocks):
        def full(*size, **how):
            if len(grid.chunks) == 2:
                raise torch.cuda.OutOfMemoryError
            return zeros(*size, **how)

        with monkeypatch.context() as patch:
            patch.setattr(gpu_grid.torch, "zeros", full)
            held.append(plain(grid, blocks))
            return held[-1]

    monkeypatch.setattr(gpu_grid.GpuGrid, "_has_room", limited)
    with simulated_gpu():
        tiled = TSDF(voxel=0.3).mesh(subject(around(VIEWS), torus, rasterizer=THERE))
    assert not all(held) and tiled.facts["tiles"] > 1
    assert np.array_equal(faces_by_place(whole), faces_by_place(tiled))


def test_depth_priors():
    """The mesher of stereo depth maps fuses them in the same way."""
    given = subject(around(VIEWS), torus)
    depths = [given.draw(view).depth for view in given.views]
    priors = [DepthPrior(torch.where(d > 0, 1 / d, 0.0), (d > 0).float(), 1.0) for d in depths]
    both(Stereo(fusion=TSDF(voxel=0.5)), priors=priors)
