"""Checks of what decides about points: the policies, filters and signals of densification.

Each check returns nothing and raises AssertionError with a sentence that says what is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from surfkit.densify.base import Densify, Filter, Policy, Prune, Signal, Step
from surfkit.primitives.edit import Edit, NewPoints
from surfkit.primitives.points import Points
from surfkit.testing.equality import assert_same, assert_tensor, twin, unchanged
from surfkit.testing.inputs import crowd, splats

STAGE_STEPS = 30_000
"""Of the stage through which policies are taken."""


def check_policy(policy: Policy, points: Points | None = None, step: Step | None = None) -> None:
    """A policy asks for masks of the right shape, changes no parameter, keeps its statistics whole, keeps nothing in
    itself that a resumed run would lose, and repeats itself.

    Args:
        policy: With settings that make it act on some of random points in the unit cube, at some of the steps 1 to
            30,000; or at `step`, if one is given.
        points: N points, to check one step only.
        step: About those N points.
    """
    if points is not None and step is not None:
        _edit(policy, points, step)
        return
    edits = [edit for _, edit in _taken_through(policy)]
    assert any(edit is not None for edit in edits), _idle(policy, "asks for no change")


def check_densify(densify: Densify, given: tuple[Points, Step] | None = None) -> None:
    """A densifier keeps to `check_policy`, adds points, only at steps that it told before, and none beyond a limit.

    Args:
        densify: With settings as for `check_policy`.
        given: The points, and a step about them, to take it through, for one that knows a certain primitive only;
            random surfels if None.
    """
    given = given or crowd()
    name, foretold = type(densify).__name__, densify.edits(STAGE_STEPS)
    if foretold is not None:
        steps = list(foretold)
        assert steps == sorted(set(steps)), f"{name}.edits: steps must be in order, each of them once"
        assert not steps or 1 <= steps[0] <= steps[-1] <= STAGE_STEPS, (
            f"{name}.edits: steps must lie in 1 to {STAGE_STEPS}"
        )
    added = [index for index, edit in _taken_through(densify, given) if edit is not None and _adds(edit)]
    assert added, _idle(densify, "neither clones nor splits a point")
    count = len(given[0])
    most = count + 5
    taken = _taken_through(densify.limited(most), given)
    over = [index for index, edit in taken if edit is not None and _after(edit, count) > most]
    assert not over, f"{name}.limited({most}) adds points beyond {most} after step {over[0]}"
    late = [index for index in added if foretold is not None and index not in foretold]
    assert not late, f"{name} adds points after step {late[0]}, which edits({STAGE_STEPS}) does not name"


def check_prune(prune: Prune) -> None:
    """A pruner keeps to `check_policy`, and adds no points.

    Args:
        prune: With settings as for `check_policy`.
    """
    edits = [(index, edit) for index, edit in _taken_through(prune) if edit is not None]
    name, added = type(prune).__name__, [index for index, edit in edits if _adds(edit)]
    assert not added, f"{name} adds points after step {added[0]}; make it a Densify"
    assert any(edit.drop is not None for _, edit in edits), _idle(prune, "drops no point")


def check_filter(filter: Filter) -> None:
    """A filter gives one bool for each point, changes nothing and repeats itself, whoever wants to be densified.

    Args:
        filter: With any settings.
    """
    name, (_, step) = type(filter).__name__, crowd()
    count, draw = len(step.splats), torch.Generator().manual_seed(0)
    some = torch.rand(count, generator=draw) * (torch.rand(count, generator=draw) > 0.5)
    steps = {"": step, " with ellipsoids": replace(step, splats=splats("gaussian", count))}
    for what, about in steps.items():
        for want in (some, torch.zeros(count), torch.ones(count)):
            with unchanged(f"{name}.admits", step=about, want=want):
                mask = filter.admits(about, want)
            assert mask.dtype == torch.bool, f"{name}.admits{what} gives {mask.dtype}, not bool"
            assert mask.shape == (count,), f"{name}.admits{what} has shape {tuple(mask.shape)}, not ({count},)"
            again = twin(filter).admits(about, want)
            assert_same(f"{name}.admits{what}", mask, again, "draw from a generator with `step.seed`")


def check_signal(signal: Signal) -> None:
    """A signal names its losses, or takes all, and gives finite (N, 2) gradients that are 0 for unseen points.

    Args:
        signal: With any settings.
    """
    name, terms, draw = type(signal).__name__, signal.terms, torch.Generator().manual_seed(0)
    named = isinstance(terms, tuple) and len(terms) > 0 and all(isinstance(term, str) for term in terms)
    assert terms is None or named, f"{name}.terms is {terms!r}; it must be None or a tuple of names of losses"
    assert isinstance(signal.absolute, bool), f"{name}.absolute is {signal.absolute!r}; it must be True or False"
    seen = (torch.rand(60, 1, generator=draw) > 0.3).float()
    chosen, total = (1e-4 * torch.randn(60, 2, generator=draw) * seen for _ in range(2))
    nothing = torch.zeros_like(total)
    for what, a, b in (
        ("", chosen, total),
        (" of chosen losses without gradient", nothing, total),
        (" of no seen point", nothing, nothing),
    ):
        with unchanged(f"{name}.combine", chosen=a, total=b):
            found = signal.combine(a, b)
        assert_tensor(f"{name}.combine{what}", found)
        assert found.shape == (60, 2), f"{name}.combine{what} has shape {tuple(found.shape)}, not (60, 2)"
        assert torch.isfinite(found).all(), f"{name}.combine{what} is not finite"
        assert not (found * (1 - seen)).any(), f"{name}.combine{what} is not 0 for points that are not seen"
        assert_same(f"{name}.combine{what}", found, twin(signal).combine(a, b), "it may depend on its inputs only")


def _taken_through(policy: Policy, given: tuple[Points, Step] | None = None) -> Iterator[tuple[int, Edit | None]]:
    """Steps of a stage of 30,000, and what the policy asks for after each; the points stay as they are."""
    points, step = given or crowd()
    points = replace(points, stats={})
    for index in [*range(1, 30), *range(100, STAGE_STEPS + 1, 100)]:
        yield index, _edit(policy, points, replace(step, index=index, since_reset=index, seed=index))


def _idle(policy: Policy, does: str) -> str:
    return (
        f"{type(policy).__name__} {does} at any of the steps that were tried, of 1 to {STAGE_STEPS}; give it "
        f"settings with "
        "which it acts on points in the unit cube, or the check says nothing"
    )


def _after(edit: Edit, count: int) -> int:
    """How many points there are after an edit of `count`."""
    nobody = torch.zeros(count, dtype=torch.bool)
    drop, clone, split = (nobody if mask is None else mask for mask in (edit.drop, edit.clone, edit.split))
    new = 0 if edit.new is None else len(edit.new)
    return new + int(torch.where(drop, 0, torch.where(split, 2, 1 + clone.long())).sum())


def _adds(edit: Edit) -> bool:
    return bool(edit.new) or any(mask is not None and bool(mask.any()) for mask in (edit.clone, edit.split))


def _edit(policy: Policy, points: Points, step: Step) -> Edit | None:
    """What a policy asks for after a step, which has been checked."""
    name = type(policy).__name__
    before = {key: value.clone() for key, value in points.params.items()}
    with unchanged(name, step=step):
        policy.watch(points, step)
        stats = {key: value.clone() for key, value in points.stats.items()}
        first = policy.edit(points, step)
        second = twin(policy).edit(points, step)
        for key, value in points.params.items():
            assert torch.equal(value, before[key]), f"{name} changed the parameter {key!r}; return an Edit instead"
    for key, value in points.stats.items():
        shape = tuple(value.shape)
        assert shape[:1] == (len(points),), f"{name}: the statistic {key!r} has shape {shape}, not (N, ...)"
        assert key not in stats or torch.equal(value, stats[key]), f"{name}.edit changed {key!r}; only watch may"
    _check_repeated(name, first, second)
    if first is not None:
        _check_edit(name, first, points)
    return first


def _check_repeated(name: str, first: Edit | None, second: Edit | None) -> None:
    """Both edits are the same, field by field."""
    remedy = "draw from a generator with `step.seed`, and keep what must last in `points.stat(...)`"
    assert (first is None) == (second is None), f"{name}.edit is not repeatable; {remedy}"
    if first is None or second is None:
        return
    for field in fields(first):
        one, two = getattr(first, field.name), getattr(second, field.name)
        assert_same(f"{name}: {field.name}", one, two, remedy)


def _check_edit(name: str, edit: Edit, points: Points) -> None:
    for field in fields(edit):
        value: Any = getattr(edit, field.name)
        if field.name == "max_opacity":
            assert value is None or 0 < value < 1, f"{name}: max_opacity must lie between 0 and 1"
        elif field.name == "new":
            _check_new(f"{name}: new", value, points)
        elif field.name == "values":
            for key, column in (value or {}).items():
                known = points.all_params().get(key)
                assert known is not None, f"{name}: values has {key!r}, and the points have no such parameter"
                assert column.shape == known.shape, f"{name}: values: {key!r} has another shape than the parameter"
        elif value is not None:
            _check_rows(f"{name}: {field.name}", value, field.name, len(points))


def _check_new(what: str, new: NewPoints | None, points: Points) -> None:
    if new is None:
        return
    assert new.parent.dtype == torch.int64, f"{what}.parent is {new.parent.dtype}, not int64"
    inside = bool(((new.parent >= 0) & (new.parent < len(points))).all())
    assert inside, f"{what}.parent names points that do not exist"
    assert set(new.params) == set(points.params), f"{what} has {sorted(new.params)}, not {sorted(points.params)}"
    for key, value in new.params.items():
        wanted = (len(new), *points.params[key].shape[1:])
        assert value.shape == wanted, f"{what}: {key!r} has shape {tuple(value.shape)}, not {wanted}"
        assert torch.isfinite(value).all(), f"{what}: {key!r} is not finite"


def _check_rows(what: str, value: Tensor, field: str, count: int) -> None:
    assert_tensor(what, value)
    if field in ("drop", "clone", "split", "forget", "scatter"):
        counts = field == "clone"
        allowed = (torch.bool, torch.int64) if counts else (torch.bool,)
        assert value.dtype in allowed, f"{what} is {value.dtype}, not bool{' or int64' * counts}"
        assert value.dtype == torch.bool or bool((value >= 0).all()), f"{what} is below 0 for some point"
    wanted = (count, 3) if field == "move" else (count,)
    assert value.shape == wanted, f"{what} has shape {tuple(value.shape)}, not {wanted}"
    if field == "opacities":
        value = value[~value.isnan()]
        assert bool(((value > 0) & (value < 1)).all()), f"{what} must lie between 0 and 1, or be NaN"
    assert torch.isfinite(value).all(), f"{what} is not finite"
    assert field != "scale_by" or bool((value > 0).all()), f"{what} must be above 0"
