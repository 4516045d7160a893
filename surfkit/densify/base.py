"""What decides how the set of points grows and shrinks."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from surfkit.core.registry import Component
from surfkit.primitives.points import Edit, Points
from surfkit.raster.api import Splats


class Views(Protocol):
    """What a policy may ask about all training views; computed only when asked."""

    def contribution(self, gamma: float) -> Tensor:
        """(N,) mean over the views of each point's mean alpha^gamma T^(1 - gamma) over the pixels it is blended into.

        A view that does not see a point counts as 0 (CityGaussianV2, eq. 4).
        """


@dataclass(frozen=True)
class Step:
    """What policies are told after one optimisation step.

    Attributes:
        index: Steps done, this one included.
        steps: Of the whole stage.
        seen: (N,) bool, the point may touch a pixel of this step's view.
        shape: The splats that were rendered, N of them, detached.
        grad: (N,) length of the densification signal, as `Gradients.signal`; 0 where not seen.
        radii: (N,) pixels; 0 where not seen.
        image_px: Longer side of this step's view, pixels.
        views: All training views.
    """

    index: int
    steps: int
    seen: Tensor
    shape: Splats
    grad: Tensor
    radii: Tensor
    image_px: int
    views: Views


class Policy(Component):
    """Decides how the set of points changes. It reads the points and a step, and writes only its own statistics."""

    def watch(self, points: Points, step: Step) -> None:  # noqa: B027 (not every policy keeps statistics)
        """Accumulate statistics in `points.stat(...)`. Called after every step."""

    @abstractmethod
    def edit(self, points: Points, step: Step) -> Edit | None:
        """The change wanted now, or None. Called after `watch`; changes nothing itself."""


class Densify(Policy):
    """A policy that adds points where detail is missing."""


class Prune(Policy):
    """A policy that removes points."""


class Filter(Component):
    """A condition that a point must meet to multiply."""

    @abstractmethod
    def admits(self, scales: Tensor) -> Tensor:
        """(N,) bool from (N, 2 or 3) activated scales, local units."""


class Signal(Component):
    """Which gradient drives densification."""

    terms: tuple[str, ...] | None
    """Losses, by name, whose gradient is wanted apart; None when only the total is needed."""

    @abstractmethod
    def combine(self, chosen: Tensor, total: Tensor) -> Tensor:
        """One (N, 2) gradient from the (N, 2) ones of the chosen losses and of all; both are 0 for unseen points."""
