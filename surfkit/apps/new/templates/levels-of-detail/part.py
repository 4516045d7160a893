"""Levels of detail."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.plugin import BadInput, LevelsOfDetail, LodBlock, LodInput, LodTree


@dataclass(frozen=True)
class NewPart(LevelsOfDetail):
    """Leave out the smallest splats: a level is drawn where what it lacks is smaller than a pixel."""

    keep: tuple[float, ...] = (0.5, 0.25)
    """Share of the points of the full model that each further level has."""

    def __post_init__(self) -> None:
        falls = all(before > after for before, after in itertools.pairwise((1.0, *self.keep, 0.0)))
        if not self.keep or not falls:
            raise BadInput(f"new-part.keep is {self.keep}; give shares between 1 and 0 that fall, such as 0.5 0.25")

    def build(self, given: LodInput) -> LodTree:
        """See `LevelsOfDetail.build`."""
        sizes = given.model.splats.detached().scales.amax(1).double().cpu()
        sizes, order = sizes.sort(descending=True, stable=True)
        full = given.model.take(order)
        counts = [len(full), *(max(1, round(share * len(full))) for share in self.keep)]
        lacking = [float(sizes[count]) if count < len(full) else 0.0 for count in counts]
        levels = [full, *(full.take(slice(0, count)) for count in counts[1:])]
        coarsest = len(levels) - 1
        # Each level is one block: the coarsest is the root, and below each one is the next finer one.
        blocks = [
            LodBlock(level, 0, counts[level], coarsest - level - 1, lacking[level]) for level in range(coarsest, -1, -1)
        ]
        return LodTree.of(order.numpy(), levels, blocks)


CHANGE: Mapping[str, Any] = {"lod": NewPart()}
"""What puts the part into a recipe, by dotted path."""
