"""An optimizer."""

from dataclasses import dataclass

from surfkit.plugin import BadInput, Columns, Optimizer, OptimizerInput, Points


@dataclass(frozen=True)
class Steady(Optimizer):
    """Plain steps along the running mean of the gradients, of the same length for all points."""

    momentum: float = 0.9
    """Share of the mean that stays."""

    def __post_init__(self) -> None:
        if not 0 <= self.momentum < 1:
            raise BadInput(f"steady.momentum {self.momentum:g}: give 0 to below 1")

    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        """Along the mean, divided by the root of the mean square over all points."""
        for name, grad in grads.items():
            mean = points.exp_avg[name].lerp_(grad, 1 - self.momentum)
            length = float((mean.double() ** 2).mean() ** 0.5) if mean.numel() else 0.0
            points.all_params()[name].sub_(mean, alpha=given.rates[name] / (length + 1e-15))
