"""A loss."""

from dataclasses import dataclass

from surfkit.plugin import Loss


@dataclass(frozen=True)
class Charbonnier(Loss):
    """Smooth absolute colour error, sqrt(d^2 + epsilon^2)."""

    weight: float = 0.8
    """Loss weight."""

    epsilon: float = 1e-3
    """Colour difference below which the error is nearly quadratic."""

    def weight_at(self, index, steps):
        """The same at each step."""
        return self.weight

    def __call__(self, maps, target):
        """The mean over pixels and channels."""
        return ((maps.color - target.photo) ** 2 + self.epsilon**2).sqrt().mean()
