"""One optimisation run over a set of views."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Protocol

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import PointsEdited, StepDone, emit
from surfkit.core.registry import choice
from surfkit.core.schedule import Interval, Steps
from surfkit.densify.adc import ADC
from surfkit.densify.base import Densify, Policy, Prune, Signal, Step
from surfkit.densify.signal import LossGradient
from surfkit.losses.base import Loss, Sample
from surfkit.losses.photometric import L1, SSIM
from surfkit.primitives.base import Primitive, apply
from surfkit.primitives.points import Columns, Edit, Points, merge
from surfkit.raster.api import Gradients, Maps, Rasterizer, Render, Splats
from surfkit.scene.depth_prior import DepthPrior
from surfkit.scene.scene import View
from surfkit.train.adam import Rate, adam_step
from surfkit.train.views import Order, Survey

RATES = {
    "means": Rate(1.6e-4, 1.6e-6),
    "scales": Rate(5e-3),
    "quats": Rate(1e-3),
    "opacities": Rate(5e-2),
    "sh0": Rate(2.5e-3),
    "sh_rest": Rate(1.25e-4),
}
"""Of 3DGS, for a scene extent of 1."""


@dataclass(frozen=True)
class Stage:
    """One optimisation run over a set of views."""

    steps: Steps = 30_000
    """Photographs shown, one a step."""

    losses: dict[str, Annotated[Loss, choice(Loss)]] = field(default_factory=lambda: {"l1": L1(), "ssim": SSIM()})
    """What is minimised: the weighted sum of these."""

    signal: Annotated[Signal, choice(Signal)] = LossGradient()
    """Which gradient drives densification."""

    densify: Annotated[Densify | None, choice(Densify, optional=True)] = ADC()
    """How points multiply; none keeps their number."""

    prune: tuple[Annotated[Prune, choice(Prune)], ...] = ()
    """Further ways to remove points."""

    rates: dict[str, Rate] = field(default_factory=lambda: dict(RATES))
    """Learning rates of the parameters; of positions as a share of the scene extent."""

    sh_every: Interval = 1_000
    """Steps between degrees of the spherical harmonics, from 0 up to the primitive's."""

    near: float = 0.005
    """Nothing nearer to a camera than this is drawn, as a share of the scene extent."""

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise BadInput(f"a stage has {self.steps} steps; give 1 or more")
        if self.sh_every < 1:
            raise BadInput(f"sh_every is {self.sh_every}; it must be 1 or more steps")
        if unknown := set(self.signal.terms or ()) - set(self.losses):
            raise BadInput(f"signal.terms names {', '.join(sorted(unknown))}; the losses are {', '.join(self.losses)}")

    @property
    def policies(self) -> tuple[Policy, ...]:
        """Everything that adds or removes points."""
        return (*([self.densify] if self.densify else []), *self.prune)


@dataclass
class StageState:
    """What an interrupted stage needs to go on as if nothing had happened."""

    points: Points
    order: Order
    generator: torch.Generator
    index: int = 0
    """Steps done."""
    seconds: float = 0.0
    """Wall time of the steps done."""
    cpu_seconds: float = 0.0
    """Processor time of the steps done, all threads."""
    peak_memory_bytes: int = 0
    """Most memory held so far; 0 where the system does not tell."""


@dataclass(frozen=True)
class Done:
    """One step, for those who watch."""

    index: int
    losses: dict[str, float]
    points: int
    maps: Maps
    sample: Sample


class Pictures(Protocol):
    """Photographs by the position of their view."""

    def __getitem__(self, at: int, /) -> Tensor:
        """(3, H, W) uint8."""


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
    """

    stage: Stage
    primitive: Primitive
    views: Sequence[View]
    photos: Pictures
    rasterizer: Rasterizer
    priors: Sequence[DepthPrior | None] | None = None

    def begin(self, points: Points, generator: torch.Generator) -> StageState:
        """The state before the first step."""
        missing = set(points.params) ^ set(self.stage.rates)
        if missing:
            raise BadInput(f"rates has {', '.join(self.stage.rates)}; the points have {', '.join(points.params)}")
        return StageState(points, Order(len(self.views)), generator)

    def run(self, state: StageState) -> Iterator[Done]:
        """Take the steps that are left; after each one, `state` can be saved, and the caller may stop."""
        wall, cpu = time.perf_counter(), time.process_time()
        while state.index < self.stage.steps:
            done = self.step(state)
            state.seconds += time.perf_counter() - wall
            state.cpu_seconds += time.process_time() - cpu
            wall, cpu = time.perf_counter(), time.process_time()
            emit(StepDone(done.index, self.stage.steps, done.losses, done.points))
            yield done

    def step(self, state: StageState) -> Done:
        """Show one photograph, and let points and policies learn from it."""
        stage, index = self.stage, state.index + 1
        shown = state.order.next(state.generator)
        prior = None if self.priors is None else self.priors[shown]
        sample = Sample(self.views[shown], self.photos[shown].to(torch.float32).div_(255), prior)
        active = {n: w for n, loss in stage.losses.items() if (w := loss.weight_at(index, stage.steps)) > 0}
        reads = {name for loss in active for name in stage.losses[loss].reads}
        leaves = {name: value.detach().requires_grad_() for name, value in state.points.params.items()}
        shape = self.primitive.shape(leaves, min(self.primitive.sh_degree, index // stage.sh_every))
        splats = replace(shape, **{name: value.detach() for name, value in shape.tensors().items()})

        geometry, distortion = bool(reads - {"color", "alpha"}), "distortion" in reads
        render = self.rasterizer.render(splats, sample.view.camera, stage.near, geometry, distortion)
        losses, total, chosen = self.cotangents(active, render.maps, sample)
        if not math.isfinite(sum(losses.values())):
            raise RuntimeError(f"step {index}, view {sample.view.name}: the losses are {losses}; lower the rates")
        gradients = render.backward(total, chosen)
        edit = self.wanted(state.points, self.facts(index, splats, sample, render, gradients))
        rates = {name: rate.at(index, stage.steps) for name, rate in stage.rates.items()}
        adam_step(state.points, pulled(shape, gradients, leaves), rates, index)
        if edit is not None:
            state.points = self.edited(state, edit, index)
        state.index = index
        return Done(index, losses, len(state.points), render.maps, sample)

    def cotangents(
        self, active: Mapping[str, float], maps: Maps, sample: Sample
    ) -> tuple[dict[str, float], Maps, Maps | None]:
        """The weighted losses, their gradient by the maps, and that of the losses which the signal asks for apart."""
        losses, terms = self.stage.losses, self.stage.signal.terms
        leaves = {name: value.detach().requires_grad_() for name, value in maps.present().items()}
        leafy = Maps(**leaves)
        values = {name: weight * losses[name](leafy, sample) for name, weight in active.items()}
        numbers = {name: float(value.detach()) for name, value in values.items()}
        if terms is None:
            return numbers, gradient(list(values.values()), leaves), None
        chosen = gradient([value for name, value in values.items() if name in terms], leaves)
        others = gradient([value for name, value in values.items() if name not in terms], leaves)
        return numbers, added(chosen, others), chosen

    def facts(self, index: int, splats: Splats, sample: Sample, render: Render, gradients: Gradients) -> Step:
        """What the policies are told about a step."""
        chosen = gradients.signal if gradients.chosen is None else gradients.chosen
        return Step(
            index=index,
            steps=self.stage.steps,
            seen=render.seen,
            shape=splats,
            grad=self.stage.signal.combine(chosen, gradients.signal).norm(dim=-1),
            radii=render.radii,
            image_px=max(sample.view.camera.width, sample.view.camera.height),
            views=Survey(self.views, self.rasterizer, splats, self.stage.near),
        )

    def wanted(self, points: Points, step: Step) -> Edit | None:
        """What the policies ask for together."""
        for policy in self.stage.policies:
            policy.watch(points, step)
        return merge([policy.edit(points, step) for policy in self.stage.policies])

    def edited(self, state: StageState, edit: Edit, index: int) -> Points:
        """The points after an edit."""
        points = apply(self.primitive, state.points, edit, state.generator)
        if len(points) == 0:
            raise RuntimeError(f"step {index} dropped the last point; lower the culls of densify and prune")
        counts = [0 if mask is None else int(mask.sum()) for mask in (edit.drop, edit.clone, edit.split)]
        emit(PointsEdited(index, *counts, points=len(points)))
        return points


def gradient(losses: list[Tensor], leaves: Columns) -> Maps:
    """d(sum of losses)/d(maps); None for a map without influence, but colour is always there."""
    grads = [None] * len(leaves)
    if losses:
        grads = torch.autograd.grad(sum(losses), list(leaves.values()), allow_unused=True)
    found = Maps(**dict(zip(leaves, grads, strict=True)))
    return found if found.color is not None else replace(found, color=torch.zeros_like(leaves["color"]))


def added(a: Maps, b: Maps) -> Maps:
    """The sum of two cotangents."""
    sums = a.present()
    for name, value in b.present().items():
        sums[name] = sums[name] + value if name in sums else value
    return Maps(**sums)


def pulled(shape: Splats, gradients: Gradients, leaves: Columns) -> Columns:
    """Gradients by the raw parameters, from those by the splats; a parameter without influence is left out."""
    splats, grads = shape.tensors(), gradients.tensors()
    names = [name for name, value in splats.items() if value.requires_grad]
    raw = torch.autograd.grad(
        [splats[name] for name in names], list(leaves.values()), [grads[name] for name in names], allow_unused=True
    )
    return {name: grad.contiguous() for name, grad in zip(leaves, raw, strict=True) if grad is not None}
