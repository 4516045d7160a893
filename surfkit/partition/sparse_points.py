"""Views by the sparse points that they show, and by where they stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.partition.assign import Assign, inside
from surfkit.partition.base import Cells, CoarseModel


@dataclass(frozen=True)
class SparsePointShare(Assign):
    """How many sparse points of the block a view shows, and where it stands; partly by chance (Hierarchical 3DGS).

    A view whose camera is in the block joins if it shows more than `points` of its sparse points. One in a box `growth`
    times as long and wide that shows as many joins with probability `chance`. Any other that shows more than `few`
    joins with a probability of `share` times the share that these are of all the sparse points it shows.
    """

    needs_observations: ClassVar[bool] = True

    points: int = 50
    """A view near the block must show more than so many of its sparse points."""

    growth: float = 2.0
    """How many times as long and wide as the block the box is in which views are near. A block without an end is taken
    to end at the outermost camera."""

    chance: float = 0.5
    """Probability with which a view near the block joins."""

    few: int = 10
    """A view farther away, or one that shows fewer, must show more than so many."""

    share: float = 2.0
    """Probability with which such a view joins, for each share of its sparse points that lies in the block."""

    most: int = 1_500
    """Views of a block; of more, some drawn by chance are left out."""

    def __post_init__(self) -> None:
        wrong = {
            "points": self.points < 0,
            "few": self.few < 0,
            "most": self.most < 1,
            "growth": not 1 <= self.growth < float("inf"),
            "chance": not 0 <= self.chance <= 1,
            "share": not 0 <= self.share < float("inf"),
        }
        allowed = {"most": "1 or more", "growth": "1 or more", "chance": "0 to 1"}
        for name in (name for name, is_wrong in wrong.items() if is_wrong):
            text = f"assign: sparse-points.{name} is {getattr(self, name)}; it must be {allowed.get(name, '0 or more')}"
            raise BadInput(text)

    @property
    def most_views(self) -> int:
        """See `Assign.most_views`."""
        return self.most

    def joins(self, sight: CoarseModel, cells: Cells) -> Tensor:
        """See `Assign.joins`."""
        counts, all_points = self._counts(sight, cells)
        enough = counts > self.points
        chance = (self.share * counts / all_points.clamp_min(1)[:, None]).where(counts > self.few, 0)
        chance = torch.where(enough & self._near(sight, cells), self.chance, chance)
        chance = torch.where(enough & inside(sight, cells), 1, chance)
        draws = torch.rand(chance.shape, generator=torch.Generator().manual_seed(sight.seed), dtype=torch.float64)
        return draws < chance

    def _counts(self, sight: CoarseModel, cells: Cells) -> tuple[Tensor, Tensor]:
        """(V, B) float64 sparse points of each block that each view shows; (V,) of all blocks."""
        found = sight.observations
        if found is None or found.is_empty:
            raise BadInput(
                "assign: sparse-points needs the sparse points that each photograph shows, and the data set has none; "
                "choose another assign, such as assign:picture-share"
            )
        owner, counts = cells.owner(torch.from_numpy(found.xyz)), torch.zeros(len(sight.views), cells.count)
        for at, view in enumerate(sight.views):
            if (seen := found.seen.get(view.name)) is not None:
                blocks = owner[torch.from_numpy(np.unique(seen.points))]
                counts[at] = torch.bincount(blocks[blocks >= 0], minlength=cells.count)
        return counts.double(), counts.double().sum(1)

    def _near(self, sight: CoarseModel, cells: Cells) -> Tensor:
        """(V, B) bool, which cameras stand in the grown box of each block."""
        cameras = cells.flat(sight.centres)
        near = torch.zeros(len(cameras), cells.count, dtype=torch.bool)
        for (x0, y0, x1, y1), block in zip(cells.boxes, cells.blocks, strict=True):
            low = torch.tensor([-torch.inf if side is None else side for side in (x0, y0)], dtype=torch.float64)
            high = torch.tensor([torch.inf if side is None else side for side in (x1, y1)], dtype=torch.float64)
            ends = cameras.amin(0).where(low.isinf(), low), cameras.amax(0).where(high.isinf(), high)
            reach = (self.growth - 1) / 2 * (ends[1] - ends[0]).clamp_min(0)
            near[:, block] |= ((cameras >= low - reach) & (cameras <= high + reach)).all(1)
        return near
