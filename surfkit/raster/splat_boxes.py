"""Boxes around blocks of splats, to leave out whole blocks that a view does not show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surfkit.raster.api import Splats


@dataclass
class SplatBoxes:
    """Boxes around the splats of B blocks: all that is needed to tell that a view shows none of them.

    Attributes:
        kind, geometry, dilation: As of `Splats`.
        low: (B, 3) float32, lowest coordinates of the means.
        high: (B, 3) float32, highest.
        scale: (B,) float32, largest scale.
    """

    kind: str
    geometry: str
    dilation: float
    low: Tensor
    high: Tensor
    scale: Tensor

    @classmethod
    def of(cls, splats: Splats, size: int) -> SplatBoxes:
        """The boxes around each `size` of N splats, in their order; the last block may have fewer."""
        pad = -len(splats) % size
        means, scales = splats.means.detach().float(), splats.scales.detach().float().amax(1)
        if pad:
            means, scales = torch.cat([means, means[-1:].expand(pad, 3)]), torch.cat([scales, scales[-1:].expand(pad)])
        blocks = means.view(-1, size, 3)
        form = splats.kind, splats.geometry, splats.dilation
        return cls(*form, blocks.amin(1), blocks.amax(1), scales.view(-1, size).amax(1))

    @classmethod
    def joined(cls, parts: Sequence[SplatBoxes]) -> SplatBoxes:
        """Those of several, one after the other."""
        low, high, scale = (torch.cat([getattr(part, name) for part in parts]) for name in ("low", "high", "scale"))
        return replace(parts[0], low=low, high=high, scale=scale)

    def __len__(self) -> int:
        return len(self.scale)

    def take(self, rows: Tensor) -> SplatBoxes:
        """Those of (K,) indices."""
        return replace(self, low=self.low[rows], high=self.high[rows], scale=self.scale[rows])

    def widen(self, blocks: Tensor, splats: Splats) -> None:
        """Take in R splats, each into the box of its block, (R,) int64."""
        means, into = splats.means.detach().float(), blocks[:, None].expand(-1, 3)
        self.low.scatter_reduce_(0, into, means, "amin")
        self.high.scatter_reduce_(0, into, means, "amax")
        self.scale.scatter_reduce_(0, blocks, splats.scales.detach().float().amax(1), "amax")
