"""A policy that removes points which have grown too large."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.plugin import BadInput, Edit, Interval, Points, Prune, Step


@dataclass(frozen=True)
class NewPart(Prune):
    """Remove the points that are larger than a share of the scene."""

    largest: float = 0.1
    """Longest scale that a point may have, as a share of the scene extent."""

    every: Interval = 100
    """Steps between edits."""

    def __post_init__(self) -> None:
        if self.largest <= 0 or self.every < 1:
            raise BadInput(f"new-part.largest {self.largest}, every {self.every}: give more than 0, and 1 or more")

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Remove what is too large, every so many steps."""
        if step.index % self.every:
            return None
        return Edit(drop=step.splats.scales.amax(dim=1) > self.largest)


CHANGE: Mapping[str, Any] = {"pretrain.prune": (NewPart(),)}
"""What puts the part into a recipe, by dotted path."""
