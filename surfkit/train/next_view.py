"""The views of a step: the one whose turn it is, and one beside it. Damaged ones are passed over, and named once."""

from __future__ import annotations

from dataclasses import replace

import torch

from surfkit.core.check import BadInput
from surfkit.core.events import PhotoSkipped, emit
from surfkit.losses.base import Neighbour, Target
from surfkit.raster.api import Maps, Splats
from surfkit.train.divide import refuse_apart
from surfkit.train.setup import StageSetup
from surfkit.train.smaller import smaller
from surfkit.train.state import StageState
from surfkit.train.uploads import UploadedView
from surfkit.train.view_order import ViewOrder


def foretell(setup: StageSetup, order: ViewOrder) -> None:
    """Say which views come next, so that their pictures can be read ahead."""
    if setup.expect is not None and order.at < len(order.queue):
        setup.expect(setup.uploads.missing(order.queue[order.at :].tolist()))


def next_target(setup: StageSetup, state: StageState) -> tuple[int, Target]:
    """Position and photograph of the view to show now.

    Raises:
        BadInput: None of the photographs can be read.
    """
    while len(state.skipped) < len(setup.views):
        if state.order.at == len(state.order.queue):
            state.order.shuffle(state.generator)
            foretell(setup, state.order)
        at = state.order.next(state.generator)
        if at in state.skipped or (shown := _readable(setup, state, at, setup.uploads.get(at))) is None:
            continue
        index = state.index + 1
        target = Target(setup.views[at], shown.in_floats(), shown.prior, shown.mask, seed=state.seed, index=index)
        return at, smaller(target, setup.stage.divisor_at(index))
    raise BadInput(f"none of the {len(setup.views)} photographs can be read, {setup.views[0].path} for one")


def neighbour(setup: StageSetup, state: StageState, splats: Splats, shown: int, maps: Maps) -> Neighbour | None:
    """One of the views that show best, from another side, what a view shows; None if none does.

    Which one depends on what is rendered now and on the seed and number of the step, and on nothing else, so that a run
    which goes on has the same ones.

    Args:
        setup: With all views.
        state: Before the step.
        splats: All that are drawn.
        shown: Position of the view.
        maps: What is rendered there.
    """
    found = (setup.beside or setup.selector.neighbours)(shown, maps.need("median"))
    generator = torch.Generator().manual_seed(state.seed)
    first = int(torch.randint(max(1, len(found)), (), generator=generator))
    for at in (*found[first:], *found[:first]):
        if at in state.skipped or (second := _readable(setup, state, at, setup.uploads.aside(at))) is None:
            continue
        if setup.processes is not None:
            refuse_apart(setup.processes, at, state.skipped)
        whole = Target(setup.views[at], second.in_floats(), mask=second.mask)
        other = smaller(whole, setup.stage.divisor_at(state.index + 1))
        drawn = setup.draws.render(splats, other.view.camera, setup.stage.near, True, False).maps
        shape = replace(drawn, color=None, distortion=None)
        return Neighbour(other.view, other.photo, shape, other.mask)
    return None


def _readable(setup: StageSetup, state: StageState, at: int, found: UploadedView | BadInput) -> UploadedView | None:
    """A view; None for one with a damaged photograph, which is named and not shown again."""
    if isinstance(found, UploadedView):
        return found
    state.skipped.append(at)
    emit(PhotoSkipped(setup.views[at].name, str(found)))
    return None
