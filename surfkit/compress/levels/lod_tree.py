"""Levels of detail of a model: tables of splats, and a tree of blocks of their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, TypeVar

import numpy as np
import torch

from surfkit.io.splats.splat_table import Tile
from surfkit.primitives.model import SplatModel
from surfkit.raster.api import CUTOFF, Splats
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame

Tree = TypeVar("Tree", bound="LodTree")
BLOCK_MARGIN_PX = 3.0
"""Around an image when blocks outside are left out: splats smaller than a pixel are drawn with up to this radius."""


def outside(low: np.ndarray, high: np.ndarray, reach: np.ndarray, camera: Camera, near: float) -> np.ndarray:
    """(B,) bool, boxes of which no splat touches the image of a camera, or only such that are too near.

    Args:
        low, high: (B, 3) corners of boxes with the centres of all splats.
        reach: (B,) how far these extend beyond their centres at most.
        camera: Who looks.
        near: Nearest depth that is drawn.
    """
    pose = camera.world_to_camera.numpy()
    middle, half = (low + high) / 2, (high - low) / 2
    local = middle @ pose[:3, :3].T + pose[:3, 3]
    extent = half @ np.abs(pose[2, :3])
    found = local[:, 2] + extent <= near
    sides = (0, camera.fx, camera.cx, camera.width), (1, camera.fy, camera.cy, camera.height)
    for axis, focal, centre, size in sides:
        for sign, edge in ((1.0, -BLOCK_MARGIN_PX), (-1.0, size + BLOCK_MARGIN_PX)):
            normal = np.zeros(3)  # of the plane through the camera centre and that edge, inwards
            normal[axis], normal[2] = sign, -sign * (edge - centre) / focal
            normal /= np.linalg.norm(normal)
            found |= local @ normal + (half @ np.abs(normal @ pose[:3, :3]) + reach) < 0
    return found


@dataclass(frozen=True)
class LodBlock:
    """Some rows of one level, before its box is known.

    Attributes:
        level: Whose rows.
        first, last: Rows from `first` up to, not including, `last`.
        parent: Position in the list of the block that stands for this one from farther away; -1 for the root.
        error: How far what is drawn lies from the full model, local units. What is drawn is the block when that is at
            most so many pixels; otherwise its children.
    """

    level: int
    first: int
    last: int
    parent: int
    error: float


@dataclass(frozen=True)
class LodBlocks:
    """B blocks as arrays; a parent comes before its children, and the root is the first.

    Attributes:
        level, first, last, parent: (B,) int64, see `LodBlock`.
        error: (B,) float64, local units; 0 for blocks without children, and never below that of a child.
        low, high: (B, 3) float64 corners of boxes with the centres of all splats of the block and below it.
        reach: (B,) float64, how far these splats extend beyond their centres at most, local units.
    """

    level: np.ndarray
    first: np.ndarray
    last: np.ndarray
    parent: np.ndarray
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    reach: np.ndarray

    def __len__(self) -> int:
        return len(self.level)

    @cached_property
    def is_leaf(self) -> np.ndarray:
        """(B,) bool, blocks without children."""
        leaf = np.ones(len(self), dtype=bool)
        leaf[self.parent[self.parent >= 0]] = False
        return leaf

    def pixels(self, camera: Camera) -> np.ndarray:
        """(B,) error of each block in pixels, seen at the nearest place of its box; inf within the box."""
        centre = camera.centre.numpy()
        outside = np.maximum(np.maximum(self.low - centre, centre - self.high), 0.0)
        distance = np.linalg.norm(outside, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = self.error * max(camera.fx, camera.fy) / distance
        return np.where(self.error > 0, found, 0.0)

    def outside(self, camera: Camera, near: float) -> np.ndarray:
        """(B,) bool, see `outside`."""
        return outside(self.low, self.high, self.reach, camera, near)

    def front(self, camera: Camera, pixels: float, near: float | None = None) -> np.ndarray:
        """(K,) positions of the blocks to draw: each point of the full model has exactly one above it or is in it.

        As an error never rises from a block to its children and their boxes lie in its box, a block is drawn where its
        own error is small enough and that of its parent is not.

        Args:
            camera: Who looks.
            pixels: Largest error that is allowed.
            near: Leave out blocks that the camera does not see, with that as the nearest depth; None draws all.
        """
        drawn = self._drawn(self.pixels(camera), pixels)
        if near is not None:
            drawn &= ~self.outside(camera, near)
        return drawn.nonzero()[0]

    def front_within(self, errors: np.ndarray, points: np.ndarray, budget: int) -> np.ndarray | None:
        """Positions of the blocks to draw, with the smallest largest error that a budget allows.

        Args:
            errors: (B,) of each block, such as `pixels`; never below that of a child.
            points: (B,) that each counts.
            budget: Most points in all.

        Returns:
            None if even the coarsest blocks have more points.
        """
        allowed = np.unique(errors)  # a front changes at these alone
        low, high = 0, len(allowed)
        while low < high:
            middle = (low + high) // 2
            if points[self._drawn(errors, allowed[middle])].sum() <= budget:
                high = middle
            else:
                low = middle + 1
        return self._drawn(errors, allowed[low]).nonzero()[0] if low < len(allowed) else None

    def _drawn(self, errors: np.ndarray, most: float) -> np.ndarray:
        """(B,) bool, blocks whose error is at most so much, or that are leaves, where their parent is not drawn."""
        fine = self.is_leaf | (errors <= most)
        return fine & ~np.where(self.parent >= 0, fine[self.parent], False)


@dataclass(frozen=True)
class LodTree:
    """Levels of detail of a model.

    Attributes:
        order: (N,) int64, which point of the full model each row of the first level is.
        levels: Splats of each level, all of the same primitive, local frame; the first is the full model, so ordered.
        blocks: Rows of them as a tree.
    """

    selects: ClassVar[str] = "blocks"
    """What is chosen for a camera by `seen`; lod.json has it."""

    order: np.ndarray
    levels: tuple[SplatModel, ...]
    blocks: LodBlocks

    @classmethod
    def sizes_of(cls, count: int) -> list[int] | None:
        """Points that the levels of a model of `count` points must have; None where they may have any."""
        return None

    @classmethod
    def of(cls: type[Tree], order: np.ndarray, levels: Sequence[SplatModel], blocks: Sequence[LodBlock]) -> Tree:
        """The tree of a list of blocks, the root first and parents before children.

        Boxes are found, and the errors of parents are raised to those of their children. `order`: (N,) of the points of
        the full model.
        """
        count = len(blocks)
        low, high, reach = np.full((count, 3), np.inf), np.full((count, 3), -np.inf), np.zeros(count)
        error = np.array([block.error for block in blocks], dtype=np.float64)
        for at, block in enumerate(blocks):
            if block.first < block.last:
                splats = levels[block.level].take(slice(block.first, block.last)).splats.detached()
                means = splats.means.double().cpu().numpy()
                low[at], high[at] = means.min(0), means.max(0)
                reach[at] = CUTOFF * float(splats.scales.max())
        for at in range(count - 1, 0, -1):
            up = blocks[at].parent
            low[up], high[up] = np.minimum(low[up], low[at]), np.maximum(high[up], high[at])
            reach[up], error[up] = max(reach[up], reach[at]), max(error[up], error[at])
        rows = {n: np.array([getattr(b, n) for b in blocks], np.int64) for n in ("level", "first", "last", "parent")}
        return cls(order, tuple(levels), LodBlocks(**rows, error=error, low=low, high=high, reach=reach))

    @cached_property
    def joined(self) -> Splats:
        """The activated splats of all levels, one level after the other."""
        first, *others = (level.splats.detached() for level in self.levels)
        for each in others:
            first = first.and_then(each)
        return first

    def rows(self, front: np.ndarray) -> torch.Tensor:
        """(R,) rows of `joined` of (K,) blocks."""
        before = np.concatenate([[0], np.cumsum([len(level) for level in self.levels])])
        blocks = self.blocks
        start = before[blocks.level[front]]
        spans = zip(start + blocks.first[front], start + blocks.last[front], strict=True)
        found = [np.arange(first, last) for first, last in spans]
        return torch.from_numpy(np.concatenate(found) if found else np.zeros(0, np.int64))

    def seen(self, camera: Camera, pixels: float) -> Splats:
        """The splats to draw for a camera; see `LodBlocks.front`."""
        rows = self.rows(self.blocks.front(camera, pixels, self.levels[0].near)).to(self.joined.means.device)
        return self.joined.take(rows)

    def tiles(self, frame: Frame) -> Tile:
        """The same as `surfkit.io.splats` has it, in the frame of the input.

        Raises:
            BadInput: Files of splats have no place for the primitive.
        """
        tables = [level.primitive.table(level.params).in_input_frame(frame) for level in self.levels]
        below: list[list[Tile]] = [[] for _ in range(len(self.blocks))]
        blocks, tile = self.blocks, None
        for at in range(len(blocks) - 1, -1, -1):
            tile = Tile(
                splats=tables[blocks.level[at]].take(slice(int(blocks.first[at]), int(blocks.last[at]))),
                low=frame.to_input(blocks.low[at]),
                high=frame.to_input(blocks.high[at]),
                error=float(blocks.error[at]) / frame.scale,
                children=tuple(reversed(below[at])),
            )
            if blocks.parent[at] >= 0:
                below[blocks.parent[at]].append(tile)
        assert tile is not None
        return tile
