"""One optimisation step, from top to bottom: render, losses, backward, update, densify.

`Trainer.step` calls the three functions in this order. The first and the last can be repeated where the memory of a GPU
gives out (`retry_on_oom`): until they return, they change nothing but the order of views and random numbers.
"""

from __future__ import annotations

from dataclasses import replace

from surfkit.core.check import BadInput
from surfkit.core.events import PointsEdited, emit
from surfkit.losses.base import RegularizerInput
from surfkit.primitives.drawing import refuse_wrong_maps
from surfkit.primitives.edit import Edit, fitted, observe
from surfkit.train.divide import edited, refuse_apart
from surfkit.train.faults import require_finite_gradients, require_finite_losses, require_finite_values
from surfkit.train.image_appearance import in_light
from surfkit.train.in_view import PointsInView, note_moved, with_frozen
from surfkit.train.loss_gradients import (
    as_numbers,
    loss_gradients,
    pulled,
    regularizer_terms,
    terms_with_maps,
    without_transients,
)
from surfkit.train.next_view import neighbour, next_target
from surfkit.train.optimizer import OptimizerInput
from surfkit.train.point_blocks import spatial_order
from surfkit.train.policies import rates_at, told, wanted
from surfkit.train.required_maps import GEOMETRY_MAPS, maps_of_step
from surfkit.train.setup import StageSetup
from surfkit.train.state import StageState
from surfkit.train.step_result import StepResult


def view_gradients(setup: StageSetup, state: StageState) -> StepResult:
    """Render the next view, compare it with its photograph, and go back to the splats."""
    stage, index = setup.stage, state.index + 1
    at, target = next_target(setup, state)
    if setup.processes is not None:
        refuse_apart(setup.processes, at, state.skipped)
    camera, reads = target.view.camera, maps_of_step(setup, index)

    # Render: raw parameters become splats, and these the maps that the terms of this step read.
    in_view = PointsInView.of_step(setup, state, camera)
    params = state.points.all_params() if in_view is None else in_view.of_columns(state.points.params)
    where = setup.rasterizer.where()
    leaves = {name: value.detach().to(where).requires_grad_() for name, value in params.items()}
    shape = setup.primitive.activate(leaves, state.sh_degree)
    splats = with_frozen(setup, state, shape, state.sh_degree, None if in_view is None else camera)
    render = setup.draws.render(splats, camera, stage.near, bool(reads.keys() & GEOMETRY_MAPS), "distortion" in reads)
    refuse_wrong_maps(setup.primitive, render.maps, camera, reads)
    setup.uploads.ahead(state.order, state.skipped)  # the next view is read while the GPU works on this one

    # Losses: the maps are compared with the photograph, and with a second view where a loss wants one.
    second = neighbour(setup, state, splats, at, render.maps) if stage.is_paired(index) else None
    target, appearance = in_light(stage, state, at, target, render.maps.need("color"))
    target = without_transients(stage, index, render.maps, target, appearance)
    compared = stage.weights_at(index), render.maps, replace(target, neighbour=second), appearance
    losses, total, chosen = loss_gradients(stage.losses, stage.signal, *compared)
    count = len(shape)
    given = RegularizerInput(index, stage.steps, target, render.maps, render.seen[:count], state.points.stat, leaves)
    terms, total = terms_with_maps(stage.regularizers, shape, given, total)

    # Backward: from the maps to the splats; the gradient that drives densification comes beside that of all losses.
    gradients = render.backward(total, chosen, stage.signal.absolute, count)
    drawn = render.maps, render.seen[:count], render.radii[:count]
    kept = render if stage.optimizer.pulls else None
    return StepResult(target, in_view, leaves, shape, splats, *drawn, losses, gradients, appearance, kept, given, terms)


def update(setup: StageSetup, state: StageState, result: StepResult) -> Edit | None:
    """Move the points, and tell which ones the policies, which see them as drawn, would have more or fewer of."""
    stage, index, view, in_view = setup.stage, state.index + 1, result.target.view.name, result.in_view
    state.whole = False  # until the step is done

    # Update: terms on the points join the gradients on their way to the raw parameters, which the optimizer changes.
    terms = regularizer_terms(stage.regularizers, result.shape, result.given, result.terms)
    result.losses.update(as_numbers(terms))
    require_finite_losses(index, view, result.losses)
    edit = wanted(setup, state, told(setup, state, result)) if stage.policies else None
    grads = pulled(result.shape, result.gradients, result.leaves, list(terms.values()), stage.optimizer.pulls)
    if in_view is not None:
        require_finite_gradients(index, view, grads)
    if result.appearance is not None:
        result.appearance.learn()
    about = index, stage.steps, rates_at(setup, state), result.rows, state.seed, result.pull
    drawn = result.target, result.maps, result.shape.detached()
    grads = {name: grad.to(state.points.device) for name, grad in grads.items()}
    stage.optimizer.step(state.points, grads, OptimizerInput(*about, *drawn))
    if in_view is None:
        require_finite_values(index, view, state.points.all_params())
    else:
        note_moved(setup, state, in_view)
    state.points = fitted(setup.primitive, state.points)
    return edit


def densify(setup: StageSetup, state: StageState, edit: Edit) -> None:
    """Drop, clone and split points, together with their moments and statistics."""
    index, order = state.index + 1, spatial_order if setup.stage.optimizer.in_view else None

    # Densify: all that the policies ask for is done at once.
    points, state.blocks = state.points.to_rearrange(), None  # which hold the columns
    points = edited(setup.processes, setup.primitive, points, edit, state.generator, order)
    if setup.count(points) == 0:
        raise BadInput(f"step {index} would drop every point; lower the culls of densify and the ratios of prune")
    state.points = observe(setup.primitive, points, setup.views, setup.stage.near)
    if edit.max_opacity is not None:
        state.reset_at = index
    if any(counts := edit.counts):
        emit(PointsEdited(index, *counts, points=setup.count(state.points)))
