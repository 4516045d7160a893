"""Depth maps from sparse points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from surfkit.plugin import BadInput, Camera, DepthEstimator, DepthInput, DepthRegression, Estimate


@dataclass(frozen=True)
class NewPart(DepthEstimator):
    """The depth of the nearest sparse points in each photograph, less certain the farther away they are."""

    aligned: ClassVar[bool] = True

    longest: int = 200
    """Longest side of the maps, pixels."""

    points: int = 3
    """Sparse points whose inverse depths are averaged for a pixel, by the inverse of their distance."""

    reach: float = 0.05
    """Distance at which the confidence is 0.5, as a share of the longest side of the photograph."""

    def __post_init__(self) -> None:
        if self.longest < 1 or self.points < 2 or self.reach <= 0:
            raise BadInput(
                f"new-part.longest {self.longest}, points {self.points}, reach {self.reach}: "
                "give 1 or more, 2 or more, and more than 0"
            )

    def of_map(self, camera: Camera) -> Camera:
        """See `DepthEstimator.of_map`."""
        return camera.fitted(self.longest)

    def estimate(self, given: DepthInput, wanted: Sequence[int]) -> Iterator[Estimate]:
        """See `DepthEstimator.estimate`."""
        for at in wanted:
            camera = given.views[at].camera
            places, inverse = given.observations.of(given.views[at])
            if len(places) < self.points:
                yield Estimate(at, None, None)
                continue
            small = self.of_map(camera)
            width, height = small.width, small.height
            sides = np.array([width, height]) / max(width, height)
            x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
            distance, near = cKDTree(places * sides).query(np.stack([x, y], -1) * sides, k=self.points)
            weight = 1 / np.maximum(distance, 1e-6)
            mean = (weight * inverse[near]).sum(-1) / weight.sum(-1)
            confidence = self.reach / (self.reach + distance[..., 0])
            yield Estimate(at, torch.from_numpy(mean).float(), torch.from_numpy(confidence).float())


CHANGE: Mapping[str, Any] = {"depth": NewPart(), "pretrain.losses.depth": DepthRegression()}
"""What puts the part into a recipe, by dotted path: with a loss that reads the maps."""
