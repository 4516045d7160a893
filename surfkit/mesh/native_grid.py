"""The compiled grid of signed distances behind the contract of `Grid`."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.core.events import Warned, emit
from surfkit.mesh.cubes import CUBE_EDGES, triangles
from surfkit.mesh.lattice import (
    BLOCK_REACH_VOXELS,
    MAX_BLOCKS_FROM_ORIGIN,
    Corner,
    FusionImage,
    HostGrid,
    Lattice,
    SurfacePatch,
)
from surfkit.mesh.reference_grid import ReferenceGrid
from surfkit.raster.native import kernels, lacking, module


class NativeGrid(HostGrid):
    """Runs on `torch.get_num_threads()` threads; their number does not change a bit."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        corners = list(lattice.low), list(lattice.high)
        self.native = kernels().Grid(lattice.voxel, BLOCK_REACH_VOXELS * lattice.voxel, *corners, lattice.most_blocks)

    @property
    def blocks(self) -> int:
        return self.native.blocks

    @property
    def bytes(self) -> int:
        return self.native.bytes

    def fuse(self, picture: FusionImage, carve: bool) -> bool:
        camera = picture.camera
        return self.native.fuse(
            np.ascontiguousarray(picture.depth, np.float32),
            np.ascontiguousarray(picture.slants, np.float32),
            np.ascontiguousarray(picture.shade, np.uint32),
            camera.world_to_camera.flatten().tolist(),
            [camera.fx, camera.fy, camera.cx, camera.cy],
            self.lattice.offsets(camera),
            self.lattice.lengths,
            carve,
            kernels().kernels_in_use(),
            torch.get_num_threads(),
        )

    def put(self, keys: np.ndarray, distance: np.ndarray, weight: np.ndarray, color: np.ndarray) -> None:
        self.native.put(keys, distance, weight, color)

    def surface(
        self, least_weight: int, end: Corner = (MAX_BLOCKS_FROM_ORIGIN,) * 3, with_edges: bool = False
    ) -> SurfacePatch:
        table = triangles(), CUBE_EDGES
        return SurfacePatch(*self.native.surface(*table, least_weight, list(end), with_edges, torch.get_num_threads()))


def grid(lattice: Lattice) -> HostGrid:
    """An empty grid, compiled if surfkit is."""
    if module() is not None:
        return NativeGrid(lattice)
    emit(Warned(f"{lacking()}: meshes are made in numpy instead, about a hundred times slower"))
    return ReferenceGrid(lattice)
