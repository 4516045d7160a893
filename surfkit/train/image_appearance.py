"""What a stage learns of the appearance of each photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from surfkit.appearance.base import Appearance, PhotoLight, joined
from surfkit.core.check import BadInput, expect
from surfkit.core.registry import class_path
from surfkit.losses.base import Target
from surfkit.primitives.points import Columns
from surfkit.scene.camera import Camera
from surfkit.train.adam import update
from surfkit.train.stage import Stage
from surfkit.train.state import StageState


def first_appearances(model: Appearance, count: int, light: PhotoLight | None) -> Columns:
    """The table of `count` photographs, a row each: "value", Adam's "first" and "second", "shown" so often. Where all
    share some numbers, (S,), also "shared" with "shared_first" and "shared_second". It is empty where the model needs
    to know their light and there is none: their colours stay as they are."""
    if light is None and model.needs_light:
        return {}
    value, shared = model.begin(count) if light is None else model.begin_with(light), model.begin_shared()
    if not isinstance(value, Tensor) or len(value) != count:
        came = f"{len(value)} rows" if isinstance(value, Tensor) else type(value).__name__
        name = f"{class_path(type(model))}.begin"
        raise BadInput(f"{name}: expected a tensor of {count} rows, one for each photograph, got {came}")
    table = {"value": value, "first": torch.zeros_like(value), "second": torch.zeros_like(value)}
    if len(shared):
        moments = {f"shared_{name}": torch.zeros_like(shared) for name in ("first", "second")}
        table |= {"shared": shared, **moments}
    return table | {"shown": torch.zeros(count, dtype=torch.int64)}


@dataclass
class ImageAppearance:
    """One photograph's own numbers in one step, and those that it shares with all others.

    Attributes:
        model: What they mean.
        table: The numbers of all photographs (`first_appearances`).
        row: The photograph's.
        rate: The learning rate now.
        camera: That took it.
        leaves: The photograph's numbers and, if there are any, the shared ones, by which gradients can be taken.
        grads: The gradients by them; None where no loss looks at colours that they change.
    """

    model: Appearance
    table: Columns
    row: int
    rate: float
    camera: Camera
    leaves: list[Tensor] = field(init=False)
    grads: list[Tensor | None] = field(init=False)

    def __post_init__(self) -> None:
        found = [self.table["value"][self.row], *([self.table["shared"]] if "shared" in self.table else [])]
        self.leaves = [value.clone().requires_grad_() for value in found]
        self.grads = [None] * len(found)

    @classmethod
    def of_step(cls, stage: Stage, state: StageState, at: int, camera: Camera) -> ImageAppearance | None:
        """That of photograph `at` in the coming step; None if the stage learns none."""
        if stage.appearance is None or not state.appearances:
            return None
        rate = stage.appearance.rate_at(state.index + 1, stage.steps) / 2**state.halvings
        return cls(stage.appearance, state.appearances, at, rate, camera)

    def of_scene(self, photo: Tensor) -> tuple[Tensor, Tensor] | None:
        """See `Appearance.of_scene`; `photo` is (3, H, W). None where numbers are learned: this way teaches none."""
        if self.rate > 0 or len(self.leaves) > 1:
            return None
        found = self.model.of_scene(self.leaves[0].detach().to(photo), photo, self.camera)
        if found is not None:
            expect(f"{class_path(type(self.model))}.of_scene", found[0], tuple(photo.shape))
        return found

    def shown(self, color: Tensor) -> Tensor:
        """(3, H, W) the render as the photograph would show it."""
        own, *shared = (leaf.to(color) for leaf in self.leaves)
        found = self.model(joined(own, *shared) if shared else own, color, self.camera)
        expect(f"{class_path(type(self.model))}", found, tuple(color.shape))
        return found

    def add(self, grads: Sequence[Tensor | None]) -> None:
        """Add gradients of some of the losses by `leaves`: of the photograph's numbers, (...), and the shared (S,)."""
        both = zip(self.grads, grads, strict=True)
        self.grads = [b if a is None else a if b is None else a + b for a, b in both]

    def learn(self) -> None:
        """Take the next step of Adam, this photograph's and that of the shared numbers, if there is a gradient."""
        own, *shared = self.grads
        if own is None:
            return
        shown = self.table["shown"]
        shown[self.row] += 1
        value, first, second = (self.table[name][self.row] for name in ("value", "first", "second"))
        update(value, own, first, second, self.rate, int(shown[self.row]))
        for grad in shared:
            assert grad is not None, "what changes colours by a photograph's numbers does so by the shared ones"
            value, first, second = (self.table[name] for name in ("shared", "shared_first", "shared_second"))
            update(value, grad, first, second, self.rate, int(shown.sum()))


@torch.no_grad()
def in_light(
    stage: Stage, state: StageState, at: int, target: Target, color: Tensor
) -> tuple[Target, ImageAppearance | None]:
    """The target of photograph `at` in the coming step, and what turns the render, (3, H, W), into its colours; where
    the model knows the way back, the target is in the light of the scene, and nothing is to be turned."""
    appearance = ImageAppearance.of_step(stage, state, at, target.view.camera)
    found = None if appearance is None else appearance.of_scene(target.photo)
    if found is None:
        return target, appearance
    photo, least = found
    return replace(target, photo=torch.where(least & (color > photo), color, photo)), None
