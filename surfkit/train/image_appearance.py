"""What a stage learns of the appearance of each photograph."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import reduce

import torch
from torch import Tensor

from surfkit.appearance.base import Appearance, PhotoLight
from surfkit.primitives.points import Columns
from surfkit.scene.camera import Camera
from surfkit.train.adam import update
from surfkit.train.stage import Stage
from surfkit.train.state import StageState


def first_appearances(model: Appearance, count: int, light: PhotoLight | None) -> Columns:
    """The table of `count` photographs, a row each: "value", Adam's "first" and "second", "shown" so often. It is empty
    where the model needs to know their light and there is none: their colours stay as they are."""
    if light is None and model.needs_light:
        return {}
    value = model.begin(count) if light is None else model.begin_with(light)
    moments = {name: torch.zeros_like(value) for name in ("first", "second")}
    return {"value": value, **moments, "shown": torch.zeros(len(value), dtype=torch.int64)}


@dataclass
class ImageAppearance:
    """One photograph's own numbers in one step.

    Attributes:
        model: What they mean.
        table: The numbers of all photographs (`first_appearances`).
        row: The photograph's.
        rate: The learning rate now.
        camera: That took it.
        numbers: The photograph's, with which gradients can be taken.
        grad: The gradient by them; None before `backward`, and where no loss looks at colours.
    """

    model: Appearance
    table: Columns
    row: int
    rate: float
    camera: Camera
    numbers: Tensor = field(init=False)
    grad: Tensor | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.numbers = self.table["value"][self.row].clone().requires_grad_()

    @classmethod
    def of_step(cls, stage: Stage, state: StageState, at: int, camera: Camera) -> ImageAppearance | None:
        """That of photograph `at` in the coming step; None if the stage learns none."""
        if stage.appearance is None or not state.appearances:
            return None
        rate = stage.appearance.rate_at(state.index + 1, stage.steps) / 2**state.halvings
        return cls(stage.appearance, state.appearances, at, rate, camera)

    def shown(self, color: Tensor) -> Tensor:
        """(3, H, W) the render as the photograph would show it."""
        return self.model(self.numbers.to(color), color, self.camera)

    def backward(self, losses: list[Tensor]) -> None:
        """Find the gradient of the sum of losses, scalars whose graph stays."""
        if losses:
            self.grad = torch.autograd.grad(
                reduce(torch.add, losses), self.numbers, retain_graph=True, allow_unused=True
            )[0]

    def learn(self) -> None:
        """Take this photograph's next step of Adam, if there is a gradient."""
        if self.grad is None:
            return
        self.table["shown"][self.row] += 1
        value, first, second = (self.table[name][self.row] for name in ("value", "first", "second"))
        update(value, self.grad, first, second, self.rate, int(self.table["shown"][self.row]))
