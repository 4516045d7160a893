"""The gradient that drives densification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.densify.base import Signal


@dataclass(frozen=True)
class LossGradient(Signal):
    """Decomposed-gradient densification: the screen-space gradient of chosen losses, raised to the size of the
    total (CityGaussianV2, eq. gradient)."""

    divides: ClassVar[bool] = True

    terms: tuple[str, ...] | None = None
    """Losses, by name, that drive densification; all of them if unset."""

    boost: float = 0.0
    """Raise the chosen gradient to this share of the total, on average (omega, 0.9 in the paper); 0 does not."""

    def __post_init__(self) -> None:
        if self.boost < 0:
            raise BadInput(f"signal.boost is {self.boost}; it must be 0 or more")
        if self.terms == ():
            raise BadInput("signal.terms is empty; name a loss, or leave it unset for all of them")

    def combine(self, chosen: Tensor, total: Tensor) -> Tensor:
        """The chosen gradient times max(boost x mean |total| / mean |chosen|, 1), means over the seen points."""
        if self.boost == 0 or self.terms is None:
            return chosen
        # unseen points have no gradient and both means have the same count, so sums will do, and none seen is no NaN
        ratio = total.norm(dim=-1).sum() / chosen.norm(dim=-1).sum().clamp_min(1e-30)
        return chosen * (self.boost * ratio).clamp_min(1)


@dataclass(frozen=True)
class AbsGradient(Signal):
    """Sizes of the pixels' shares of the screen-space gradient, which do not cancel out as signs do (AbsGS).

    Larger than the gradient itself: double the threshold of densification or more. AbsGS splits by it at 4e-4, and
    clones by the signed gradient at 2e-4: `adc.split_threshold`.
    """

    divides: ClassVar[bool] = True
    absolute: ClassVar[bool] = True

    terms: tuple[str, ...] | None = None
    """Losses, by name, that drive densification; all of them if unset."""

    def __post_init__(self) -> None:
        if self.terms == ():
            raise BadInput("signal.terms is empty; name a loss, or leave it unset for all of them")

    def combine(self, chosen: Tensor, total: Tensor) -> Tensor:
        """The chosen one as it is."""
        return chosen
