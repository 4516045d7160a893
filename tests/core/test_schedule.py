import math
from dataclasses import dataclass
from typing import Annotated

import pytest

from surfkit.core.check import BadInput
from surfkit.core.schedule import Interval, StepCount, Steps, log_linear, rescale, rescale_like


def test_marked_counts_are_scaled_at_any_depth(world):
    recipe = world.Recipe(
        "x",
        pretrain=world.Stage(losses={"d": world.Depth(start=7_000, until=9_000)}, prune=(world.Relocate(cap=500),)),
        tune=world.Stage(grow=None),
    )
    small = rescale(recipe, 1 / 15)
    assert small.pretrain.steps == 2_000
    assert small.pretrain.losses == {"d": world.Depth(start=467, until=600)}
    assert small.pretrain.grow == world.Adaptive(every=7, reset=200)
    assert small.pretrain.marks == (467, 2_000)
    assert small.pretrain.prune == recipe.pretrain.prune  # a count of points, not of steps
    assert (small.tune.steps, small.tune.grow, small.about) == (2_000, None, "x")
    assert recipe.pretrain.steps == 30_000
    assert rescale(recipe, 1.0) == recipe


def test_floors(world):
    part = world.Adaptive(every=100, reset=3_000)
    assert rescale(part, 1e-4) == world.Adaptive(every=1, reset=25)
    assert rescale(world.Adaptive(every=0, reset=10), 0.5) == world.Adaptive(every=0, reset=10)  # never, and small
    assert rescale(world.Depth(start=4, until=None), 0.1) == world.Depth(start=0, until=None)
    assert rescale(world.Depth(start=4, until=3), 2.5) == world.Depth(start=10, until=8)


@dataclass(frozen=True)
class Held:
    every: Annotated[int, StepCount(floor=100, stretch=15)] = 100
    each: Annotated[int, StepCount(floor=500, stretch=15)] = 500


def test_a_floor_gives_way_in_runs_that_are_too_short_for_it():
    lengths = (1.0, 0.5, 1 / 15, 0.05, 0.01, 1e-4)
    assert [rescale(Held(), factor).every for factor in lengths] == [100, 100, 100, 75, 15, 1]
    for factor in (1.0, 0.3, 0.07, 0.05, 0.01):
        short = rescale(Held(), factor)
        assert short.each == pytest.approx(5 * short.every, abs=2.5), "in proportion, up to rounding"


@pytest.mark.parametrize("short", [1, 2, 17, 30, 100, 700, 2_000, 9_000])
@pytest.mark.parametrize("long", [3, 60, 250, 1_000, 3_000, 30_000])
def test_what_a_floor_gave_way_for_can_be_made_longer(short, long):
    if long > short:
        at_once = rescale(Held(), long / 30_000)
        assert rescale_like(rescale(Held(), short / 30_000), long / short, at_once) == at_once


def test_what_cannot_be_scaled(world):
    for factor in (0, -1, math.nan, math.inf):
        with pytest.raises(BadInput, match="factor above 0"):
            rescale(world.Stage(), factor)
    with pytest.raises(BadInput, match="by 1e-06: steps is 0"):
        rescale(world.Stage(), 1e-6)


def test_log_linear():
    assert log_linear(1e-2, 1e-4, 0.0) == 1e-2
    assert log_linear(1e-2, 1e-4, 1.0) == 1e-4
    assert log_linear(1e-2, 1e-4, 0.5) == pytest.approx(1e-3)
    assert log_linear(1e-2, 1e-4, 7.0) == 1e-4
    with pytest.raises(BadInput, match="above 0"):
        log_linear(1.0, 0.0, 0.5)


def test_a_schedule_made_shorter_and_longer_is_like_one_made_shorter_at_once():
    @dataclass(frozen=True)
    class Part:
        every: Interval = 100
        start: Steps = 1_000
        until: Steps | None = None
        never: Steps = 0

    whole = {"a": (Part(), Part(every=70, until=15_000)), "steps": 1}
    for short, long in [(2e-3, 4e-3), (2e-3, 5e-3), (1e-3, 1.0), (0.01, 0.013)]:
        at_once = rescale(whole, long)
        again = rescale_like(rescale(whole, short), long / short, at_once)
        assert again == at_once, (short, long)
    other = {"a": (Part(every=300), whole["a"][1]), "steps": 1}
    assert rescale_like(rescale(whole, 0.5), 2, other) == whole, "what is not alike is scaled"
