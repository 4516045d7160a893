"""What the policies that add and remove points are told of a step, and what they ask for together."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect, read_only
from surfkit.core.registry import class_path
from surfkit.densify.base import ComparedView, Policy, Signal, Step, ViewStatistics
from surfkit.losses.base import ignoring
from surfkit.primitives.edit import Edit, merge, sound, withheld
from surfkit.primitives.init import SH_C0
from surfkit.primitives.points import Points
from surfkit.raster.api import Gradients, Maps, Splats
from surfkit.scene.camera import Camera
from surfkit.train.divide import own_rows, wanted_of_all
from surfkit.train.in_view import shown_points
from surfkit.train.setup import StageSetup
from surfkit.train.state import StageState
from surfkit.train.step_result import StepResult
from surfkit.train.view_order import ViewContributions


def told(setup: StageSetup, state: StageState, result: StepResult) -> Step:
    """What the policies are told about a step, and nothing about frozen points."""
    stage, index, gradients, in_view = setup.stage, state.index + 1, result.gradients, result.in_view
    camera, points, home = result.target.view.camera, len(state.points), state.points.device
    combined = combined_signal(setup, gradients, index == 1)
    signed_norm = lengths(gradients.signal).to(home)
    shown = ViewStatistics(
        rows=None if in_view is None else in_view.rows,
        seen=result.seen.to(home),
        grad_norm=signed_norm if combined is gradients.signal else lengths(combined).to(home),
        radii=result.radii.to(home),
        signed_norm=signed_norm,
    )

    @cache
    def drawn() -> Splats:
        return result.splats if in_view is None else all_splats(setup, state)

    def of_all(name: str) -> Callable[[], Tensor]:
        return lambda: getattr(shown, name) if in_view is None else in_view.among_all(getattr(shown, name))

    def of_view(camera: Camera) -> tuple[Tensor, Splats]:
        return shown_points(setup, state, camera, 0)

    return Step(
        index=index,
        steps=stage.steps,
        seen=of_all("seen"),
        splats=lambda: drawn().first(points),
        grad_norm=of_all("grad_norm"),
        radii=of_all("radii"),
        image_px=max(camera.width, camera.height),
        views=ViewContributions(
            setup.views, setup.draws, drawn, stage.near, points, of_view=None if in_view is None else of_view
        ),
        since_reset=index - state.reset_at,
        rates=rates_at(setup, state),
        seed=state.seed,
        owns=setup.owns,
        signed_norm=of_all("signed_norm"),
        derived=gradients.derived and gradients.derived.combined(stage.signal.combine),
        in_view=None if in_view is None else shown,
        view=lambda: compared_view(setup, state, result),
    )


def compared_view(setup: StageSetup, state: StageState, result: StepResult) -> ComparedView:
    """The view of a step with its photograph, and the way from values of its pixels back to the points.

    The sum of e w over the pixels is the gradient of that of e C by the colour of a point. It is taken of grey points:
    where a colour is held at 0, no gradient would come back.
    """
    target, appearance = result.target, result.appearance
    with torch.no_grad():
        color = result.maps.need("color")
        color = color if appearance is None else appearance.shown(color)
        photo = ignoring(Maps(color=color), target)[1].photo

    def blended(values: Tensor) -> Tensor:
        if target.mask is not None:
            values = values * target.mask
        count, camera, splats = len(result.shape), target.view.camera, result.splats
        grey = splats.with_colors(torch.zeros_like(splats.sh0))
        render = setup.rasterizer.render(grey, camera, setup.stage.near, geometry=False, distortion=False)
        cotangent = torch.zeros_like(color)
        cotangent[0] = values
        by_color = render.backward(Maps(color=cotangent), rows=count).sh0[:, 0, 0] / SH_C0
        return by_color.to(state.points.device)

    return ComparedView(color, photo, blended)


def combined_signal(setup: StageSetup, gradients: Gradients, is_first: bool) -> Tensor:
    """(N, 2) what drives densification, of the chosen losses and of all; in the first step its values are looked at,
    for which a GPU must be waited."""
    signal, processes, total = setup.stage.signal, setup.processes, gradients.signal
    chosen = total if gradients.chosen is None else gradients.chosen
    if processes is None or signal.terms is None:
        return _fitting(signal, signal.combine(chosen, total), total, is_first)
    rows = own_rows(processes, len(total))
    chosen, total = torch.split(processes.gathered(torch.cat([chosen, total], 1)), 2, 1)
    return _fitting(signal, signal.combine(chosen, total), total, is_first)[rows]


def _fitting(signal: Signal, combined: Tensor, total: Tensor, is_first: bool) -> Tensor:
    """(N, 2) what a signal gives; BadInput if it has another shape, or in the first step makes NaN of what is finite:
    no point would be added, without a word."""
    name = f"{class_path(type(signal))}.combine"
    expect(name, combined, tuple(total.shape))
    if is_first and not combined.sum().isfinite() and total.sum().isfinite():
        raise BadInput(f"{name}: NaN or Inf, of gradients that are finite; give finite values")
    return combined


def rates_at(setup: StageSetup, state: StageState) -> dict[str, float]:
    """The learning rate of each parameter in the coming step."""
    at = state.index + 1, setup.stage.steps
    return {name: rate.at(*at) / 2**state.halvings for name, rate in setup.rates.items()}


@torch.no_grad()
def all_splats(setup: StageSetup, state: StageState) -> Splats:
    """All N splats, detached, in the colours of degree 0."""
    return setup.primitive.activate(state.points.params, 0)


def wanted(setup: StageSetup, state: StageState, step: Step) -> Edit | None:
    """What the policies ask for together, of what is allowed; of the points of all processes."""
    policies, points = setup.stage.policies, state.points
    if setup.processes is not None:
        return wanted_of_all(setup.processes, policies, points, step)
    for policy in policies:
        with read_only(f"{class_path(type(policy))}.watch", points.params):
            policy.watch(points, step)
    edit = merge([_asked(policy, points, step) for policy in policies])
    return edit if edit is None or step.owns is None else withheld(edit, step.may_be_densified())


def _asked(policy: Policy, points: Points, step: Step) -> Edit | None:
    """What one policy asks for."""
    with read_only(f"{class_path(type(policy))}.edit", points.params):
        edit = policy.edit(points, step)
    return sound(edit, len(points), policy, points.params)


def lengths(vectors: Tensor) -> Tensor:
    """(N,) lengths of (N, 2) vectors; torch's norm takes three times as long along so short an axis."""
    return (vectors[:, 0] ** 2 + vectors[:, 1] ** 2).sqrt()
