"""How large a grid will be, how it is cut into tiles, and how the pieces become one surface again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.mesh.lattice import BLOCK_BYTES, BLOCK_SIDE_VOXELS, MAX_BLOCKS_FROM_ORIGIN, Corner, SurfacePatch
from surfkit.raster.api import Splats

GRID_BYTES = 1.05 * BLOCK_BYTES
"""Of a block, its place in the table included."""
MESH_BYTES = 5_000
"""Most that the triangles of a block take while tiles are joined: everything twice, and the names of the vertices."""
GRID_BUDGET_SHARE = 0.2
"""Of the memory budget that a grid may take; the rest is for the triangles, which are all there at the end."""
MIN_CELL_SPLATS = 4
"""Splats in a cell from which it is taken for covered."""
BLOCKS_PER_SURFACE_BLOCK = 3.0
"""Blocks for each that a surface passes through."""
BLOCK_TRIANGLES = 2 * BLOCK_SIDE_VOXELS**2 / BLOCKS_PER_SURFACE_BLOCK
"""Of a block that is counted, where the surface is flat; and half as many vertices."""


@dataclass(frozen=True)
class BlockRange:
    """Blocks from `low` up to, without, `high`."""

    low: Corner = (1 - MAX_BLOCKS_FROM_ORIGIN,) * 3
    high: Corner = (MAX_BLOCKS_FROM_ORIGIN - 1,) * 3

    def halves(self, seen: BlockRange) -> tuple[BlockRange, BlockRange] | None:
        """Cut through the longest side of what has been seen in it; None if it is a single block."""
        low, high = np.maximum(self.low, seen.low), np.minimum(self.high, seen.high)
        axis = int((high - low).argmax())
        if high[axis] - low[axis] < 2:
            return None
        cut = int(low[axis] + high[axis]) // 2
        return BlockRange(self.low, _put(self.high, axis, cut)), BlockRange(_put(self.low, axis, cut), self.high)

    def with_border(self) -> BlockRange:
        """One more block at the upper ends: cells there have corners in it."""
        return BlockRange(self.low, tuple(min(side + 1, MAX_BLOCKS_FROM_ORIGIN - 1) for side in self.high))

    def meets(self, other: BlockRange) -> bool:
        """Whether they have a block in common."""
        return bool((np.maximum(self.low, other.low) < np.minimum(self.high, other.high)).all())

    def joined(self, other: BlockRange) -> BlockRange:
        """The smallest box around both."""
        low, high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        return BlockRange(tuple(low.tolist()), tuple(high.tolist()))


def _put(corner: Corner, axis: int, value: int) -> Corner:
    x, y, z = (value if at == axis else old for at, old in enumerate(corner))
    return x, y, z


@dataclass(frozen=True)
class GridEstimate:
    """Blocks that a surface will take.

    Attributes:
        cells: (C, 3) cells that splats lie in.
        blocks_along: Blocks along a cell.
        blocks: Estimate for each cell.
    """

    cells: np.ndarray
    blocks_along: int
    blocks: float

    @property
    def total(self) -> int:
        """Blocks in all."""
        return int(len(self.cells) * self.blocks)


def estimate(splats: Splats, voxel: float, within: tuple[np.ndarray, np.ndarray]) -> GridEstimate:
    """Count blocks from where the splats lie; cells grow until several splats share one, and stand for a surface.

    Args:
        splats: Those that are hardly visible do not count.
        voxel: Local units.
        within: Lowest and highest corner of what views can see, local.
    """
    means = splats.means[splats.opacities > 0.1].double().cpu().numpy()
    means = means[((means >= within[0]) & (means <= within[1])).all(1)]
    for level in range(BITS_OF_CELL + 1):
        along = 2**level
        cells = different(np.floor(means / (voxel * BLOCK_SIDE_VOXELS * along)).astype(np.int64))
        if len(means) >= MIN_CELL_SPLATS * len(cells):
            break
    return GridEstimate(cells, along, BLOCKS_PER_SURFACE_BLOCK * along**2)


def different(cells: np.ndarray) -> np.ndarray:
    """The different rows of (n, 3) int64, in their order."""
    if not len(cells):
        return cells
    low = cells.min(0)
    sides = tuple(int(a) - int(b) + 1 for a, b in zip(cells.max(0), low, strict=True))  # without end, as int64 is not
    if math.prod(sides) >= 2**63:
        return np.unique(cells, axis=0)
    names = np.ravel_multi_index(tuple((cells - low).T), sides)
    return np.stack(np.unravel_index(np.unique(names), sides), 1) + low  # numbers are sorted faster than rows


BITS_OF_CELL = 12


def plan(found: GridEstimate, most_blocks: int) -> list[BlockRange]:
    """Boxes that together are all of space, none of which is expected to need more than `most_blocks`."""

    def cut(box: BlockRange, cells: np.ndarray) -> list[BlockRange]:
        if len(cells) * found.blocks <= most_blocks or not len(cells) or not np.ptp(cells, axis=0).any():
            return [box]
        axis = int(np.ptp(cells, axis=0).argmax())
        low, high = cells[:, axis].min(), cells[:, axis].max()
        at = int(np.clip(np.median(cells[:, axis]), low + 1, high))
        left, border = cells[:, axis] < at, at * found.blocks_along
        lower, upper = (
            BlockRange(box.low, _put(box.high, axis, border)),
            BlockRange(_put(box.low, axis, border), box.high),
        )
        return [*cut(lower, cells[left]), *cut(upper, cells[~left])]

    return cut(BlockRange(), found.cells)


def join(pieces: Sequence[SurfacePatch]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and colours of all; vertices of the same edge of the lattice, which are the same, become one."""
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    names = np.concatenate([piece.edges for piece in pieces])
    _, first, place = np.unique(names, return_index=True, return_inverse=True)
    vertices = np.concatenate([piece.vertices for piece in pieces])[first]
    colors = np.concatenate([piece.colors for piece in pieces])[first]
    place = place.astype(np.int32)
    faces = np.concatenate([place[piece.faces + start] for piece, start in zip(pieces, starts, strict=False)])
    return vertices, faces, colors
