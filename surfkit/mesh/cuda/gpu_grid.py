"""The grid of signed distances in the memory of a GPU: fused there by fuse.cu, downloaded once for its surface."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.mesh.lattice import (
    BLOCK_BYTES,
    BLOCK_INDEX_BITS,
    BLOCK_REACH_VOXELS,
    BLOCK_SIDE_VOXELS,
    MAX_BLOCKS_FROM_ORIGIN,
    Corner,
    FusionImage,
    Lattice,
    SurfacePatch,
    TsdfGrid,
)
from surfkit.mesh.native_grid import grid
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.modules import Kernels, kernels
from surfkit.scene.camera import Camera

THREADS_PER_BLOCK = 128
"""Of a block."""
CHUNK_BLOCKS = 1 << 14
"""Blocks whose voxels lie in one allocation, 59 MB: nothing is moved when a grid grows."""
GRID_MEMORY_SHARE = 0.5
"""Of the free memory of the GPU that a grid may take; views are drawn in the rest."""
Voxels = tuple[Tensor, Tensor, Tensor]
"""Distances (B, 512) int16, weights (B, 512) uint16 as int16, and colours (B, 3, 512) uint8, of blocks."""


class GridView(ctypes.Structure):
    """`GridView` of fuse.cu."""

    _fields_ = (
        ("turn", ctypes.c_double * 9),
        ("shift", ctypes.c_double * 3),
        ("eye", ctypes.c_double * 3),
        ("side", ctypes.c_double),
        ("per_block", ctypes.c_double),
        ("reach", ctypes.c_double),
        ("low", ctypes.c_int * 3),
        ("high", ctypes.c_int * 3),
        ("size", ctypes.c_int * 2),
        ("lens", ctypes.c_float * 4),
        ("band", ctypes.c_float * 3),
    )


FUSION_SOURCE = CudaSource(Path(__file__).with_name("fuse.cu"), structures={"View": GridView}, is_exact=True)


class GpuGrid(TsdfGrid):
    """Holds the same bits as the grid of the CPU.

    The voxels of the block at place i of `keys` are those of row i of all chunks together. The keys are also kept
    sorted, with their places in `order`: a view finds its blocks by a search.
    """

    def __init__(self, lattice: Lattice, device: torch.device, on: Kernels | None = None) -> None:
        self.lattice, self.device, self.on = lattice, device, on or kernels(FUSION_SOURCE, device)
        self.keys = torch.empty(0, dtype=torch.int64, device=device)
        self.sorted, self.order = self.keys, self.keys
        self.chunks: list[Voxels] = []

    @property
    def blocks(self) -> int:
        return len(self.keys)

    @property
    def bytes(self) -> int:
        return len(self.chunks) * CHUNK_BLOCKS * BLOCK_BYTES

    def fuse(self, picture: FusionImage, carve: bool) -> bool:
        view = view_of(self.lattice, picture.camera)
        depth = self._uploaded(np.ascontiguousarray(picture.depth, np.float32))
        slant = self._uploaded(np.ascontiguousarray(picture.slants, np.float32))
        shade = self._uploaded(np.ascontiguousarray(picture.shade, np.uint32).view(np.int32))
        offsets = self._uploaded(self.lattice.offsets(picture.camera))
        seen = self._seen_by(view, depth, shade)
        place, is_here = self._found(seen)
        fresh = seen[~is_here]
        before, after = self.blocks, self.blocks + len(fresh)
        if not self._has_room(after):
            return False
        rows = self.order[place[is_here]].sort().values if not carve else torch.arange(before, device=self.device)
        rows = torch.cat([rows, torch.arange(before, after, device=self.device)])
        self.keys = torch.cat([self.keys, fresh])
        self.sorted, self.order = self.keys.sort()
        maps = offsets, depth, slant, shade
        for begin, some, chunk in self._by_chunk(rows, carve):
            self.on.launch("fuse", len(some), THREADS_PER_BLOCK, view, self.keys, some, begin, *maps, *chunk)
        return True

    def surface(
        self, least_weight: int, end: Corner = (MAX_BLOCKS_FROM_ORIGIN,) * 3, with_edges: bool = False
    ) -> SurfacePatch:
        host = grid(self.lattice)
        for at, chunk in enumerate(self.chunks):
            keys = self.keys[at * CHUNK_BLOCKS : (at + 1) * CHUNK_BLOCKS].cpu().numpy()
            distance, weight, color = (voxels[: len(keys)].cpu().numpy() for voxels in chunk)
            host.put(keys, distance, weight.view(np.uint16), color)
        return host.surface(least_weight, end, with_edges)

    def _seen_by(self, view: GridView, depth: Tensor, shade: Tensor) -> Tensor:
        """Sorted keys of the blocks within reach of what the pixels show."""
        found = torch.empty(depth.numel(), dtype=torch.int64, device=self.device)
        self.on.launch("reach", -(-depth.numel() // 256), 256, view, depth, shade, found)
        found = found.unique()
        found = found[found >= 0]
        steps = torch.arange(8, device=self.device)
        further = (steps & 1) + ((steps >> 1 & 1) << BLOCK_INDEX_BITS) + (steps >> 2 << 2 * BLOCK_INDEX_BITS)
        wanted = (found[:, None] & steps) == steps
        return torch.where(wanted, (found[:, None] >> 3) + further, found[:, None] >> 3).unique()

    def _found(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Where sorted keys are, or would be, among those of the blocks, and whether they are there."""
        if not self.blocks:
            return torch.zeros_like(seen), torch.zeros_like(seen, dtype=torch.bool)
        place = torch.searchsorted(self.sorted, seen).clamp(max=self.blocks - 1)
        return place, self.sorted[place] == seen

    def _has_room(self, blocks: int) -> bool:
        """Whether there may be so many blocks, and the GPU has memory for them."""
        if blocks > self.lattice.most_blocks:
            return False
        try:
            while len(self.chunks) * CHUNK_BLOCKS < blocks:
                size = CHUNK_BLOCKS, BLOCK_SIDE_VOXELS**3
                distance, weight = (torch.zeros(size, dtype=torch.int16, device=self.device) for _ in range(2))
                color = torch.zeros(size[0], 3, size[1], dtype=torch.uint8, device=self.device)
                self.chunks.append((distance, weight, color))
        except torch.cuda.OutOfMemoryError:
            if not self.chunks:
                raise no_room(self.device, CHUNK_BLOCKS * BLOCK_BYTES) from None
            return False
        return True

    def _by_chunk(self, rows: Tensor, are_all: bool) -> Iterator[tuple[int, Tensor, Voxels]]:
        """First row, those of the sorted `rows`, and voxels, of each chunk."""
        starts = list(range(0, len(self.chunks) * CHUNK_BLOCKS + 1, CHUNK_BLOCKS))
        if not are_all:
            starts = torch.searchsorted(rows, torch.tensor(starts).to(rows)).tolist()
        for at, chunk in enumerate(self.chunks):
            yield at * CHUNK_BLOCKS, rows[starts[at] : starts[at + 1]], chunk

    def _uploaded(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).to(self.device)


def view_of(lattice: Lattice, camera: Camera) -> GridView:
    """A camera above a lattice, computed as on the CPU."""
    pose = camera.world_to_camera.cpu()
    turn, shift = pose[:3, :3].flatten().tolist(), pose[:3, 3].tolist()
    side = lattice.voxel * BLOCK_SIDE_VOXELS
    per_block, eye = 1 / side, [0.0] * 3
    for axis in range(3):
        for row in range(3):
            eye[axis] -= turn[3 * row + axis] * shift[row] * per_block
    last = (edge - 1 for edge in lattice.high)
    reach = BLOCK_REACH_VOXELS * lattice.voxel * per_block
    size, lens = (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
    groups = turn, shift, eye, side, per_block, reach, lattice.low, last, size, lens, lattice.lengths
    fields: zip[tuple[tuple[str, Any], Any]] = zip(GridView._fields_, groups, strict=True)
    return GridView(*(value if isinstance(value, float) else kind(*value) for (_, kind), value in fields))


def most_blocks(device: torch.device) -> int:
    """Blocks that a GPU has memory for now.

    Raises:
        BadInput: Not even for one chunk.
    """
    free = torch.cuda.mem_get_info(device)[0]
    free += torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)  # torch's own, and unused
    blocks = int(GRID_MEMORY_SHARE * free / BLOCK_BYTES)
    if blocks < CHUNK_BLOCKS:
        raise no_room(device, CHUNK_BLOCKS * BLOCK_BYTES / GRID_MEMORY_SHARE)
    return blocks


def no_room(device: torch.device, needed: float) -> BadInput:
    """What to say where the GPU has not even memory for one tile."""
    return BadInput(
        f"{device}: less than {needed / 1e6:.0f} MB of its memory are free, too little to fuse depth maps in; end "
        "other programs that use this GPU, or mesh with --device cpu"
    )
