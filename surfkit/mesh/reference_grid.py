"""The grid of signed distances in numpy: the definition of correct, and what works where there was no compiler.

Every step is rounded to float32 as in surfkit/mesh/cpu, so that both give the same bits.
"""

from __future__ import annotations

import numpy as np

from surfkit.mesh.cubes import CUBE_EDGES, triangles
from surfkit.mesh.lattice import (
    BLOCK_BYTES,
    BLOCK_INDEX_BITS,
    BLOCK_REACH_VOXELS,
    BLOCK_SIDE_VOXELS,
    MAX_BLOCKS_FROM_ORIGIN,
    Corner,
    FusionImage,
    HostGrid,
    Lattice,
    SurfacePatch,
)

BATCH_BLOCKS = 256
"""Blocks that are fused at once."""
F = np.float32


class ReferenceGrid(HostGrid):
    """See `Grid`; a thousand times slower than the compiled one."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.keys = np.empty(0, np.int64)  # sorted
        self.distance = np.empty((0, BLOCK_SIDE_VOXELS**3), np.int16)
        self.weight = np.empty((0, BLOCK_SIDE_VOXELS**3), np.uint16)
        self.color = np.empty((0, 3, BLOCK_SIDE_VOXELS**3), np.uint8)

    @property
    def blocks(self) -> int:
        return len(self.keys)

    @property
    def bytes(self) -> int:
        return self.blocks * BLOCK_BYTES

    def fuse(self, picture: FusionImage, carve: bool) -> bool:
        touched = self._seen_by(picture)
        fresh = np.setdiff1d(touched, self.keys)
        if self.blocks + len(fresh) > self.lattice.most_blocks:
            return False
        self._insert(fresh)
        rows = np.arange(self.blocks) if carve else np.searchsorted(self.keys, touched)
        offsets = self.lattice.offsets(picture.camera)
        for at in range(0, len(rows), BATCH_BLOCKS):
            self._fuse_rows(rows[at : at + BATCH_BLOCKS], picture, offsets)
        return True

    def put(self, keys: np.ndarray, distance: np.ndarray, weight: np.ndarray, color: np.ndarray) -> None:
        self._insert(keys)
        rows = np.searchsorted(self.keys, keys)
        self.distance[rows], self.weight[rows], self.color[rows] = distance, weight, color

    def _insert(self, fresh: np.ndarray) -> None:
        keys = np.concatenate([self.keys, fresh])
        order = np.argsort(keys)
        self.keys = keys[order]
        for name in ("distance", "weight", "color"):
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, np.zeros((len(fresh), *old.shape[1:]), old.dtype)])[order])

    def _seen_by(self, picture: FusionImage) -> np.ndarray:
        """Sorted keys of the blocks within reach of what the pixels show."""
        camera = picture.camera
        rows, columns = np.nonzero((picture.depth > 0) & (picture.shade >> 24 > 0))
        d = picture.depth[rows, columns].astype(np.float64)
        ray = [(columns + 0.5 - F(camera.cx)) / F(camera.fx), (rows + 0.5 - F(camera.cy)) / F(camera.fy)]
        local = np.stack([ray[0] * d, ray[1] * d, d])
        pose = camera.world_to_camera.numpy()
        side = self.lattice.voxel * BLOCK_SIDE_VOXELS
        at = (pose[:3, :3].T @ (local - pose[:3, 3:])).T / side
        reach = BLOCK_REACH_VOXELS / BLOCK_SIDE_VOXELS
        low = np.maximum(np.floor(at - reach).astype(np.int64), self.lattice.low)
        high = np.minimum(np.floor(at + reach).astype(np.int64), np.array(self.lattice.high) - 1)
        corners = np.unique(np.concatenate([low, high], 1)[(low <= high).all(1)], axis=0)
        steps = np.indices((2, 2, 2)).reshape(3, -1).T  # reach is below half a block, so there are two at most
        every = np.minimum(corners[:, None, :3] + steps, corners[:, None, 3:])
        return np.unique(pack(every.reshape(-1, 3)))

    def _fuse_rows(self, rows: np.ndarray, picture: FusionImage, offsets: np.ndarray) -> None:
        camera, (truncation, jump, fade) = picture.camera, map(F, self.lattice.lengths)
        height, width = picture.depth.shape
        pose = camera.world_to_camera.numpy()
        start = unpack(self.keys[rows]) * (self.lattice.voxel * BLOCK_SIDE_VOXELS)
        first = [r[0] * start[:, 0] + r[1] * start[:, 1] + r[2] * start[:, 2] + r[3] for r in pose[:3]]
        x0, y0, z0 = (row.astype(F)[:, None] for row in first)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            z = z0 + offsets[2]
            turn = F(1) / z
            u = (x0 + offsets[0]) * turn * F(camera.fx) + F(camera.cx)
            v = (y0 + offsets[1]) * turn * F(camera.fy) + F(camera.cy)
            inside = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        u, v = np.where(inside, u, F(0)), np.where(inside, v, F(0))
        here = v.astype(np.int32), u.astype(np.int32)
        shade, slant = picture.shade[here], picture.slants[here]
        depth = sample(picture.depth, u, v, slant, jump)
        sdf = (depth - z) * slant
        fall = (truncation + sdf) * (F(1) / (truncation - fade))
        trust = np.where(inside & (depth > 0) & (sdf > -truncation), np.where(sdf < -fade, fall, F(1)), F(0))
        added = ((shade >> 24).astype(F) * trust + F(0.5)).astype(np.int32).astype(F)
        scaled = sdf * (F(1) / truncation)
        self._average(rows, np.minimum(scaled, F(1)) * F(32767), added, shade)

    def _average(self, rows: np.ndarray, distance: np.ndarray, added: np.ndarray, shade: np.ndarray) -> None:
        """Take distances and colours into the running means, with dithered rounding."""
        before = self.weight[rows].astype(F)
        total = before + added
        sure = np.where(total > 0, total, F(1))
        changed = added > 0
        seeds = scramble_key(self.keys[rows]).astype(np.uint32)[:, None]
        noise = scramble(
            seeds
            + np.arange(BLOCK_SIDE_VOXELS**3, dtype=np.uint32) * np.uint32(0x9E3779B9)
            + before.astype(np.uint32) * np.uint32(0x85EBCA6B)
        )
        self.weight[rows] = np.where(changed, np.minimum(total, F(65535)), before).astype(np.uint16)
        old = self.distance[rows].astype(F)
        random = (noise >> 16).astype(F) * F(1 / 65536)
        shifted = old + (distance - old) * (added / sure) + F(32768) + random
        fresh = np.minimum(shifted.astype(np.int32), 65535) - 32768
        self.distance[rows] = np.where(changed, fresh, self.distance[rows])
        random = (noise & np.uint32(65535)).astype(F) * F(1 / 65536)
        share = added / np.minimum(sure, F(2048))
        for channel in range(3):
            old = self.color[rows, channel].astype(F)
            seen = (shade >> 8 * channel & 255).astype(F)
            mean = old + (seen - old) * share + random
            whole = np.clip(mean.astype(np.int32), 0, 255)
            self.color[rows, channel] = np.where(changed, whole, self.color[rows, channel])

    def surface(
        self, least_weight: int, end: Corner = (MAX_BLOCKS_FROM_ORIGIN,) * 3, with_edges: bool = False
    ) -> SurfacePatch:
        values, colors = self._corners(least_weight)  # (B, 9, 9, 9): z, y, x
        here = values[:, :BLOCK_SIDE_VOXELS, :BLOCK_SIDE_VOXELS, :BLOCK_SIDE_VOXELS]
        base = unpack(self.keys) * BLOCK_SIDE_VOXELS
        parts = []
        for axis in range(3):
            step = np.eye(3, dtype=int)[axis][::-1]
            to = tuple(slice(s, BLOCK_SIDE_VOXELS + s) for s in step)
            other = values[(slice(None), *to)]
            rows, z, y, x = np.nonzero(here * other < 0)
            a, b = here[rows, z, y, x].astype(np.float64), other[rows, z, y, x].astype(np.float64)
            share = a / (a - b)
            lattice = base[rows] + np.stack([x, y, z], 1)
            ones = colors[rows, :, z, y, x].astype(np.float64)
            others = colors[rows, :, z + step[0], y + step[1], x + step[2]].astype(np.float64)
            where = lattice + share[:, None] * np.eye(3)[axis]
            mixed = (ones + (others - ones) * share[:, None] + 0.5).astype(np.uint8)
            parts.append((rows, where * self.lattice.voxel, mixed, name_edges(lattice, axis)))
        order = np.argsort(np.concatenate([part[0] for part in parts]), kind="stable")  # by block, axis, voxel
        vertices, shades, edges = (np.concatenate([part[i] for part in parts])[order] for i in (1, 2, 3))
        faces = self._faces(values, np.all(unpack(self.keys) < np.array(end), axis=1), edges)
        return SurfacePatch(vertices.astype(F), faces, shades, edges if with_edges else edges[:0])

    def _corners(self, least_weight: int) -> tuple[np.ndarray, np.ndarray]:
        """Distances and colours of each block and of the next voxel on each axis; distance 0 where nothing is known."""
        known = self.weight >= least_weight
        plain = np.where(known, np.where(self.distance == 0, 1, self.distance), 0).astype(np.int32)
        plain, shades = (
            plain.reshape(-1, BLOCK_SIDE_VOXELS, BLOCK_SIDE_VOXELS, BLOCK_SIDE_VOXELS),
            self.color.reshape(-1, 3, BLOCK_SIDE_VOXELS, BLOCK_SIDE_VOXELS, BLOCK_SIDE_VOXELS),
        )
        values = np.zeros((self.blocks, BLOCK_SIDE_VOXELS + 1, BLOCK_SIDE_VOXELS + 1, BLOCK_SIDE_VOXELS + 1), np.int32)
        colors = np.zeros(
            (self.blocks, 3, BLOCK_SIDE_VOXELS + 1, BLOCK_SIDE_VOXELS + 1, BLOCK_SIDE_VOXELS + 1), np.uint8
        )
        for n in range(8):
            dx, dy, dz = n & 1, n >> 1 & 1, n >> 2
            rows, found = self._find(self.keys + pack_step(dx, dy, dz))
            to = tuple(slice(BLOCK_SIDE_VOXELS, None) if d else slice(0, BLOCK_SIDE_VOXELS) for d in (dz, dy, dx))
            source = tuple(slice(0, 1) if d else slice(None) for d in (dz, dy, dx))
            values[(found, *to)] = plain[(rows, *source)]
            colors[(found, slice(None), *to)] = shades[(rows, slice(None), *source)]
        return values, colors

    def _find(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows of those keys that there are, and their positions in `keys`."""
        at = np.searchsorted(self.keys, keys).clip(max=max(self.blocks - 1, 0))
        found = np.flatnonzero(self.keys[at] == keys)
        return at[found], found

    def _faces(self, values: np.ndarray, wanted: np.ndarray, edges: np.ndarray) -> np.ndarray:
        corners = [
            values[:, dz : BLOCK_SIDE_VOXELS + dz, dy : BLOCK_SIDE_VOXELS + dy, dx : BLOCK_SIDE_VOXELS + dx]
            for dz, dy, dx in np.ndindex(2, 2, 2)
        ]  # in the order of their numbers
        whole = np.logical_and.reduce([c != 0 for c in corners]) & wanted[:, None, None, None]
        case = np.zeros(whole.shape, np.int32)
        for bit, corner in enumerate(corners):
            case |= (corner < 0).astype(np.int32) << bit
        rows, z, y, x = np.nonzero(whole & (case > 0) & (case < 255))
        listed = triangles()[case[rows, z, y, x]]
        cell = unpack(self.keys)[rows] * BLOCK_SIDE_VOXELS + np.stack([x, y, z], 1)
        at, place = np.nonzero(listed >= 0)
        edge = CUBE_EDGES[listed[at, place]]
        names = name_edges(cell[at] + edge[:, :3], edge[:, 3])
        order = np.argsort(edges)
        return order[np.searchsorted(edges[order], names)].astype(np.int32).reshape(-1, 3)


def pack(blocks: np.ndarray) -> np.ndarray:
    """(B,) int64 keys of (B, 3) coordinates of blocks."""
    x, y, z = (blocks + MAX_BLOCKS_FROM_ORIGIN).T
    return z << 2 * BLOCK_INDEX_BITS | y << BLOCK_INDEX_BITS | x


def pack_step(dx: int, dy: int, dz: int) -> int:
    """What to add to a key to get that of a neighbour."""
    return dx + (dy << BLOCK_INDEX_BITS) + (dz << 2 * BLOCK_INDEX_BITS)


def unpack(keys: np.ndarray) -> np.ndarray:
    """(B, 3) coordinates of blocks."""
    return (
        np.stack([keys >> axis * BLOCK_INDEX_BITS & (2**BLOCK_INDEX_BITS - 1) for axis in range(3)], 1)
        - MAX_BLOCKS_FROM_ORIGIN
    )


def name_edges(voxels: np.ndarray, axis: np.ndarray | int) -> np.ndarray:
    """(E,) int64 of the edges of the lattice that go up an axis from (E, 3) voxels."""
    x, y, z = (voxels.astype(np.int64) + MAX_BLOCKS_FROM_ORIGIN * BLOCK_SIDE_VOXELS).T
    return np.asarray(axis, np.int64) << 60 | z << 40 | y << 20 | x


def sample(depth: np.ndarray, u: np.ndarray, v: np.ndarray, slant: np.ndarray, jump: np.float32) -> np.ndarray:
    """Depth between four pixels, or that of the pixel itself where they do not lie on one surface."""
    height, width = depth.shape
    left, above = (u + F(0.5)).astype(np.int32) - 1, (v + F(0.5)).astype(np.int32) - 1
    share_x, share_y = u - F(0.5) - left.astype(F), v - F(0.5) - above.astype(F)
    x0, x1, y0, y1 = left.clip(0), (left + 1).clip(max=width - 1), above.clip(0), (above + 1).clip(max=height - 1)
    a, b, c, d = depth[y0, x0], depth[y0, x1], depth[y1, x0], depth[y1, x1]
    low, top = np.minimum.reduce([a, b, c, d]), np.maximum.reduce([a, b, c, d])
    upper, lower = a + (b - a) * share_x, c + (d - c) * share_x
    own = depth[v.astype(np.int32), u.astype(np.int32)]
    smooth = (low > 0) & ((top - low) * slant <= jump) & (own > 0)
    return np.where(smooth, upper + (lower - upper) * share_y, own)


def scramble(x: np.ndarray) -> np.ndarray:
    """Noise of 32 bits, the same as in fuse.cpp."""
    x = x ^ x >> np.uint32(16)
    x = x * np.uint32(0x7FEB352D)
    x = x ^ x >> np.uint32(15)
    x = x * np.uint32(0x846CA68B)
    return x ^ x >> np.uint32(16)


def scramble_key(keys: np.ndarray) -> np.ndarray:
    """Noise of 64 bits, the same as in grid.cpp."""
    x = keys.astype(np.uint64)
    x = x ^ x >> np.uint64(31)
    x = x * np.uint64(0x7FB5D329728EA185)
    x = x ^ x >> np.uint64(27)
    x = x * np.uint64(0x81DADEF4BC2DD44D)
    return x ^ x >> np.uint64(33)
