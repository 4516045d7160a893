"""What a step of a stage knows before it changes anything."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from surfkit.losses.base import Target
from surfkit.primitives.points import Columns
from surfkit.raster.api import Gradients, Maps, Splats
from surfkit.train.image_appearance import ImageAppearance
from surfkit.train.in_view import PointsInView


@dataclass(frozen=True)
class StepResult:
    """A view as it is rendered, what it is compared with, and the gradients that follow.

    Attributes:
        target: The view and its photograph.
        in_view: The points in view, where a step is for these alone; None where it is for all.
        leaves: Raw parameters of these points, or of all, that gradients can be taken by.
        shape: The splats made of them.
        splats: The same, detached, and the frozen ones.
        maps: The view as drawn; what the way back needed of the drawing is not kept.
        seen, radii: As in `Render`, of these points.
        losses: Weighted value of each loss.
        gradients: By the splats.
        appearance: That of the photograph, with its gradient, if the stage learns any.
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
