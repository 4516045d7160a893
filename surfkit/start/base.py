"""Where the points of a run begin."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.core.registry import Component
from surfkit.readers.depth_prior import DepthPrior
from surfkit.scene.scene import Cloud, Scene


@dataclass(frozen=True)
class StartInput:
    """What is known before the first step.

    Attributes:
        scene: Its training views, cameras and sparse points.
        photos: (3, H, W) uint8 by position of the training view.
        masks: (H, W) bool by position, False where the photograph is to be ignored; None where there is no mask.
        priors: By position, with normals if the data set has them; None where the start needs no priors.
        generator: Of every random draw.
    """

    scene: Scene
    photos: Sequence[Tensor]
    masks: Sequence[Tensor | None] | None
    priors: Sequence[DepthPrior | None] | None
    generator: torch.Generator


class Start(Component):
    """A way to find the points that splats begin at. Depth priors are only read when it has `needs_prior`."""

    needs_prior: ClassVar[bool] = False

    @abstractmethod
    def cloud(self, known: StartInput) -> Cloud:
        """The points, the same for the same settings, data and state of the generator.

        Raises:
            BadInput: There is nothing to begin from.
        """

    def limited(self, points: int) -> Start:
        """The same start with at most so many points, where it decides how many there are; else the start itself."""
        return self

    @abstractmethod
    def expected(self, sparse: int, pixels: int) -> int:
        """About how many points there will be, for a forecast.

        Args:
            sparse: Sparse points of the scene.
            pixels: Of all training photographs together, at the size they are used at.
        """
