"""Holes of depth maps filled from their surroundings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from scipy.ndimage import gaussian_filter
from surfkit.plugin import BadInput, DepthInput, DepthRegression, Fill, Filled, FillInput
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Fill):
    """The mean of the trusted inverse depths around each pixel, those nearby the most."""

    reach: float = 4.0
    """Standard deviation of the weights, pixels of the depth map."""

    least: float = 0.3
    """Least share of the weights that trusted pixels must have."""

    def __post_init__(self) -> None:
        if self.reach <= 0 or not 0 < self.least < 1:
            raise BadInput(f"new-part.reach {self.reach}, least {self.least}: give more than 0, and between 0 and 1")

    def opened(self, given: DepthInput, wanted: Sequence[int]) -> Callable[[FillInput], Tensor]:
        """See `Fill.opened`."""
        return self.means

    def means(self, given: FillInput) -> Tensor:
        """(h, w) means, 0 where too few pixels are trusted."""
        weight = torch.from_numpy(gaussian_filter(given.trust.numpy(), self.reach))
        total = torch.from_numpy(gaussian_filter((given.trust * given.inverse).numpy(), self.reach))
        return torch.where(weight >= self.least, total / weight.clamp_min(1e-9), 0)


CHANGE: Mapping[str, Any] = {"depth": Filled(fill=NewPart()), "pretrain.losses.depth": DepthRegression()}
"""What puts the part into a recipe, by dotted path: with a loss that reads the maps."""
