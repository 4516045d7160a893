"""Removal of the faint points at one step."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from surfkit.plugin import BadInput, Edit, Points, Prune, Step, Steps


@dataclass(frozen=True)
class FaintOnce(Prune):
    """Drop all points below an opacity after one step (SuGaR, section 4.1)."""

    at: Steps = 9_000
    """Step after which to drop."""

    below: float = 0.5
    """Opacity that is too little."""

    most: float = 0.8
    """Largest share of the points that is dropped, the faintest first: in short runs few opacities have risen by then.
    The paper has no such limit (1)."""

    def __post_init__(self) -> None:
        if self.at < 1 or not 0 < self.below < 1 or not 0 < self.most <= 1:
            raise BadInput(
                f"prune: faint-once has at {self.at}, below {self.below:g} and most {self.most:g}; give a step of 1 or "
                "more, an opacity between 0 and 1, and a share above 0 and at most 1"
            )

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Drop what is too faint, once."""
        if step.index != self.at:
            return None
        opacities = step.splats.opacities
        faint = opacities.argsort(stable=True)[: int(self.most * len(opacities))]
        return Edit(
            drop=torch.zeros_like(opacities, dtype=torch.bool).index_fill(0, faint, True) & (opacities < self.below)
        )
