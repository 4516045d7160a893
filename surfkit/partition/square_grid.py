"""Square cells of a given length."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from surfkit.core.check import BadInput
from surfkit.partition.base import Cells, CoarseModel, Ground, Partition
from surfkit.partition.grid import product
from surfkit.scene.lengths import Length, check_length, to_local
from surfkit.scene.scene import Frame

MAX_GRID_CELLS = 10_000
"""Cells."""
CELL_ROUNDING = 1e-9
"""A box longer than a whole number of cells by no more than this share of one needs no further cell."""


@dataclass(frozen=True)
class SquareGrid(Partition):
    """Square cells over the box of the cameras (the chunks of Hierarchical 3D Gaussians, Kerbl et al. 2024).

    The outer cells have no end. Cells of 100 or fewer views, which the paper drops, are joined to a neighbour with the
    option `--min-views 101`, as dropping them would leave a hole.
    """

    side: Length = "auto"
    """Side of a cell, metres (the paper has 100); auto is the side with which `across` cells lie along the longer side
    of the box."""

    across: int = 2
    """Cells along the longer side of the box, where the side is auto."""

    padding: float = 0.2
    """How much longer and wider the box is than that of the cameras, as a share of that."""

    def __post_init__(self) -> None:
        check_length("partition: square-grid.side", self.side)
        if self.across < 1:
            raise BadInput(f"partition: square-grid.across is {self.across}; it must be 1 or more")
        if not 0 <= self.padding < float("inf"):
            raise BadInput(f"partition: square-grid.padding is {self.padding}; it must be 0 or more")

    def refuse_unfit(self, frame: Frame) -> None:
        """See `Partition.refuse_unfit`."""
        to_local(self.side, frame, "partition: square-grid.side: ")

    def cells(self, sight: CoarseModel) -> Cells:
        """See `Partition.cells`."""
        ground = Ground.under(sight.centres, sight.splats.means)
        cameras = ground.flat(sight.centres)
        low, high = cameras.amin(0), cameras.amax(0)
        size = (1 + self.padding) * (high - low)
        side = to_local(self.side, sight.frame, "partition: square-grid.side: ") or float(size.max()) / self.across
        if side == 0:
            raise BadInput(
                "partition: the cameras stand in one place; give square-grid.side in metres, or partition:none"
            )
        counts = [max(1, math.ceil(float(length) / side - CELL_ROUNDING)) for length in size]
        if counts[0] * counts[1] > MAX_GRID_CELLS:
            raise BadInput(
                f"partition: square-grid.side {self.side} makes {counts[0]:,} x {counts[1]:,} cells, and at most "
                f"{MAX_GRID_CELLS:,} are allowed; give a longer side"
            )
        middles = ((low + high) / 2).tolist()
        borders = (
            torch.tensor([middle + side * (at - count / 2) for at in range(1, count)], dtype=torch.float64)
            for middle, count in zip(middles, counts, strict=True)
        )
        boxes = product(*borders)
        return Cells(ground, boxes, tuple(range(len(boxes))))
