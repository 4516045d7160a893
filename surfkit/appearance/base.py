"""What an appearance model is."""

from __future__ import annotations

from abc import abstractmethod

from torch import Tensor

from surfkit.core.registry import Component
from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns


class Appearance(Component):
    """Turns the colours of the scene into those of one photograph, with a few numbers learned per photograph."""

    def refuse_unfit(self, primitive: Primitive) -> None:  # noqa: B027 (some fit all)
        """BadInput if the colours of this primitive cannot be changed by it; asked before anything is trained."""

    @abstractmethod
    def begin(self, count: int) -> Tensor:
        """(V, ...) numbers of `count` photographs, with which nothing changes."""

    @abstractmethod
    def rate_at(self, index: int, steps: int) -> float:
        """The learning rate in step `index` of 1..`steps`."""

    @abstractmethod
    def __call__(self, numbers: Tensor, color: Tensor) -> Tensor:
        """(3, H, W) colours as the photograph shows them, from its own numbers; differentiable in both."""

    @abstractmethod
    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """Raw parameters of the points whose colours are those of the mean photograph."""
