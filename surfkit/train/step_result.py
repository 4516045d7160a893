"""What a step of a stage knows before it changes anything."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from surfkit.losses.base import RegularizerInput, Target
from surfkit.primitives.points import Columns
from surfkit.raster.api import Gradients, Maps, Render, Splats
from surfkit.train.image_appearance import ImageAppearance
from surfkit.train.in_view import PointsInView
from surfkit.train.loss_gradients import pulled


@dataclass(frozen=True)
class StepResult:
    """A view as it is rendered, what it is compared with, and the gradients that follow.

    Attributes:
        target: The view and its photograph.
        in_view: The points in view, where a step is for these alone; None where it is for all.
        leaves: Raw parameters of these points, or of all, that gradients can be taken by.
        shape: The splats made of them.
        splats: The same, detached, and the frozen ones.
        maps: The view as drawn.
        seen, radii: As in `Render`, of these points.
        losses: Weighted value of each loss.
        gradients: By the splats.
        appearance: That of the photograph, with its gradient, if the stage learns any.
        render: What goes back once more, for an optimizer that wants other gradients too (`Optimizer.pulls`); None for
            others, as it holds much of a GPU's memory.
        given: What terms on the points are told of the step.
        terms: Parts of regularizers that have moved the maps already (`Regularizer.with_maps`), weighted.
    """

    target: Target
    in_view: PointsInView | None
    leaves: Columns
    shape: Splats
    splats: Splats
    maps: Maps
    seen: Tensor
    radii: Tensor
    losses: dict[str, float]
    gradients: Gradients
    appearance: ImageAppearance | None
    render: Render | None
    given: RegularizerInput
    terms: Columns

    @property
    def rows(self) -> Tensor | None:
        """(R,) int64, the points that the step is for; None for all."""
        return None if self.in_view is None else self.in_view.rows

    def pull(self, cotangents: Maps) -> Columns:
        """See `OptimizerInput.pull`."""
        assert self.render is not None, "it is kept for optimizers with `pulls`"
        return pulled(self.shape, self.render.backward(cotangents, rows=len(self.shape)), self.leaves, again=True)
