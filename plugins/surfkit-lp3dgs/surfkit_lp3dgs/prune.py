"""What is pruned when the mask has been learned (LP-3DGS, Zhang et al. 2024)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from surfkit.plugin import BadInput, Edit, Points, Primitive, Prune, Step, StepCount, Steps, Views, name_of
from surfkit_lp3dgs.mask import DRAWN, MASK, SCORE

SHARP = 16
"""Power of the sum that stands for a maximum over the pixels of a view: of n pixels it is at most n^(1/16) times it."""
HIDDEN = 0.1
"""Factor of the mask below which a point keeps the importance that it had: what is hidden shows none."""
LEAST_SCORE = 1e-6
"""Importance of a point that no view shows, as a multiple of the median: points with one are told by it."""


STRETCH = 20
"""Short runs learn for up to so many times the share of a long run: 500 of 30,000 steps become a third."""


@dataclass(frozen=True)
class PruneByMask(Prune):
    """Prune once, by a mask that is learned: how many points go is learned too (LP-3DGS, Zhang et al. NeurIPS 2024).

    For stages with `optimizer:masked-adam`, which learns the masks (sections 3.3 and 4.1 of the paper). Meanwhile this
    measures every `every` steps how important each point is to the training views, and at the end it drops the points
    whose mask is off: gs(m S) < 1/2 without noise, which is m S < 1. The rest of the run lets the others adapt.

    Not in the paper: where m begins, and what counts as a mask of 0. The size of m S matters, as it stands in a
    logarithm, and sums over pixels have a size that depends on the photographs: here S is the importance over the
    median of all points that a view shows. What a mask has dimmed shows less, so importance is divided by the factor
    that a point was drawn with; below a factor of 0.1 a point keeps the one it had.
    """

    start: Steps = 19_500
    """Last step before the masks are learned."""

    length: Annotated[int, StepCount(floor=100, stretch=STRETCH)] = 500
    """Steps that they are learned for; the last of them prunes. Short runs keep at least 100, in which m must find its
    value, but no more than a third of the run."""

    every: Annotated[int, StepCount(floor=20, stretch=STRETCH)] = 20
    """Steps between measurements of importance, each as many drawings as there are training views."""

    score: Literal["peak", "sum"] = "peak"
    """Importance: the largest alpha T of a point in any pixel of any view (RadSplat); or the sum of alpha T over all
    pixels and views (Mini-Splatting). The largest of a view is the sum of the 16th powers, to the power of 1/16."""

    begin: float = 1.0
    """Where masks m begin: at 1, half of the opacity of a point of median importance is drawn, in the middle."""

    def __post_init__(self) -> None:
        for name, least in (("start", 1), ("length", 1), ("every", 1)):
            if getattr(self, name) < least:
                raise BadInput(f"prune:learned-mask: {name} is {getattr(self, name)}; it must be {least} or more steps")
        if not 0 < self.begin < math.inf:
            raise BadInput(f"prune:learned-mask: begin is {self.begin:g}; it must be above 0")

    @property
    def end(self) -> int:
        """The step that prunes."""
        return self.start + self.length

    def refuse_unfit(self, path: str, stage: Any, primitive: Primitive) -> None:
        """See `Prune.refuse_unfit`."""
        if name_of(stage.optimizer) != "masked-adam":
            raise BadInput(
                f"{path}.prune: learned-mask prunes by what optimizer:masked-adam learns, and the optimizer is "
                f"{name_of(stage.optimizer)}; choose {path}.optimizer:masked-adam"
            )
        if self.end > stage.steps:
            raise BadInput(
                f"{path}.prune: learned-mask prunes at step {self.end}, and the stage has {stage.steps}; make start or "
                f"length smaller, or the stage longer"
            )
        added = stage.densify.edits(stage.steps) if stage.densify is not None else None
        if added is not None and any(self.start < at <= self.end for at in added):
            raise BadInput(
                f"{path}.prune: learned-mask learns in steps {self.start + 1} to {self.end}, in which densify "
                f"{name_of(stage.densify)} changes points and opacities; begin after it has ended"
            )
        if sum(name_of(prune) == "learned-mask" for prune in stage.prune) > 1:
            raise BadInput(f"{path}.prune: learned-mask is there twice, and points have one mask; leave one out")

    def watch(self, points: Points, step: Step) -> None:
        """Measure importance where that is due; after the last step there is none any more."""
        if self.start <= step.index <= self.end and (self._is_due(step.index) or step.index == self.end):
            mask, score = points.stat(MASK), points.stat(SCORE)
            score.copy_(relative(measured(step.views, self.score), points.stat(DRAWN), score))
            mask[mask == 0] = self.begin
            if step.index == self.end:
                points.stat(DROPPED).copy_(mask * score < 1)
                score.zero_()

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Drop, once, the points whose mask is off."""
        return Edit(drop=points.stat(DROPPED) > 0) if step.index == self.end else None

    def edits(self, steps: int, views: int) -> Sequence[int]:
        """See `Prune.edits`."""
        return [self.end] if self.end <= steps else []

    def _is_due(self, index: int) -> bool:
        return (index - self.start) % self.every == 0


DROPPED = "lp3dgs/dropped"
"""Column (N,): 1 for the points to drop."""


def measured(views: Views, score: Literal["peak", "sum"]) -> Tensor:
    """(N,) importance of each point: see `PruneByMask.score`."""
    found: Tensor | None = None
    power = SHARP if score == "peak" else 1
    for amount, _ in views.each(power, power):
        here = amount ** (1 / power)
        found = here if found is None else torch.maximum(found, here) if score == "peak" else found + here
    assert found is not None, "there are views"
    return found


def relative(importance: Tensor, drawn: Tensor, before: Tensor) -> Tensor:
    """(N,) importance over its median, above 0.

    Args:
        importance: (N,) as the points are drawn.
        drawn: (N,) the factor of the mask in their opacities; 0 for those without one.
        before: (N,) what it was, relative; 0 for points that had none.
    """
    importance = importance.to(before)
    whole = torch.where(drawn > 0, importance / drawn.clamp_min(HIDDEN), importance)
    shown = whole[whole > 0]
    scale = shown.median() if len(shown) else whole.new_ones(())
    found = (whole / scale).clamp_min(LEAST_SCORE)
    return torch.where((drawn > 0) & (drawn < HIDDEN) & (before > 0), before, found)
