"""What an appearance model is."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.core.registry import Component
from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns
from surfkit.scene.camera import Camera


@dataclass(frozen=True)
class PhotoLight:
    """How cameras changed the light of V photographs, from the colours of sparse points; `scene.response` says
    what the numbers mean.

    Attributes:
        stops: (V, 3) float32 of red, green and blue. Less the falloff, averaged over the picture, they have a mean of
            0 over the photographs of the scene.
        cameras: (V, 8) float32 vignetting and response curve of the camera that took each.
    """

    stops: Tensor
    cameras: Tensor


class Appearance(Component):
    """Turns the colours of the scene into those of one photograph, with a few numbers per photograph.

    The numbers are learned, or known before training begins: those of a model that `needs_light` begin with what is
    found from the sparse points (`begin_with`), alike in all stages and blocks of a scene. The data set must then tell
    which photographs show which points.

    There may also be numbers that all photographs share, such as the weights of a network (`begin_shared`). They are
    learned in every step, at the same rate.

    Losses `of_structure` see the colours of the scene as they are, if the model `spares_structure`: what differs from
    photograph to photograph is then left to the other losses.
    """

    needs_light: ClassVar[bool] = False
    spares_structure: ClassVar[bool] = False

    @property
    def only_if_uneven(self) -> bool:
        """Whether colours stay as they are where the light of all photographs is alike; of models that `needs_light`.
        A stage then works as without any appearance."""
        return False

    def refuse_unfit(self, primitive: Primitive) -> None:  # noqa: B027 (some fit all)
        """BadInput if the colours of this primitive cannot be changed by it; asked before anything is trained."""

    @abstractmethod
    def begin(self, count: int) -> Tensor:
        """(V, ...) numbers of `count` photographs, with which nothing changes."""

    def begin_with(self, light: PhotoLight) -> Tensor:
        """(V, ...) numbers of photographs whose light is known; of models that `needs_light`."""
        raise NotImplementedError

    def begin_shared(self) -> Tensor:
        """(S,) numbers that all photographs share, the same ones at each call; none by default."""
        return torch.zeros(0)

    @abstractmethod
    def rate_at(self, index: int, steps: int) -> float:
        """The learning rate in step `index` of 1..`steps`; 0 throughout where the numbers stay as they begin."""

    @abstractmethod
    def __call__(self, numbers: Tensor, color: Tensor, camera: Camera) -> Tensor:
        """(3, H, W) colours as the photograph shows them.

        Args:
            numbers: Its own; of a model that has shared ones (E + S,), its own in one row, and then these. The result
                is differentiable in them, where they are learned.
            color: (3, H, W) of the scene. The result is differentiable in them.
            camera: That took it: which pixel lies where on the sensor.
        """

    def of_scene(self, numbers: Tensor, photo: Tensor, camera: Camera) -> tuple[Tensor, Tensor] | None:
        """The other way, from the colours of a photograph: both (3, H, W), colours of the scene, and bool where it is
        at least so bright, as white was cut off. None where the model cannot tell, as by default.

        Photographs are then compared with the scene in its own light: dark ones count as much as bright ones, beside
        each other and beside the losses of geometry. For numbers that stay as they begin.

        Args:
            numbers: As of `__call__`.
            photo: (3, H, W) in [0, 1].
            camera: That took it.
        """
        return None

    @abstractmethod
    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """Raw parameters of the points whose colours are those of the mean photograph."""


def joined(numbers: Tensor, shared: Tensor) -> Tensor:
    """What an appearance model is called with: the numbers of a photograph, (...), as they are, or, where there are
    shared ones, (E + S,).

    Args:
        numbers: (...) of the photograph, E in all.
        shared: (S,) of all photographs, may be none.
    """
    return torch.cat([numbers.flatten(), shared]) if len(shared) else numbers
