"""What a stage learns of the appearance of each photograph."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from surfkit.appearance.base import Appearance
from surfkit.primitives.points import Columns
from surfkit.train.adam import update


def fresh_appearances(model: Appearance, count: int) -> Columns:
    """The numbers of `count` photographs, a row each: "value", Adam's "first" and "second", "shown" so often."""
    value = model.begin(count)
    moments = {name: torch.zeros_like(value) for name in ("first", "second")}
    return {"value": value, **moments, "shown": torch.zeros(count, dtype=torch.int64)}


@dataclass
class ImageAppearance:
    """One photograph's own numbers in one step.

    Attributes:
        model: What they mean.
        table: The numbers of all photographs (`fresh_appearances`).
        row: The photograph's.
        rate: The learning rate now.
        numbers: The photograph's, with which gradients can be taken.
    """

    model: Appearance
    table: Columns
    row: int
    rate: float
    numbers: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.numbers = self.table["value"][self.row].clone().requires_grad_()

    def shown(self, color: Tensor) -> Tensor:
        """(3, H, W) the render as the photograph would show it."""
        return self.model(self.numbers.to(color), color)

    def gradient(self, losses: list[Tensor]) -> Tensor | None:
        """That of the sum of losses, whose graph stays; None if none of them looks at colours."""
        if not losses:
            return None
        return torch.autograd.grad(sum(losses), self.numbers, retain_graph=True, allow_unused=True)[0]

    def learn(self, grad: Tensor | None) -> None:
        """Take this photograph's next step of Adam, if there is a gradient."""
        if grad is None:
            return
        self.table["shown"][self.row] += 1
        value, first, second = (self.table[name][self.row] for name in ("value", "first", "second"))
        update(value, grad, first, second, self.rate, int(self.table["shown"][self.row]))
