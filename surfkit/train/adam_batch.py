"""Adam for batches of views, with the learning rates of single ones scaled by the square root."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch

from surfkit.core.check import BadInput
from surfkit.primitives.points import Columns, Points
from surfkit.train.adam import BETA1, BETA2, EPSILON
from surfkit.train.optimizer import Optimizer, OptimizerInput


@dataclass(frozen=True)
class AdamBatch(Optimizer):
    """Adam that moves the points once for a batch of B views, by the mean of their gradients: learning rates times the
    root of B, the betas to the power of B, epsilon divided by the root of B (Grendel-GS, Zhao et al. 2025, section 4).

    A step shows one photograph still, and schedules count photographs, as in the paper: of B steps, the first B - 1
    gather gradients, and the last one moves the points. Densification looks at each of them.
    """

    divides: ClassVar[bool] = True

    views: int = 4
    """Views of a batch, B."""

    def __post_init__(self) -> None:
        if not 1 <= self.views <= 1_000:
            raise BadInput(f"optimizer:adam-batch: views is {self.views}; give 1 to 1000")

    def scaled(self, views: int) -> tuple[float, float, float, float]:
        """For a batch of so many views: the factor of learning rates, beta1, beta2, and epsilon."""
        return math.sqrt(views), BETA1**views, BETA2**views, EPSILON / math.sqrt(views)

    @torch.no_grad()
    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        """See `Optimizer.step`."""
        if points.shared:
            raise BadInput("optimizer:adam-batch is for points, and the primitive has other parameters; choose adam")
        for name, grad in grads.items():
            points.stat(f"batch/{name}", *grad.shape[1:]).add_(grad)
        shown = given.index % self.views or self.views
        if shown < self.views and given.index < given.steps:
            return
        factor, beta1, beta2, epsilon = self.scaled(shown)
        for name, value in points.params.items():
            if f"batch/{name}" not in points.stats:
                continue
            first, second, mean = points.exp_avg[name], points.exp_avg_sq[name], points.stats[f"batch/{name}"]
            mean /= shown
            first.lerp_(mean, 1 - beta1)
            second.mul_(beta2).addcmul_(mean, mean, value=1 - beta2)
            rate = given.rates[name] * factor / (1 - BETA1**given.index)
            correction = (1 - BETA2**given.index) ** -0.5
            value.addcdiv_(first, second.sqrt().mul_(correction).add_(epsilon), value=-rate)
            mean.zero_()
