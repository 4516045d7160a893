"""The compiled grid gives the bits of the reference, and both the surfaces that cameras see."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs, needs_native

from surfkit.mesh.lattice import FusionImage, Lattice
from surfkit.mesh.native_grid import NativeGrid
from surfkit.mesh.reference_grid import ReferenceGrid
from surfkit.raster.native import module

from .shapes import around, look_at, seen, slope, sphere, torus

trimesh = needs("trimesh")
VOXEL = 0.03


def pictures(cameras, shape, seed=0):
    draw = np.random.default_rng(seed)
    for camera in cameras:
        depth = seen(camera, shape)[0].astype(np.float32)
        color, weight = draw.integers(0, 2**24, depth.shape), draw.integers(0, 33, depth.shape)
        slant = draw.uniform(0.3, 1.3, depth.shape).astype(np.float32)
        yield FusionImage(depth, (color | weight << 24).astype(np.uint32), camera, slant)


def fused(kind, views, carve=False, **lattice):
    grid = kind(Lattice(VOXEL, 4 * VOXEL, **lattice))
    for view in views:
        assert grid.fuse(view, carve)
    return grid


def contents(grid):
    keys, raw = grid.native.contents()
    halves = raw[:, :2048].copy()
    return (
        keys,
        halves[:, :1024].view(np.int16),
        halves[:, 1024:].view(np.uint16),
        raw[:, 2048:3584].reshape(-1, 3, 512),
    )


@needs_native
@pytest.mark.parametrize("carve", [False, True])
@pytest.mark.parametrize("shape", [sphere, slope])
def test_compiled_and_reference_agree_to_the_last_bit(shape, carve):
    # The last camera is among the surfaces, so that voxels lie behind it and beside its picture.
    cameras = [*around(6, above=shape is slope), look_at((0, 0.1, 0.55), (0.5, 0, 0.2))]
    views = list(pictures(cameras, shape))
    views[0].depth[10:20, 30:40] = 0
    for kernels in module().kernels():
        module().use_kernels(kernels)
        try:
            one, other = fused(NativeGrid, views, carve), fused(ReferenceGrid, views, carve)
        finally:
            module().use_kernels(module().kernels()[0])
        keys, distance, weight, color = contents(one)
        assert len(keys) > 20 and np.array_equal(keys, other.keys), kernels
        assert np.array_equal(weight, other.weight) and weight.max() > 64
        assert np.array_equal(distance, other.distance) and np.array_equal(color, other.color)
        surfaces = [vars(grid.surface(8, (0, 5, 5), True)).values() for grid in (one, other)]
        for a, b in zip(*surfaces, strict=True):
            assert a.dtype == b.dtype and len(a) > 50 and np.array_equal(a, b)


@needs_native
def test_threads_do_not_change_a_bit():
    views, before = list(pictures(around(5), sphere)), torch.get_num_threads()
    found = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        grid = fused(NativeGrid, views, True)
        found.append((*contents(grid), *vars(grid.surface(8)).values()))
    torch.set_num_threads(before)
    assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True))


KINDS = [pytest.param(NativeGrid, marks=needs_native), ReferenceGrid]


def plain(cameras, shape, color=0xC08040):
    for camera in cameras:
        depth = seen(camera, shape)[0].astype(np.float32)
        yield FusionImage(depth, np.full(depth.shape, 32 << 24 | color, np.uint32), camera)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("shape", "euler"), [(sphere, 2), (torus, 0)])
def test_solids(kind, shape, euler):
    """Within half a voxel everywhere, closed, turned outward, of the right genus, and of the colour of the pictures."""
    piece = fused(kind, plain(around(20), shape)).surface(32)
    mesh = trimesh.Trimesh(piece.vertices, piece.faces, process=False)
    mesh.remove_unreferenced_vertices()
    assert np.abs(shape(mesh.vertices)).max() < 0.5 * VOXEL
    assert np.abs(shape(mesh.vertices)).mean() < 0.1 * VOXEL
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == euler
    volume = {sphere: 4 / 3 * np.pi * 0.5**3, torus: 2 * np.pi**2 * 0.5 * 0.2**2}[shape]
    assert mesh.volume == pytest.approx(volume, rel=0.02)
    assert (piece.colors == [0x40, 0x80, 0xC0]).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_plane_has_no_holes_inside_and_faces_the_cameras(kind):
    piece = fused(kind, plain(around(5, above=True), slope)).surface(64)
    mesh = trimesh.Trimesh(piece.vertices, piece.faces, process=False)
    near = np.linalg.norm(mesh.vertices, axis=1) < 0.5
    assert np.abs(slope(mesh.vertices)).max() < 0.5 * VOXEL
    assert near.sum() > 500 and np.abs(slope(mesh.vertices[near])).max() < 0.2 * VOXEL
    assert (mesh.face_normals[:, 2] > 0).all()
    rims = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    middles = mesh.vertices[mesh.edges_sorted[rims]].mean(1)
    assert (np.linalg.norm(middles, axis=1) > 0.4).all(), "the rim alone has open edges"


@pytest.mark.parametrize("kind", KINDS)
def test_carving_takes_away_what_later_views_see_through(kind):
    camera = look_at((0, 0, 2.0))
    depth = np.full((72, 96), 2.0, np.float32)
    floater = depth.copy()
    floater[30:45, 40:60] = 1.0
    shade = np.full((72, 96), 32 << 24, np.uint32)
    for carve, gone in ((False, False), (True, True)):
        grid = kind(Lattice(VOXEL, 4 * VOXEL))
        assert grid.fuse(FusionImage(floater, shade, camera), carve)
        for _ in range(6):
            assert grid.fuse(FusionImage(depth, shade, camera), carve)
        heights = grid.surface(32).vertices[:, 2]
        assert (np.abs(heights) < 0.1).any() and (heights > 0.8).any() != gone


@pytest.mark.parametrize("kind", KINDS)
def test_no_block_beyond_the_limit_is_made_and_nothing_else_changes(kind):
    view = next(plain(around(1), sphere))
    grid = fused(kind, [view])
    small = kind(replace(grid.lattice, most_blocks=grid.blocks - 1))
    assert not small.fuse(view, False) and small.blocks == 0
    assert kind(replace(grid.lattice, most_blocks=grid.blocks)).fuse(view, False)
