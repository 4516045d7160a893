"""Steps whose length is the learning rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.plugin import BadInput, Columns, Optimizer, OptimizerInput, Points


@dataclass(frozen=True)
class NewPart(Optimizer):
    """Moves every number by its learning rate, against the sign of the running mean of its gradients."""

    momentum: float = 0.9
    """Share of the earlier mean in the new one, from 0 up to, but not, 1."""

    def __post_init__(self) -> None:
        if not 0 <= self.momentum < 1:
            raise BadInput(f"new-part.momentum is {self.momentum}; it must be 0 or more, and less than 1")

    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        """See `Optimizer.step`."""
        values = points.all_params()
        for name, grad in grads.items():
            mean = points.exp_avg[name].lerp_(grad, 1 - self.momentum)
            values[name].sub_(mean.sign(), alpha=given.rates[name])


CHANGE: Mapping[str, Any] = {"pretrain.optimizer": NewPart()}
"""What puts the part into a recipe, by dotted path."""
