"""The loop over the steps of a stage."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.appearance.base import PhotoLight
from surfkit.core.events import StepDone, emit
from surfkit.core.memory import peak_memory_bytes
from surfkit.losses.base import Target
from surfkit.primitives.base import refuse_other_params
from surfkit.primitives.edit import OBSERVED_EVERY, observe
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Maps
from surfkit.raster.nvrtc.gpu_memory import peak_gpu_bytes
from surfkit.train.image_appearance import ImageAppearance, first_appearances
from surfkit.train.next_view import foretell
from surfkit.train.retry_on_oom import retry_on_oom
from surfkit.train.setup import StageSetup
from surfkit.train.state import StageState
from surfkit.train.step import densify, update, view_gradients
from surfkit.train.view_order import ViewOrder
from surfkit.train.watch import Stopwatch


@dataclass(frozen=True)
class CompletedStep:
    """One step, for those who watch.

    Attributes:
        index: Of the step, from 1 on.
        losses: Weighted value of each loss.
        points: How many there are after it.
        maps: The view as drawn, in the colours of the scene.
        target: The view and its photograph.
        appearance: What turns those colours into the photograph's, if the stage has any.
    """

    index: int
    losses: dict[str, float]
    points: int
    maps: Maps
    target: Target
    appearance: ImageAppearance | None = None

    @torch.no_grad()
    def shown(self) -> Tensor:
        """(3, H, W) the render as the photograph would show it, which losses compare with the photograph."""
        color = self.maps.need("color")
        return color if self.appearance is None else self.appearance.shown(color)


@dataclass(frozen=True)
class Trainer(StageSetup):
    """Takes the steps of a stage."""

    def begin(
        self,
        points: Points,
        generator: torch.Generator,
        frozen: Columns | None = None,
        light: PhotoLight | None = None,
    ) -> StageState:
        """The state before the first step.

        Args:
            points: To begin with.
            generator: That of the stage.
            frozen: As in `StageState`.
            light: That of the photographs, where the appearance needs it; None changes no colour.
        """
        refuse_other_params(self.primitive, points.all_params())
        points = points.with_moments(self.stage.optimizer.moment_type())
        state = StageState(points, ViewOrder(len(self.views)), generator, frozen=frozen or {})
        if (model := self.stage.appearance) is not None:
            state.appearances = first_appearances(model, len(self.views), light)
        state.move(self.rasterizer.where(), self.home)
        return state

    def run(self, state: StageState, clock: Stopwatch | None = None) -> Iterator[CompletedStep]:
        """Take the steps that are left; after each one, `state` can be saved, and the caller may stop.

        The points of `state` are moved to where they are kept (`home`). The caller may stop the `clock` of the state.
        """
        clock = clock or Stopwatch(state)
        state.move(self.rasterizer.where(), self.home)
        foretell(self, state.order)
        while state.index < self.stage.steps:
            done = self.step(state)
            clock.lap()
            held = peak_memory_bytes(), peak_gpu_bytes()
            emit(StepDone(done.index, self.stage.steps, done.losses, done.points, *held))
            yield done

    def step(self, state: StageState) -> CompletedStep:
        """Take one step (`train.step`). Where the memory of a GPU gives out, what can be repeated is."""
        index = state.index + 1
        if state.index % OBSERVED_EVERY == 0:
            state.points = observe(self.primitive, state.points, self.views, self.stage.near)
        state.sh_degree = max(state.sh_degree, min(self.primitive.sh_degree, index // self.stage.sh_every))
        result = retry_on_oom(state, self.uploads, lambda: view_gradients(self, state))
        edit = update(self, state, result)
        losses, maps, target, appearance = result.losses, result.maps, result.target, result.appearance
        del result  # what else it holds is of no use in an edit, which takes memory of its own
        if edit is not None:
            retry_on_oom(state, self.uploads, lambda: densify(self, state, edit))
        state.index, state.whole = index, True
        return CompletedStep(index, losses, self.count(state.points), maps, target, appearance)
