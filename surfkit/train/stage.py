"""One optimisation run over a set of views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Literal

import torch
from torch import Tensor

from surfkit.appearance.base import Appearance
from surfkit.core.check import BadInput
from surfkit.core.events import PhotoSkipped, PointsEdited, StepDone, emit
from surfkit.core.memory import peak_memory_bytes
from surfkit.core.registry import choice, name_of
from surfkit.core.schedule import Interval, LearningRate
from surfkit.cuda.memory import peak_gpu_bytes
from surfkit.densify.adc import ADC
from surfkit.densify.base import Densify, Policy, Prune, Signal, Step
from surfkit.densify.signal import LossGradient
from surfkit.losses.base import Loss, Neighbour, Regularizer, RegularizerInput, Target
from surfkit.losses.photometric import L1, SSIM
from surfkit.primitives.base import Primitive
from surfkit.primitives.drawing import drawn_by, refuse_wrong_maps
from surfkit.primitives.edit import OBSERVED_EVERY, Edit, apply, fitted, merge, observe, sound, withheld
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Maps, Rasterizer, Splats
from surfkit.readers.depth_prior import DepthPrior
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.train.adam import adam_step
from surfkit.train.faults import require_finite_gradients, require_finite_losses, require_finite_values
from surfkit.train.image_appearance import ImageAppearance, fresh_appearances
from surfkit.train.in_view import InView
from surfkit.train.loss_gradients import as_numbers, loss_gradients, pulled, regularizer_terms
from surfkit.train.neighbour_selector import NeighbourSelector
from surfkit.train.reads import maps_read
from surfkit.train.retry_on_oom import retry_on_oom
from surfkit.train.state import StageState
from surfkit.train.step import StepResult
from surfkit.train.uploads import Pictures, Shown, Uploads
from surfkit.train.views import Order, ViewContributions
from surfkit.train.watch import Stopwatch

MOST_STEPS = 100_000_000
"""Of a stage: days and days of the fastest machine."""
GEOMETRY = {"depth", "median", "normal", "distortion"}
"""Maps beyond the colours."""


@dataclass(frozen=True)
class Stage:
    """One optimisation run over a set of views."""

    steps: Interval = 30_000
    """Optimisation steps; each shows one photograph."""

    losses: dict[str, Annotated[Loss, choice(Loss)]] = field(default_factory=lambda: {"l1": L1(), "ssim": SSIM()})
    """What is minimised: the weighted sum of these. losses.KEY:NAME adds or changes one, losses.KEY:none drops it."""

    regularizers: dict[str, Annotated[Regularizer, choice(Regularizer)]] = field(default_factory=dict)
    """Terms on the points themselves, added to the losses; regularizers.KEY:NAME adds one."""

    appearance: Annotated[Appearance | None, choice(Appearance, optional=True)] = None
    """What may differ from photograph to photograph; none takes all colours as they are."""

    signal: Annotated[Signal, choice(Signal)] = LossGradient()
    """Which gradient drives densification."""

    densify: Annotated[Densify | None, choice(Densify, optional=True)] = ADC()
    """Densification: how points are added; none keeps their number."""

    prune: tuple[Annotated[Prune, choice(Prune)], ...] = ()
    """Further ways to remove points; prune.0:NAME adds the first, prune.1:NAME the next, prune.0:none drops one."""

    rates: dict[str, LearningRate] = field(default_factory=dict)
    """Learning rates of the parameters that differ from those of the primitive; of positions in scene extents."""

    sh_every: Interval = 1_000
    """Steps between degrees of the spherical harmonics, from 0 up to the primitive's; a stage that goes on from a model
    begins at the model's degree."""

    near: float = 0.005
    """Nothing nearer to a camera than this is drawn, as a share of the scene extent."""

    update: Literal["all", "in-view"] = "all"
    """Points that a step updates: all, of which those out of view move on by momentum, as in 3DGS, or only those in
    view, which takes less time, the more so the larger a scene is. Stages with regularizers, steps with a second view,
    and primitives that draw themselves or have parameters that belong to no point always update all."""

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= MOST_STEPS:
            raise BadInput(f"a stage has {self.steps} steps; give 1 to {MOST_STEPS}")
        if self.sh_every < 1:
            raise BadInput(f"sh_every is {self.sh_every}; it must be 1 or more steps")
        if unknown := set(self.signal.terms or ()) - set(self.losses):
            raise BadInput(f"signal.terms names {', '.join(sorted(unknown))}; the losses are {', '.join(self.losses)}")

    def weights_at(self, index: int) -> dict[str, float]:
        """Weights of the losses that count in step `index` of 1..`steps`, by key."""
        return {name: weight for name, loss in self.losses.items() if (weight := loss.weight_at(index, self.steps)) > 0}

    def is_paired(self, index: int) -> bool:
        """Whether step `index` looks at a second view."""
        return any(self.losses[name].needs_neighbour for name in self.weights_at(index))

    @property
    def policies(self) -> tuple[Policy, ...]:
        """Everything that adds or removes points."""
        return (*([self.densify] if self.densify else []), *self.prune)

    def finished(self, state: StageState) -> Columns:
        """Raw parameters of the points as they leave the stage, in the colours of the mean photograph."""
        params = state.points.all_params()
        return params if self.appearance is None else self.appearance.folded(state.appearances["value"], params)


@dataclass(frozen=True)
class Done:
    """One step, for those who watch."""

    index: int
    losses: dict[str, float]
    points: int
    maps: Maps
    target: Target


@dataclass(frozen=True)
class Trainer:
    """A stage and all it runs on.

    Attributes:
        stage: What to do.
        primitive: What the points are.
        views: Photographs to optimise on.
        photos: Gives their pictures by position, (3, H, W) uint8.
        rasterizer: What draws.
        priors: Estimated depths by position, for losses that need them.
        masks: Which pixels count, by position, (H, W) bool or None; None if all do.
        expect: Told the positions in the order in which they will be asked for, whenever a new order begins.
        owns: (N, 3) positions to (N,) bool: points elsewhere are neither copied nor split; None if all points may be.
        beside: Gives the positions of the views that may be second ones, best first, from the position of a view and
            the depth that is rendered there; None finds them by the cameras (`NeighbourSelector.neighbours`).
        gpu_bytes: Photographs, masks and priors that may be kept on a GPU.
    """

    stage: Stage
    primitive: Primitive
    views: Sequence[View]
    photos: Pictures
    rasterizer: Rasterizer
    priors: Sequence[DepthPrior | None] | None = None
    masks: Sequence[Tensor | None] | None = None
    expect: Callable[[Sequence[int]], None] | None = None
    owns: Callable[[Tensor], Tensor] | None = None
    beside: Callable[[int, Tensor], list[int]] | None = None
    gpu_bytes: int = 0

    def begin(self, points: Points, generator: torch.Generator, frozen: Columns | None = None) -> StageState:
        """The state before the first step; `frozen` as in `StageState`."""
        declared = set(self.primitive.columns())
        if set(points.all_params()) != declared:
            raise BadInput(
                f"primitive {name_of(self.primitive)} declares the columns {', '.join(sorted(declared))}, and its "
                f"points have {', '.join(sorted(points.all_params()))}"
            )
        state = StageState(points, Order(len(self.views)), generator, frozen=frozen or {})
        if self.stage.appearance is not None:
            state.appearances = fresh_appearances(self.stage.appearance, len(self.views))
        state.move(self.rasterizer.where())
        return state

    def run(self, state: StageState, clock: Stopwatch | None = None) -> Iterator[Done]:
        """Take the steps that are left; after each one, `state` can be saved, and the caller may stop.

        The points of `state` are moved to where the rasterizer draws. The caller may stop the `clock` of the state.
        """
        clock = clock or Stopwatch(state)
        state.move(self.rasterizer.where())
        self.foretell(state.order)
        while state.index < self.stage.steps:
            done = self.step(state)
            clock.lap()
            held = peak_memory_bytes(), peak_gpu_bytes()
            emit(StepDone(done.index, self.stage.steps, done.losses, done.points, *held))
            yield done

    def foretell(self, order: Order) -> None:
        """Say which views come next, so that their pictures can be read ahead."""
        if self.expect is not None and order.at < len(order.queue):
            self.expect(self.uploads.missing(order.queue[order.at :].tolist()))

    def step(self, state: StageState) -> Done:
        """One optimisation step: render a view, compare it with its photograph, update the points, then edit them."""
        index = state.index + 1
        if state.index % OBSERVED_EVERY == 0:
            state.points = observe(self.primitive, state.points, self.views, self.stage.near)
        state.sh_degree = max(state.sh_degree, min(self.primitive.sh_degree, index // self.stage.sh_every))
        found = retry_on_oom(state, self.uploads, lambda: self.seen(state))
        self.learn(state, found)
        return Done(index, found.losses, len(state.points), found.render.maps, found.target)

    def seen(self, state: StageState) -> StepResult:
        """Render the next view, compare it with its photograph, and go back to the splats."""
        stage, index = self.stage, state.index + 1
        shown, target = self.target(state)
        active, reads = stage.weights_at(index), self.maps_read(index)
        some = self.in_view(state, target.view.camera)
        params = state.points.all_params() if some is None else some.of_columns(state.points.params)
        leaves = {name: value.detach().requires_grad_() for name, value in params.items()}
        shape = self.primitive.activate(leaves, state.sh_degree)
        splats = self.drawn(state, shape, state.sh_degree, some and target.view.camera)

        paired = stage.is_paired(index)
        geometry, distortion = paired or bool(reads.keys() & GEOMETRY), "distortion" in reads
        render = self.draws.render(splats, target.view.camera, stage.near, geometry, distortion)
        refuse_wrong_maps(self.primitive, render.maps, target.view.camera, reads)
        self.uploads.ahead(state.order, state.skipped)
        second = self.neighbour(state, splats, shown, render.maps) if paired else None
        compared = replace(target, neighbour=second)
        appearance = self.appearance_of(state, shown)
        given = active, render.maps, compared, appearance
        losses, total, chosen, by_appearance = loss_gradients(stage.losses, stage.signal, *given)
        gradients = render.backward(total, chosen, stage.signal.absolute, len(shape))
        learned = appearance and (appearance, by_appearance)
        return StepResult(target, some, leaves, shape, splats, render, losses, gradients, learned)

    def learn(self, state: StageState, found: StepResult) -> None:
        """Change the points by what a step has seen."""
        stage, index, target, render = self.stage, state.index + 1, found.target, found.render
        state.whole = False
        if found.appearance is not None:
            appearance, by_appearance = found.appearance
            appearance.learn(by_appearance)
        seen = render.seen[: len(found.shape)]
        given = RegularizerInput(index, stage.steps, target, render.maps, seen, state.points.stat, found.leaves)
        terms = regularizer_terms(stage.regularizers, found.shape, given)
        found.losses.update(as_numbers(terms))
        require_finite_losses(index, target.view.name, found.losses)
        facts = self.facts(state, found)
        edit = self.wanted(state.points, facts)
        grads = pulled(found.shape, found.gradients, found.leaves, list(terms.values()))
        if found.in_view is not None:
            require_finite_gradients(index, target.view.name, grads)
        adam_step(state.points, grads, facts.rates, index, found.in_view and found.in_view.rows)
        if found.in_view is None:
            require_finite_values(index, target.view.name, state.points.all_params())
        state.points = fitted(self.primitive, state.points)
        if edit is not None:
            state.points = retry_on_oom(state, self.uploads, lambda: self.edited(state, edit, index))
        state.index, state.whole = index, True

    def in_view(self, state: StageState, camera: Camera) -> InView | None:
        """The points that a step is for; None where it is for all (`Stage.update`)."""
        stage, index = self.stage, state.index + 1
        if stage.update == "all" or stage.regularizers or stage.is_paired(index):  # these look at other points too
            return None
        if self.draws is not self.rasterizer or state.points.shared:
            return None
        return InView.of(self.primitive, state.points.params, camera, self.rasterizer, stage.near)

    def drawn(self, state: StageState, shape: Splats, degree: int, camera: Camera | None = None) -> Splats:
        """The splats of a state, detached, and then those that are frozen; of these, with a camera, those in view."""
        splats, frozen = shape.detached(), state.frozen
        if not frozen:
            return splats
        if camera is not None:
            frozen = InView.of(self.primitive, frozen, camera, self.rasterizer, self.stage.near).of_columns(frozen)
        shared = {name: value.detach() for name, value in state.points.shared.items()}
        return splats.and_then(self.primitive.activate(frozen | shared, degree))

    @cached_property
    def draws(self) -> Rasterizer:
        """What draws the splats of the primitive."""
        return drawn_by(self.primitive, self.rasterizer)

    def maps_read(self, index: int) -> dict[str, str]:
        """By the name of a map that the terms of step `index` read, the path of one of these terms."""
        steps = [index]
        if index == 1 and self.draws is not self.rasterizer:
            # what a render of the primitive's own lacks for the last steps is told now, not after hours
            steps += [max(1, self.stage.steps + at) for at in range(-99, 1)]
        return maps_read(self.stage.losses, self.stage.regularizers, steps, self.stage.steps)

    @cached_property
    def rates(self) -> dict[str, LearningRate]:
        """The learning rate of each parameter."""
        return rates_of(self.stage, self.primitive)

    def target(self, state: StageState) -> tuple[int, Target]:
        """Position and photograph of the view to show now; damaged ones are passed over, and named once."""
        while len(state.skipped) < len(self.views):
            if state.order.at == len(state.order.queue):
                state.order.shuffle(state.generator)
                self.foretell(state.order)
            at = state.order.next(state.generator)
            if at in state.skipped or (shown := self.readable(state, at, self.uploads.get(at))) is None:
                continue
            return at, Target(self.views[at], shown.in_floats(), shown.prior, shown.mask, seed=state.seed)
        raise BadInput(f"none of the {len(self.views)} photographs can be read, {self.views[0].path} for one")

    @cached_property
    def uploads(self) -> Uploads:
        """The photographs, masks and priors, where the points are."""
        return Uploads(self.rasterizer.where(), self.photos, self.masks, self.priors, self.gpu_bytes)

    def readable(self, state: StageState, at: int, found: Shown | BadInput) -> Shown | None:
        """A view; None for one with a damaged photograph, which is named and not shown again."""
        if isinstance(found, Shown):
            return found
        state.skipped.append(at)
        emit(PhotoSkipped(self.views[at].name, str(found)))
        return None

    @cached_property
    def selector(self) -> NeighbourSelector:
        """The cameras of all views."""
        return NeighbourSelector.of([view.camera for view in self.views])

    def neighbour(self, state: StageState, splats: Splats, shown: int, maps: Maps) -> Neighbour | None:
        """One of the views that show best, from another side, what a view shows; None if none does.

        Which one depends on what is rendered now and on the seed and number of the step, and on nothing else, so that
        a run which goes on has the same ones.
        """
        found = (self.beside or self.selector.neighbours)(shown, maps.median)
        generator = torch.Generator().manual_seed(state.seed)
        first = int(torch.randint(max(1, len(found)), (), generator=generator))
        for at in (*found[first:], *found[:first]):
            if at in state.skipped or (shown := self.readable(state, at, self.uploads.aside(at))) is None:
                continue
            drawn = self.draws.render(splats, self.views[at].camera, self.stage.near, True, False).maps
            shape = replace(drawn, color=None, distortion=None)
            return Neighbour(self.views[at], shown.in_floats(), shape, shown.mask)
        return None

    def appearance_of(self, state: StageState, shown: int) -> ImageAppearance | None:
        """The appearance of a photograph, if the stage learns any."""
        if self.stage.appearance is None:
            return None
        rate = self.stage.appearance.rate_at(state.index + 1, self.stage.steps) / 2**state.halvings
        return ImageAppearance(self.stage.appearance, state.appearances, shown, rate)

    def facts(self, state: StageState, found: StepResult) -> Step:
        """What the policies are told about a step, and nothing about frozen points."""
        index, count, render, gradients = state.index + 1, len(found.shape), found.render, found.gradients
        signal, among_all = self.stage.signal, found.in_view.among_all if found.in_view else (lambda values: values)
        combined = signal.combine(gradients.signal if gradients.chosen is None else gradients.chosen, gradients.signal)
        signed_norm = among_all(lengths(gradients.signal))
        camera = found.target.view.camera
        drawn = found.splats if found.in_view is None else self.drawn(state, found.in_view.splats, 0)
        return Step(
            index=index,
            steps=self.stage.steps,
            seen=among_all(render.seen[:count]),
            splats=drawn.first(len(state.points)),
            grad_norm=signed_norm if combined is gradients.signal else among_all(lengths(combined)),
            radii=among_all(render.radii[:count]),
            image_px=max(camera.width, camera.height),
            views=ViewContributions(self.views, self.draws, drawn, self.stage.near, len(state.points)),
            since_reset=index - state.reset_at,
            rates={n: rate.at(index, self.stage.steps) / 2**state.halvings for n, rate in self.rates.items()},
            seed=state.seed,
            owns=self.owns,
            signed_norm=signed_norm,
            derived=gradients.derived and gradients.derived.combined(signal.combine),
        )

    def wanted(self, points: Points, step: Step) -> Edit | None:
        """What the policies ask for together, of what is allowed."""
        for policy in self.stage.policies:
            policy.watch(points, step)
        count = len(points)
        edit = merge([sound(policy.edit(points, step), count, policy) for policy in self.stage.policies])
        return edit if edit is None or self.owns is None else withheld(edit, step.may_be_densified())

    def edited(self, state: StageState, edit: Edit, index: int) -> Points:
        """The points after an edit."""
        points = apply(self.primitive, state.points, edit, state.generator)
        if len(points) == 0:
            raise BadInput(f"step {index} would drop every point; lower the culls of densify and the ratios of prune")
        points = observe(self.primitive, points, self.views, self.stage.near)
        if edit.max_opacity is not None:
            state.reset_at = index
        if any(counts := edit.counts):
            emit(PointsEdited(index, *counts, points=len(points)))
        return points


def lengths(vectors: Tensor) -> Tensor:
    """(N,) lengths of (N, 2) vectors; torch's norm takes three times as long along so short an axis."""
    return (vectors[:, 0] ** 2 + vectors[:, 1] ** 2).sqrt()


def rates_of(stage: Stage, primitive: Primitive) -> dict[str, LearningRate]:
    """The learning rate of each parameter: the primitive's own, unless the stage has another."""
    return {name: stage.rates.get(name, column.rate) for name, column in primitive.columns().items()}
