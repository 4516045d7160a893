"""Fusion of depth maps by the kernels: the bits of the grid of the CPU, and the distances of float64 geometry."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mesh.shapes import around, look_at, seen, slope, sphere

from surfkit.core.check import BadInput
from surfkit.mesh.cuda import gpu_grid as module
from surfkit.mesh.cuda.gpu_grid import FUSION_SOURCE, GpuGrid, most_blocks, view_of
from surfkit.mesh.lattice import BLOCK_BYTES, BLOCK_SIDE_VOXELS, FADE_START_VOXELS, FULL_WEIGHT, FusionImage, Lattice
from surfkit.mesh.reference_grid import ReferenceGrid, unpack
from surfkit.raster.nvrtc.emulated import Emulated, KernelError
from surfkit.raster.nvrtc.nvrtc import nvrtc
from surfkit.scene.camera import Camera

from .sources import changed

VOXEL = 0.03
LATTICE = Lattice(VOXEL, 4 * VOXEL)
INSIDE = look_at((0, 0.1, 0.55), (0.5, 0, 0.2))
"""A camera among the surfaces: voxels lie behind it and beside its picture."""


def pictures(cameras, shape, seed=0):
    draw = np.random.default_rng(seed)
    for camera in cameras:
        depth = seen(camera, shape)[0].astype(np.float32)
        color, weight = draw.integers(0, 2**24, depth.shape), draw.integers(0, 33, depth.shape)
        slant = draw.uniform(0.3, 1.3, depth.shape).astype(np.float32)
        yield FusionImage(depth, (color | weight << 24).astype(np.uint32), camera, slant)


def contents(grid):
    """Keys, distances, weights and colours, by key."""
    if isinstance(grid, ReferenceGrid):
        return grid.keys, grid.distance, grid.weight, grid.color
    if not grid.chunks:
        return contents(ReferenceGrid(LATTICE))
    voxels = [torch.cat(parts)[: grid.blocks].cpu().numpy() for parts in zip(*grid.chunks, strict=True)]
    distance, weight, color = (values[grid.order.cpu().numpy()] for values in voxels)
    return grid.sorted.cpu().numpy(), distance, weight.view(np.uint16), color


def assert_same(found, true):
    assert all(np.array_equal(a, b) for a, b in zip(contents(found), contents(true), strict=True))


def fused(on, views, carve=False, lattice=LATTICE):
    """Both grids."""
    both = GpuGrid(lattice, on.device, on), ReferenceGrid(lattice)
    for view in views:
        assert all([grid.fuse(view, carve) for grid in both])
    return both


@pytest.mark.parametrize("carve", [False, True])
@pytest.mark.parametrize("shape", [sphere, slope])
def test_bits_of_the_cpu(load, shape, carve):
    views = list(pictures([*around(3, above=shape is slope), INSIDE], shape))
    views[0].depth[10:20, 30:40] = 0
    found, true = fused(load(FUSION_SOURCE), views, carve)
    assert_same(found, true)
    assert found.blocks > 20 and contents(found)[2].max() > 32
    surfaces = [vars(grid.surface(8, (0, 5, 5), True)).values() for grid in (found, true)]
    for a, b in zip(*surfaces, strict=True):
        assert a.dtype == b.dtype and len(a) > 50 and np.array_equal(a, b)


def test_the_surface_without_a_compiler(load, monkeypatch):
    found, true = fused(load(FUSION_SOURCE), pictures(around(2), sphere))
    monkeypatch.setattr(module, "grid", ReferenceGrid)
    for a, b in zip(*(vars(grid.surface(8)).values() for grid in (found, true)), strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize("carve", [False, True])
def test_chunks_change_nothing(load, carve, monkeypatch):
    monkeypatch.setattr(module, "CHUNK_BLOCKS", 7)
    found, true = fused(load(FUSION_SOURCE), pictures([*around(3), INSIDE], sphere), carve)
    assert len(found.chunks) == -(-found.blocks // 7) > 5 and found.bytes == len(found.chunks) * 7 * BLOCK_BYTES
    assert_same(found, true)
    assert np.array_equal(found.surface(8).vertices, true.surface(8).vertices)


def flat(depth, size=(60, 80), weight=FULL_WEIGHT, focal=100.0):
    """A picture of one depth, by a camera at the origin."""
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera(pose, focal, focal, size[1] / 2, size[0] / 2, size[1], size[0])
    return FusionImage(np.full(size, depth, np.float32), np.full(size, weight << 24 | 0x336699, np.uint32), camera)


def test_distances_and_weights_of_a_wall(load):
    """In float64: the distance of each voxel to a wall, and a weight that falls behind it."""
    on, depth = load(FUSION_SOURCE), 2.013
    grid = GpuGrid(LATTICE, on.device, on)
    grid.fuse(flat(depth), carve=False)
    keys, distance, weight, color = contents(grid)
    z, y, x = np.indices((BLOCK_SIDE_VOXELS,) * 3).reshape(3, -1)
    at = (unpack(keys)[:, :, None] * BLOCK_SIDE_VOXELS + np.stack([x, y, z])) * VOXEL
    u, v = (100 * at[:, axis] / at[:, 2] + middle for axis, middle in ((0, 40), (1, 30)))
    inside = (u > 0.01) & (u < 79.99) & (v > 0.01) & (v < 59.99)
    sdf = depth - at[:, 2]
    cut = LATTICE.truncation
    true = np.minimum(sdf / cut, 1)
    fall = np.where(sdf < -FADE_START_VOXELS * VOXEL, (cut + sdf) / (cut - FADE_START_VOXELS * VOXEL), 1) * FULL_WEIGHT
    clear = inside & (abs(fall % 1 - 0.5) > 1e-3) & (sdf > -cut + 1e-3)
    assert clear.sum() > 5000 and np.array_equal(weight[clear], np.floor(fall + 0.5)[clear])
    seen = clear & (fall > 1)
    assert np.abs(distance / 32767 - true)[seen].max() < 1e-5 + 1 / 32767
    outside = (u < -0.01) | (u > 80.01) | (v < -0.01) | (v > 60.01) | (sdf < -cut - 1e-3)
    assert outside.sum() > 1000 and not weight[outside].any()
    assert (color[:, 0][seen] == 0x99).all() and (color[:, 1][seen] == 0x66).all()


STRANGE = {
    "nothing seen": lambda: [flat(0)],
    "nothing seen, after something": lambda: [flat(1), flat(0)],
    "depth behind the camera": lambda: [flat(-1)],
    "not a number, as if nothing were seen": lambda: [flat(1), flat(np.nan)],
    "no weight": lambda: [flat(1, weight=0)],
    "one pixel": lambda: [flat(1, (1, 1), focal=20)],
    "a column of pixels": lambda: [flat(1, (9, 1), focal=20)],
    "more weight than full": lambda: [flat(1, weight=255)] * 3,
    "at the camera": lambda: [flat(0.01, (20, 20), focal=20)],
}


@pytest.mark.parametrize("carve", [False, True])
@pytest.mark.parametrize("name", STRANGE)
def test_strange_pictures(load, name, carve):
    with np.errstate(invalid="ignore"):
        found, true = fused(load(FUSION_SOURCE), STRANGE[name](), carve)
    assert_same(found, true)
    assert (found.blocks > 0) == (name not in ("nothing seen", "depth behind the camera", "no weight"))


def test_borders_of_a_tile(load):
    found, true = fused(
        load(FUSION_SOURCE), pictures(around(3), sphere), lattice=Lattice(VOXEL, 0.12, (-1, -9, 0), (2, 0, 1))
    )
    assert 0 < found.blocks < 20 and {*unpack(found.sorted.cpu().numpy())[:, 2]} == {0}
    assert_same(found, true)


def test_no_block_beyond_the_limit(load):
    on, (first, second) = load(FUSION_SOURCE), pictures(around(2), sphere)
    one = GpuGrid(LATTICE, on.device, on)
    assert one.fuse(first, False)
    before = contents(one)
    small = GpuGrid(Lattice(VOXEL, 4 * VOXEL, most_blocks=one.blocks), on.device, on)
    assert small.fuse(first, False) and not small.fuse(second, False)
    assert all(np.array_equal(a, b) for a, b in zip(contents(small), before, strict=True))


def test_a_gpu_without_memory(monkeypatch):
    """What does not fit is left to smaller tiles; where nothing fits, a line says what to do."""
    on, (first, second), zeros = Emulated(FUSION_SOURCE), pictures(around(2), sphere), torch.zeros
    made = []

    def full(*size, **how):
        if len(made) == 3 * allowed:
            raise torch.cuda.OutOfMemoryError
        made.append(size)
        return zeros(*size, **how)

    monkeypatch.setattr(module.torch, "zeros", full)
    allowed, grid = 1, GpuGrid(LATTICE, on.device, on)
    ReferenceGrid(LATTICE).fuse(first, False)
    blocks = fused(on, [first])[1].blocks
    made.clear()
    monkeypatch.setattr(module, "CHUNK_BLOCKS", blocks)
    assert grid.fuse(first, False) and not grid.fuse(second, False) and grid.blocks == blocks
    allowed = 0
    made.clear()
    with pytest.raises(BadInput, match="cpu: less than .* MB .*fuse"):
        GpuGrid(LATTICE, on.device, on).fuse(first, False)


def test_blocks_for_the_free_memory(monkeypatch):
    free = 10_000_000_000
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device=None: (free, 2 * free))
    device = torch.device("cuda", 0)
    assert most_blocks(device) == free // 2 // BLOCK_BYTES
    free = 10_000_000
    with pytest.raises(BadInput, match="cuda:0: less than 117 MB .*--device cpu"):
        most_blocks(device)


MISTAKES = {
    "a pixel too many": ("i >= depth.size", "i > depth.size", 0, "index .* of depth, which has"),
    "pixels without weight": ("&& shade[i] >> 24", "", 0, "wrong"),
    "no second block": ("(first[axis] < last) << axis", "0", 0, "wrong"),
    "blocks beyond the tile": ("view.high[axis] ? to : view.high[axis]", "view.high[axis] ? to : to", 0, "wrong"),
    "no barrier": ("__syncthreads();", "", 0, "of the block has written|with no barrier"),
    "one voxel too many": ("voxel < kVoxels", "voxel <= kVoxels", 0, "wrong|index .* which has|another block"),
    "outside of the picture": ("if (!p.inside) continue;", "", 0, "wrong"),
    "no neighbours": ("if (may_be_near(view.band, d, p.z, steep))", "if (false)", 0, "wrong"),
    "blocks of another chunk": ("row - begin", "row", 0, "index .* which has"),
    "colours of another block": ("(3 * block + channel)", "(block + channel)", 0, "another block|wrong"),
}


def volume(source):
    """Raise KernelError if the kernels do, or if they give something else than the CPU."""
    on = Emulated(source)
    views = [*pictures([*around(2), INSIDE], sphere), flat(1, (9, 13), focal=20), flat(0.5, weight=0)]
    found, true = fused(on, views, lattice=Lattice(VOXEL, 0.12, (-4, -9, -9), (2, 9, 9)))
    try:
        assert_same(found, true)
    except AssertionError as error:
        raise KernelError("wrong") from error


@pytest.mark.parametrize("name", [None, *MISTAKES])
def test_mistakes(name, monkeypatch):
    monkeypatch.setattr(module, "CHUNK_BLOCKS", 40)
    if name is None:
        return volume(FUSION_SOURCE)
    old, new, skip, message = MISTAKES[name]
    with pytest.raises(KernelError, match=message):
        volume(changed(FUSION_SOURCE, old, new, skip=skip))


def test_no_product_and_sum_in_one_rounding():
    """On a GPU too, or its bits would not be those of the CPU."""
    try:
        compiler = nvrtc()
    except BadInput as error:
        pytest.skip(str(error))
    exact, joined = (
        compiler.compile(source, "compute_90")[0] for source in (FUSION_SOURCE, replace(FUSION_SOURCE, is_exact=False))
    )
    assert b"fma.rn" in joined and b"fma.rn" not in exact and b"mul.rn" in exact


def test_the_view_of_a_camera():
    """The centre of the camera, in blocks."""
    camera = around(3)[1]
    eye = np.array(view_of(LATTICE, camera).eye) * VOXEL * BLOCK_SIDE_VOXELS
    np.testing.assert_allclose(eye, camera.centre.numpy(), rtol=1e-12)
