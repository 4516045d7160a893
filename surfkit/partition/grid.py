"""Grids on the ground: uniform in contracted space, as in the paper, or with equally many points to a row."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.partition.base import Box, Cells, CoarseModel, Contraction, Ground, Partition


@dataclass(frozen=True)
class ContractedGrid(Partition):
    """Uniform cells in a contracted space that holds the whole scene (CityGaussianV2, sec. 3.3)."""

    blocks: tuple[int, int] = (2, 2)
    """Cells along the two axes of the ground."""

    foreground: tuple[float, float, float, float] | None = None
    """Lower x and y, upper x and y, as shares of the box of the cameras, of what is not contracted. By default its
    central third."""

    def __post_init__(self) -> None:
        _check_blocks(self.blocks, "contracted-grid")
        x0, y0, x1, y1 = self.foreground or (0.0, 0.0, 1.0, 1.0)
        if not (x0 < x1 and y0 < y1):
            raise BadInput(
                f"partition: contracted-grid.foreground is {self.foreground}; its upper corner must be above"
            )

    def cells(self, sight: CoarseModel) -> Cells:
        """See `Partition.cells`."""
        ground = Ground.under(sight.centres, sight.splats.means)
        cameras = ground.flat(sight.centres)
        low, size = cameras.amin(0), cameras.amax(0) - cameras.amin(0)
        if not (size > 0).all():
            raise BadInput(
                "partition: the cameras stand in one line, so contracted-grid has no foreground; use quantile-grid"
            )
        x0, y0, x1, y1 = self.foreground or (1 / 3, 1 / 3, 2 / 3, 2 / 3)
        corners = [low + size * torch.tensor(at, dtype=torch.float64) for at in ((x0, y0), (x1, y1))]
        contraction = Contraction(*(tuple(corner.tolist()) for corner in corners))
        sides = [torch.linspace(0, 1, count + 1, dtype=torch.float64)[1:-1] for count in self.blocks]
        boxes = product(*sides)
        return Cells(ground, boxes, tuple(range(len(boxes))), contraction)


@dataclass(frozen=True)
class QuantileGrid(Partition):
    """Rows and columns with equally many points each, as in the released code of CityGaussianV2."""

    blocks: tuple[int, int] = (2, 2)
    """Cells along the two axes of the ground."""

    def __post_init__(self) -> None:
        _check_blocks(self.blocks, "quantile-grid")

    def cells(self, sight: CoarseModel) -> Cells:
        """See `Partition.cells`."""
        ground = Ground.under(sight.centres, sight.splats.means)
        flat = ground.flat(sight.splats.means).sort(0).values
        sides = []
        for axis, count in enumerate(self.blocks):
            at = [len(flat) * part // count for part in range(1, count)]
            sides.append(flat[at, axis])
            if len(set(sides[-1].tolist())) < count - 1:
                raise BadInput(
                    f"partition: {len(flat):,} points are too few for quantile-grid.blocks {self.blocks}; use fewer"
                )
        boxes = product(*sides)
        return Cells(ground, boxes, tuple(range(len(boxes))))


def product(x: Tensor, y: Tensor) -> tuple[Box, ...]:
    """The cells between inner borders along two axes, row by row."""
    columns, rows = ([None, *side.tolist(), None] for side in (x, y))
    return tuple(
        (x0, y0, x1, y1)
        for y0, y1 in zip(rows, rows[1:], strict=False)
        for x0, x1 in zip(columns, columns[1:], strict=False)
    )


def _check_blocks(blocks: tuple[int, int], name: str) -> None:
    if min(blocks) < 1:
        raise BadInput(f"partition: {name}.blocks is {blocks}; give 1 or more along each axis")
