"""The check of what changes the points in every step.

It returns nothing and raises AssertionError with a sentence that says what is wrong.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from surfkit.primitives.points import Columns, Points
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.raster.select import select
from surfkit.testing.equality import assert_same, twin, unchanged
from surfkit.testing.inputs import survey
from surfkit.train import checkpoint
from surfkit.train.optimizer import Optimizer, OptimizerInput
from surfkit.train.stage import Stage
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer

VIEWS, STEPS = 4, 40
"""Of the survey, and of the stage; whole rounds of the views."""


def check_optimizer(optimizer: Optimizer) -> None:
    """An optimizer lowers the losses on a small survey in 40 steps. It changes points in place, none that a step is
    not for and no parameter without a gradient, and nothing that it is given. All that it keeps goes with the points:
    a run that goes on from a checkpoint comes to the same bits.

    Args:
        optimizer: With settings that suit the learning rates of 3DGS.
    """
    name = type(optimizer).__name__
    for key in ("in_view", "pulls"):
        value = getattr(optimizer, key)
        assert isinstance(value, bool), f"{name}.{key} is {value!r}; it must be True or False"
    trainer, state = _begin(_Watched(optimizer))
    losses = [sum(done.losses.values()) for done in trainer.run(state)]
    before, after = sum(losses[:VIEWS]), sum(losses[-VIEWS:])
    assert after < before, (
        f"{name} takes the losses from {before / VIEWS:.4f} to {after / VIEWS:.4f} in {STEPS} steps; they must fall"
    )
    first, half = _begin(twin(optimizer))
    while half.index < STEPS // 2:
        first.step(half)
    with tempfile.TemporaryDirectory() as folder:
        checkpoint.save(Path(folder, "checkpoint.safetensors"), half)
        half = checkpoint.load(Path(folder, "checkpoint.safetensors"))
    list(_begin(twin(optimizer))[0].run(half))
    what = f"{name}: a run that goes on from a checkpoint"
    assert_same(what, state.points, half.points, "keep what must last with the points, and draw from `given.seed`")


def _begin(optimizer: Optimizer) -> tuple[Trainer, StageState]:
    """A stage of steps on a survey, before the first one; some of its points are in no view."""
    truth, primitive, generator = survey(VIEWS, 32, 24, 150), Surfel2D(1), torch.Generator().manual_seed(0)
    photos = [(truth.exact[view.name].color * 255).round().to(torch.uint8) for view in truth.scene.train]
    params = primitive.init(truth.scene.cloud, generator)
    params["means"][::10, 0] += 100
    stage = Stage(steps=STEPS, densify=None, sh_every=STEPS // 4, optimizer=optimizer)
    trainer = Trainer(stage, primitive, truth.scene.train, photos, select("cpu")[0])
    return trainer, trainer.begin(Points.fresh(params), generator)


@dataclass(frozen=True)
class _Watched(Optimizer):
    """Takes the steps of another one, and looks at what they change."""

    inner: Optimizer

    @property
    def in_view(self) -> bool:  # type: ignore[override]  # of another one
        return self.inner.in_view

    @property
    def pulls(self) -> bool:  # type: ignore[override]  # likewise
        return self.inner.pulls

    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        name, there = type(self.inner).__name__, points.all_params()
        before, shapes = {key: value.clone() for key, value in there.items()}, {k: v.shape for k, v in there.items()}
        others = torch.full((len(points),), given.rows is not None)
        if given.rows is not None:
            others[given.rows] = False
        told: dict[str, Any] = {"rates": given.rates, "rows": given.rows}
        with unchanged(f"{name}.step", grads=grads, **told):
            self.inner.step(points, grads, given)
        for key, value in points.all_params().items():
            assert value is there[key], f"{name} puts another tensor in the place of {key!r}; change it in place"
            assert torch.isfinite(value).all(), f"{name} makes {key!r} infinite or NaN in step {given.index}"
            still = slice(None) if key not in grads else others
            same = torch.equal(value[still], before[key][still])
            why = "that has no gradient" if key not in grads else "of points that are not in `given.rows`"
            assert same, f"{name} changes {key!r} {why}"
        for group in ("exp_avg", "exp_avg_sq"):
            kept = {key: value.shape for key, value in getattr(points, group).items()}
            assert kept == shapes, f"{name}: {group} has not the parameters and shapes of the points any more"
        for key, value in points.stats.items():
            shape = tuple(value.shape)
            assert shape[:1] == (len(points),), f"{name}: the statistic {key!r} has shape {shape}, not (N, ...)"
