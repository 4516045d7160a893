"""What a stage learns of the appearance of each photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce

import torch
from torch import Tensor

from surfkit.appearance.base import Appearance, Looks, Shown
from surfkit.losses.base import Target
from surfkit.primitives.points import Columns
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.train.adam import update
from surfkit.train.stage import Stage
from surfkit.train.state import StageState


def fresh_appearances(model: Appearance, views: Sequence[View]) -> Columns:
    """The numbers of photographs, a row each: "value", Adam's "first" and "second", "shown" so often.

    Where the model has numbers of cameras, "cameras" has them, a row each, in the order of their first photographs, and
    "taken_by" the row of each photograph there.
    """
    value = model.begin(len(views))
    moments = {name: torch.zeros_like(value) for name in ("first", "second")}
    table = {"value": value, **moments, "shown": torch.zeros(len(views), dtype=torch.int64)}
    rows = {name: row for row, name in enumerate(dict.fromkeys(view.taken_by for view in views))}
    cameras = model.begin_cameras(len(rows))
    if not cameras.numel():
        return table
    return table | {"cameras": cameras, "taken_by": torch.tensor([rows[view.taken_by] for view in views])}


@dataclass
class ImageAppearance:
    """One photograph's own numbers in one step.

    Attributes:
        model: What they mean.
        table: The numbers of all photographs (`fresh_appearances`).
        row: The photograph's.
        camera: That took it.
        rate: The learning rate now.
        numbers: The photograph's, with which gradients can be taken.
        grad: The gradient by them; None before `backward`, and where no loss looks at colours.
    """

    model: Appearance
    table: Columns
    row: int
    camera: Camera
    rate: float
    numbers: Tensor = field(init=False)
    grad: Tensor | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.numbers = self.table["value"][self.row].clone().requires_grad_()

    @classmethod
    def of_step(cls, stage: Stage, state: StageState, at: int, camera: Camera) -> ImageAppearance | None:
        """That of photograph `at` in the coming step; None if the stage learns none."""
        if stage.appearance is None:
            return None
        rate = stage.appearance.rate_at(state.index + 1, stage.steps) / 2**state.halvings
        return cls(stage.appearance, state.appearances, at, camera, rate)

    @property
    def looks(self) -> Looks:
        """The numbers of all photographs and cameras."""
        count = len(self.table["value"])
        alike = self.model.begin_cameras(1), torch.zeros(count, dtype=torch.int64)  # of models without cameras
        return Looks(self.table["value"], self.table.get("cameras", alike[0]), self.table.get("taken_by", alike[1]))

    def shown(self, color: Tensor) -> Tensor:
        """(3, H, W) the render as the photograph would show it."""
        looks = self.looks
        of_camera = looks.cameras[int(looks.taken_by[self.row])]
        return self.model(self.numbers.to(color), color, of_camera.to(color), self.camera)

    def backward(self, losses: list[Tensor]) -> None:
        """Find the gradient of the sum of losses, scalars whose graph stays."""
        if losses:
            self.grad = torch.autograd.grad(
                reduce(torch.add, losses), self.numbers, retain_graph=True, allow_unused=True
            )[0]

    @torch.no_grad()
    def learn(self, color: Tensor, target: Target) -> None:
        """Learn from the render (3, H, W), in the colours of the scene, beside its photograph: by the model's own rule,
        or by this photograph's next step of Adam, if there is a gradient."""
        shown = Shown(self.row, self.camera, color, target.photo, target.mask)
        if (found := self.model.fitted(self.looks, shown, self.rate)) is not None:
            self.table["value"].copy_(found.photos)
            self.table["cameras"].copy_(found.cameras)
        elif self.grad is None:
            return
        else:
            value, first, second = (self.table[name][self.row] for name in ("value", "first", "second"))
            update(value, self.grad, first, second, self.rate, int(self.table["shown"][self.row]) + 1)
        self.table["shown"][self.row] += 1
