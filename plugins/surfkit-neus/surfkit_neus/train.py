"""The optimisation of the fields, from where an interrupted one has stopped."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import reduce
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from surfkit.core.memory import peak_memory_bytes
from surfkit.plugin import Fault, MethodInput, StageBegan, StepDone, emit, graceful
from surfkit_neus.batches import Batches
from surfkit_neus.box import SceneBox
from surfkit_neus.render import draw_rays
from surfkit_neus.state import State

if TYPE_CHECKING:
    from surfkit_neus.method import NeuralSurface

CHECKPOINT = "state.safetensors"


def train(method: NeuralSurface, given: MethodInput, box: SceneBox) -> State:
    """The fields after the last step; no step is made where the folder has them.

    Raises:
        BadInput: The checkpoint in the folder cannot be used, or a photograph.
        Fault: The losses are NaN or Inf.
        KeyboardInterrupt: The run was asked to stop; the state is saved.
    """
    path = given.folder / CHECKPOINT
    state = method.begin(box, given.seed, given.device)
    if path.exists():
        state.read(path)
    if state.index >= method.steps:
        return state
    batches = Batches(given, box, method.rays, method.photos)
    emit(StageBegan("field", method.steps, 0, first=state.index + 1))
    with graceful() as request:
        while state.index < method.steps:
            losses = make_step(method, state, batches)
            last = state.index == method.steps or request.asked
            if last or (given.checkpoint_every and state.index % given.checkpoint_every == 0):
                state.write(path)
            emit(StepDone(state.index, method.steps, losses, 0, peak_memory_bytes()))
            if request.asked:
                raise KeyboardInterrupt
    return state


def make_step(method: NeuralSurface, state: State, batches: Batches) -> dict[str, float]:
    """Make one optimisation step, and return its weighted losses."""
    return descend(method, state, batch_losses(method, state, batches))


def batch_losses(method: NeuralSurface, state: State, batches: Batches) -> dict[str, Tensor]:
    """Weighted losses of the batch of the next step."""
    index = state.index + 1
    draw = batches.draw(index)
    batch = batches(draw)
    drawn = draw_rays(state.field, state.background, batch.rays, method.samples, method.look(index), draw)
    return method.losses(state.field, drawn, batch, index)


def descend(method: NeuralSurface, state: State, losses: Mapping[str, Tensor]) -> dict[str, float]:
    """Make the next optimisation step by the sum of losses, and return them.

    Raises:
        Fault: They are NaN or Inf.
    """
    index = state.index + 1
    told = {name: float(value.detach()) for name, value in losses.items()}
    if not math.isfinite(sum(told.values())):
        raise Fault(
            f"step {index}: the losses are NaN or Inf ({told}); the last checkpoint is kept. Lower method.rate and "
            "method.grid-rate, and train in a new folder"
        )
    reduce(torch.add, losses.values()).backward()
    state.descend(method.rates(index, list(state.moments)), method.decay)
    return told
