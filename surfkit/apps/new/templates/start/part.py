"""Fewer points to start from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from surfkit.plugin import BadInput, SparsePoints, Start, StartInput


@dataclass(frozen=True)
class NewPart(Start):
    """Start from a random share of the sparse points of the data set."""

    share: float = 0.5
    """Of the sparse points."""

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise BadInput(f"new-part.share is {self.share}; it must be more than 0 and at most 1")

    def expected(self, sparse: int, pixels: int) -> int:
        """See `Start.expected`."""
        return max(1, round(self.share * sparse)) if sparse else 0

    def cloud(self, known: StartInput) -> SparsePoints:
        """See `Start.cloud`."""
        cloud = known.scene.cloud
        count = len(cloud.xyz)
        if not count:
            raise BadInput("the data set has no sparse points to start from")
        drawn = torch.randperm(count, generator=known.generator)[: self.expected(count, 0)].sort().values
        normals = None if cloud.normals is None else cloud.normals[drawn]
        return replace(cloud, xyz=cloud.xyz[drawn], rgb=cloud.rgb[drawn], normals=normals)


CHANGE: Mapping[str, Any] = {"start": NewPart()}
"""What puts the part into a recipe, by dotted path."""
