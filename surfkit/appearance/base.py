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
class Looks:
    """What an appearance model knows of photographs.

    Attributes:
        photos: (V, ...) numbers of each photograph.
        cameras: (C, ...) numbers of each camera that took some of them.
        taken_by: (V,) int64, the row of `cameras` of each photograph; on the CPU.
    """

    photos: Tensor
    cameras: Tensor
    taken_by: Tensor


@dataclass(frozen=True)
class Shown:
    """A photograph beside its render.

    Attributes:
        at: Its row in `Looks`.
        camera: The pinhole camera of both; positions on the sensor are counted from its principal point.
        color: (3, H, W) render, in the colours of the scene; constant.
        photo: (3, H, W) photograph in [0, 1].
        mask: (H, W) bool, False where the photograph is to be ignored; None where all of it counts.
    """

    at: int
    camera: Camera
    color: Tensor
    photo: Tensor
    mask: Tensor | None = None


class Appearance(Component):
    """Turns the colours of the scene into those of one photograph, with a few numbers learned per photograph and, if the
    model has such, per camera.

    One that `is_centred` keeps the scene in the colours of the mean photograph all along: what one stage has learned
    then holds in the next, and blocks of a scene learn alike.
    """

    is_centred: ClassVar[bool] = False

    def refuse_unfit(self, primitive: Primitive) -> None:  # noqa: B027 (some fit all)
        """BadInput if the colours of this primitive cannot be changed by it; asked before anything is trained."""

    @abstractmethod
    def begin(self, count: int) -> Tensor:
        """(V, ...) numbers of `count` photographs, with which nothing changes."""

    def begin_cameras(self, count: int) -> Tensor:
        """(C, ...) numbers of `count` cameras, with which nothing changes; none by default. Only `fitted` learns them."""
        return torch.zeros(count, 0)

    @abstractmethod
    def rate_at(self, index: int, steps: int) -> float:
        """The learning rate in step `index` of 1..`steps`."""

    @abstractmethod
    def __call__(self, numbers: Tensor, color: Tensor, of_camera: Tensor, camera: Camera) -> Tensor:
        """(3, H, W) colours as the photograph shows them.

        Args:
            numbers: Of the photograph. The result is differentiable in them, unless `fitted` finds them.
            color: (3, H, W) of the scene; the result is differentiable in them.
            of_camera: Numbers of the camera that took it.
            camera: That camera: which pixel lies where.
        """

    def fitted(self, looks: Looks, shown: Shown, rate: float) -> Looks | None:
        """The numbers after a look at a photograph, by a rule of the model's own; None, the default, if the numbers of
        photographs are learned by Adam from the gradients of the losses."""
        return None

    @abstractmethod
    def folded(self, numbers: Tensor, params: Columns) -> Columns:
        """Raw parameters of the points whose colours are those of the mean photograph."""
