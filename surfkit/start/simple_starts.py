"""Initial points that need no depth maps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from surfkit.core.check import BadInput
from surfkit.scene.scene import SparsePoints
from surfkit.start.base import Start, StartInput

RANDOM_GREY = 128
"""Colour of a random point."""
BOX_OUTLIER_SHARE = 0.01
"""Share of the sparse points, on either side along each axis, that does not decide how large the box is."""


@dataclass(frozen=True)
class SparseStart(Start):
    """Start from the sparse points of the data set, as 3DGS does (Kerbl et al. 2023)."""

    def cloud(self, known: StartInput) -> SparsePoints:
        """See `Start.cloud`."""
        return known.scene.cloud

    def expected(self, sparse: int, pixels: int) -> int:
        """See `Start.expected`."""
        return sparse


@dataclass(frozen=True)
class RandomStart(Start):
    """Start from random grey points in the bounding box of sparse points and cameras, as a baseline."""

    points: int = 50_000
    """Number of points."""

    def __post_init__(self) -> None:
        if self.points < 1:
            raise BadInput(f"start.points is {self.points}; it must be 1 or more")

    def cloud(self, known: StartInput) -> SparsePoints:
        """See `Start.cloud`."""
        xyz = known.scene.cloud.xyz.sort(0).values
        cut = int(BOX_OUTLIER_SHARE * len(xyz))
        centres = torch.stack([view.camera.centre for view in known.scene.train]).float()
        corners = torch.cat([xyz[cut : cut + 1], xyz[len(xyz) - 1 - cut : len(xyz) - cut], centres])
        low, high = corners.amin(0), corners.amax(0)
        drawn = torch.rand(self.points, 3, generator=known.generator)
        return SparsePoints(low + (high - low) * drawn, torch.full((self.points, 3), RANDOM_GREY, dtype=torch.uint8))

    def limited(self, points: int) -> RandomStart:
        """See `Start.limited`."""
        return replace(self, points=min(self.points, points))

    def expected(self, sparse: int, pixels: int) -> int:
        """See `Start.expected`."""
        return self.points
