"""What an optimisation run over a set of views is set to do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from surfkit.appearance.base import Appearance
from surfkit.core.check import BadInput, require_within
from surfkit.core.registry import choice
from surfkit.core.schedule import Interval, LearningRate, Steps
from surfkit.densify.adc import ADC
from surfkit.densify.base import Densify, Policy, Prune, Signal
from surfkit.densify.signal import LossGradient
from surfkit.losses.base import Loss, Regularizer
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.transients import Transients
from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns
from surfkit.train.adam import Adam
from surfkit.train.optimizer import Optimizer
from surfkit.train.state import StageState

MAX_STAGE_STEPS = 100_000_000
"""Of a stage: days and days of the fastest machine."""


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

    transients: Annotated[Transients | None, choice(Transients, optional=True)] = None
    """How people and cars that move are found, which no loss is to learn; none takes all that photographs show."""

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

    quarter_until: Steps = 0
    """Steps up to which photographs are shown at a quarter of their width and height; 0 for none. Lengths of losses and
    policies in pixels are then those of the small photographs. No side becomes shorter than 32 pixels."""

    half_until: Steps = 0
    """Steps up to which photographs are shown at half of their width and height, after those at a quarter."""

    near: float = 0.005
    """Nothing nearer to a camera than this is drawn, as a share of the scene extent."""

    optimizer: Annotated[Optimizer, choice(Optimizer)] = Adam()
    """What changes the points by the gradients of a step: all points, or only those in view."""

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= MAX_STAGE_STEPS:
            raise BadInput(f"a stage has {self.steps} steps; give 1 to {MAX_STAGE_STEPS}")
        if self.sh_every < 1:
            raise BadInput(f"sh_every is {self.sh_every}; it must be 1 or more steps")
        require_within({"quarter_until": (0, math.inf), "half_until": (0, math.inf)}, self)
        if unknown := set(self.signal.terms or ()) - set(self.losses):
            raise BadInput(f"signal.terms names {', '.join(sorted(unknown))}; the losses are {', '.join(self.losses)}")

    @classmethod
    def upgraded(cls, data: Mapping[str, Any]) -> dict[str, Any]:
        """The JSON of a stage, also of one from when it had `update` in place of an optimizer."""
        found = dict(data)
        if (update := found.pop("update", None)) is not None and "optimizer" not in found:
            found["optimizer"] = {"use": "adam-in-view" if update == "in-view" else "adam"}
        return found

    def weights_at(self, index: int) -> dict[str, float]:
        """Weights of the losses that count in step `index` of 1..`steps`, by key."""
        return {name: weight for name, loss in self.losses.items() if (weight := loss.weight_at(index, self.steps)) > 0}

    def divisor_at(self, index: int) -> int:
        """By which width and height of the photograph are divided in step `index` of 1..`steps`."""
        return 4 if index <= self.quarter_until else 2 if index <= self.half_until else 1

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
        if self.appearance is None or not state.appearances:
            return params
        return self.appearance.folded(state.appearances["value"], params)


def rates_of(stage: Stage, primitive: Primitive) -> dict[str, LearningRate]:
    """The learning rate of each parameter: the primitive's own, unless the stage has another."""
    return {name: stage.rates.get(name, column.rate) for name, column in primitive.columns().items()}
