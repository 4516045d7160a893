"""What changes the points by the gradients of a step."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from surfkit.core.registry import Component
from surfkit.losses.base import Target
from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Maps, Splats


@dataclass(frozen=True)
class OptimizerInput:
    """What an optimizer is told of a step.

    Attributes:
        index: The step, from 1.
        steps: Of the whole stage.
        rates: Learning rate of each parameter; of positions, local units.
        rows: (R,) int64, the points that the step is for, different ones; None where it is for all N.
        seed: Differs from step to step and from run to run; for optimizers that draw.
        pull: From cotangents of the maps that the step has drawn to gradients by the raw parameters, shapes as those of
            the losses: the product with the transposed Jacobian, at the price of a backward pass. Only for an optimizer
            with `pulls`, and before it changes anything.
        target: The photograph of the step.
        maps: What was drawn.
        splats: The points that the step is for, as they were drawn.
    """

    index: int
    steps: int
    rates: Mapping[str, float]
    rows: Tensor | None
    seed: int
    pull: Callable[[Maps], Columns]
    target: Target
    maps: Maps
    splats: Splats


class Optimizer(Component):
    """Changes the points by their gradients in every step."""

    in_view: ClassVar[bool] = False
    """Whether a step is for the points alone that its view may show. Stages with regularizers, steps with a second
    view, and primitives that draw themselves or have parameters that belong to no point are for all points still."""

    divides: ClassVar[bool] = False
    """Whether it works where several processes train one model, each with some of the points: a step treats each point
    by itself, and reads no `splats`. A class says so itself, as another that is derived from it may do otherwise."""

    pulls: ClassVar[bool] = False
    """Whether steps want other gradients beside that of the losses (`OptimizerInput.pull`)."""

    def refuse_unfit(self, path: str, stage: Any, primitive: Primitive) -> None:  # noqa: B027 (most fit everywhere)
        """BadInput if the stage (`surfkit.plugin.Stage`) at a path in the recipe, or the primitive, lacks what this
        works with; asked before a run."""

    def moment_type(self) -> torch.dtype:
        """Of `points.exp_avg` and `points.exp_avg_sq`."""
        return torch.float32

    @abstractmethod
    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        """Change the parameters that have a gradient, in place, and what is kept of earlier steps.

        `points.exp_avg` and `points.exp_avg_sq` are for that, two numbers for each parameter, 0 at first; more is in
        `points.stat(...)`. Edits, checkpoints and GPUs move all of these with the points.

        Args:
            points: N of them; where the step is for some, the others keep their values.
            grads: (N, ...) by parameter, or (R, ...) of the rows.
            given: About the step.
        """
