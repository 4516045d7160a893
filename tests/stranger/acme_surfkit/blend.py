"""A densification signal."""

from dataclasses import dataclass

from torch import Tensor

from surfkit.plugin import BadInput, Signal


@dataclass(frozen=True)
class Blend(Signal):
    """The gradient of some losses and that of all of them, in equal parts or others."""

    terms: tuple[str, ...] | None = ("ssim",)
    """Losses, by name, whose gradient is computed separately."""

    share: float = 0.5
    """Weight of the gradient of these."""

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise BadInput(f"blend.share {self.share:g}: give 0 to 1")

    def combine(self, chosen: Tensor, total: Tensor) -> Tensor:
        """(N, 2) the weighted sum."""
        return self.share * chosen + (1 - self.share) * total
