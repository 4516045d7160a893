"""Optimizers that break their contract are named, with what is wrong."""

from dataclasses import dataclass, field
from typing import ClassVar

import pytest
import torch

from surfkit.testing import check_optimizer
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.optimizer import Optimizer


@dataclass(frozen=True)
class Drifts(Adam):
    """Moves points that a step is not for."""

    in_view: ClassVar[bool] = True

    def step(self, points, grads, given):
        super().step(points, grads, given)
        points.params["means"] -= 1e-6


@dataclass(frozen=True)
class Climbs(Adam):
    def step(self, points, grads, given):
        super().step(points, {name: -grad for name, grad in grads.items()}, given)


@dataclass(frozen=True)
class Replaces(Optimizer):
    def step(self, points, grads, given):
        points.params["means"] = points.params["means"] - 1e-4 * grads["means"].sign()


@dataclass(frozen=True)
class Scales(Adam):
    def step(self, points, grads, given):
        grads["means"].mul_(2)
        super().step(points, grads, given)


@dataclass(frozen=True)
class Forgets(Adam):
    """Keeps in itself what a run that goes on has not."""

    before: dict = field(default_factory=dict, init=False)

    def step(self, points, grads, given):
        super().step(points, grads, given)
        points.params["sh0"] += 0.01 * self.before.get("sh0", torch.zeros(1))
        self.before["sh0"] = -given.rates["sh0"] * grads["sh0"].sign()


@dataclass(frozen=True)
class Draws(Adam):
    def step(self, points, grads, given):
        super().step(points, {name: grad * (0.5 + torch.rand(())) for name, grad in grads.items()}, given)


@dataclass(frozen=True)
class Explodes(Adam):
    def step(self, points, grads, given):
        points.params["scales"] /= 0


@dataclass(frozen=True)
class Counts(Adam):
    def step(self, points, grads, given):
        super().step(points, grads, given)
        points.stats["steps"] = torch.tensor([float(given.index)])


class Asks(Adam):
    pulls = 1


@pytest.mark.parametrize(
    ("optimizer", "message"),
    [
        (Drifts(), "Drifts changes 'means' of points that are not in `given.rows`"),
        (Climbs(), r"Climbs takes the losses from 0.\d+ to \d.\d+ in 40 steps; they must fall"),
        (Replaces(), "Replaces puts another tensor in the place of 'means'"),
        (Scales(), r"Scales.step changed its input grads\['means'\]"),
        (Forgets(), "Forgets: a run that goes on from a checkpoint is not repeatable: .*`given.seed`"),
        (Draws(), "Draws: a run that goes on"),
        (Explodes(), "Explodes makes 'scales' infinite or NaN in step 1"),
        (Counts(), r"Counts: the statistic 'steps' has shape \(1,\), not \(N, ...\)"),
        (Asks(), "Asks.pulls is 1; it must be True or False"),
    ],
)
def test_optimizers_that_are_wrong(optimizer, message):
    with pytest.raises(AssertionError, match=message):
        check_optimizer(optimizer)


@dataclass(frozen=True)
class Pulls(AdamInView):
    """Takes the gradients of the losses and the mean alpha."""

    pulls: ClassVar[bool] = True

    def step(self, points, grads, given):
        from surfkit.raster.api import Maps

        more = given.pull(Maps(color=torch.zeros(3, 24, 32), alpha=torch.full((24, 32), 1e-9)))
        assert {name: grad.shape for name, grad in more.items()} == {name: grad.shape for name, grad in grads.items()}
        super().step(points, {name: grad + more[name] for name, grad in grads.items()}, given)


def test_one_that_pulls():
    check_optimizer(Pulls())
