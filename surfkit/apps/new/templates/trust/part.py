"""A weight for the pixels of depth maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from surfkit.plugin import BadInput, DepthPrior, Depths, Maps, Trust
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Trust):
    """Weigh pixels by how opaque the splats are there, and leave out those that are nearly transparent."""

    least: float = 0.5
    """Alpha below which a pixel is left out."""

    def __post_init__(self) -> None:
        if not 0 <= self.least < 1:
            raise BadInput(f"new-part.least is {self.least}; it must be 0 or more and below 1")

    def within(self, maps: Maps, depth: Tensor, prior: DepthPrior | None) -> Tensor:
        """See `Trust.within`."""
        alpha = maps.need("alpha").reshape(depth.shape)
        return torch.where(alpha >= self.least, alpha, 0.0)

    def among(self, at: int, depths: Depths) -> Tensor:
        """See `Trust.among`; other views do not count."""
        return torch.ones_like(depths.read(at))


CHANGE: Mapping[str, Any] = {"mesh.trust": NewPart()}
"""What puts the part into a recipe, by dotted path."""
