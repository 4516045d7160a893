"""Columns with equally many cameras, each cut into rows with equally many."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.partition.base import Cells, CoarseModel, Ground, Partition


@dataclass(frozen=True)
class CameraGrid(Partition):
    """Columns with equally many cameras, each cut into rows with equally many, borders midway (VastGaussian, sec. 3.2).

    Cameras that stand at the same place along an axis stay together.
    """

    blocks: tuple[int, int] = (2, 2)
    """Columns along the first axis of the ground, and rows of each."""

    def __post_init__(self) -> None:
        if min(self.blocks) < 1:
            raise BadInput(f"partition: camera-grid.blocks is {self.blocks}; give 1 or more along each axis")

    def cells(self, sight: CoarseModel) -> Cells:
        """See `Partition.cells`."""
        ground = Ground.under(sight.centres, sight.splats.means)
        x, y = ground.flat(sight.centres).T.contiguous()
        columns = self._borders(x, self.blocks[0])
        column = torch.bucketize(x, torch.tensor(columns, dtype=torch.float64), right=True)
        boxes = []
        for index, (x0, x1) in enumerate(pairwise([None, *columns, None])):
            rows = self._borders(y[column == index], self.blocks[1])
            boxes += [(x0, y0, x1, y1) for y0, y1 in pairwise([None, *rows, None])]
        return Cells(ground, tuple(boxes), tuple(range(len(boxes))))

    def _borders(self, places: Tensor, count: int) -> list[float]:
        """Between `count` groups, as equal as they can be, of cameras at (V,) places along an axis."""
        ranked = places.sort().values
        gaps = (ranked[1:] > ranked[:-1]).nonzero()[:, 0] + 1
        borders = []
        for part in range(1, count):
            if len(gaps) < count - part:
                raise BadInput(
                    f"partition: the cameras stand at too few places for camera-grid.blocks {self.blocks}; use fewer"
                )
            usable = gaps[: len(gaps) - (count - part - 1)]  # the borders to come need one each
            nearest = int((usable - len(ranked) * part // count).abs().argmin())
            at = int(usable[nearest])
            borders.append(float((ranked[at - 1] + ranked[at]) / 2))
            gaps = gaps[nearest + 1 :]
        return borders
