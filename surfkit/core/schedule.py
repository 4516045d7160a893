"""Settings that change over a run, and settings that count its steps."""

from __future__ import annotations

import math
import types
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from surfkit.core.check import BadInput
from surfkit.core.hints import hints_of

T = TypeVar("T")


@dataclass(frozen=True)
class StepCount:
    """Marks an int setting that counts steps, so that a shorter run is the whole schedule made smaller.

    Attributes:
        floor: Scaling down stops here: a count above 0 does not fall below it.
        stretch: The floor gives way in runs so short that it would hold the count at more than this many times its
            share of the run; a floor above 0 still keeps 1. Counts of the same stretch whose floors are in proportion
            stay in proportion.
    """

    floor: int = 0
    stretch: float = math.inf

    def lowest(self, value: int, factor: float) -> int:
        """The least that a count of `value` becomes in a run `factor` times as long."""
        lowest = min(self.floor, value)
        return lowest if math.isinf(self.stretch) else min(lowest, max(1, rounded(value * factor * self.stretch)))


Steps = Annotated[int, StepCount()]
"""A position in the schedule, in steps."""
Interval = Annotated[int, StepCount(floor=1)]
"""A number of steps between two events; at least 1 after scaling."""


def rounded(value: float) -> int:
    """The nearest whole number; halves go up."""
    return math.floor(value + 0.5)


def rescale(value: T, factor: float) -> T:
    """A copy in which every step count, at any depth, is multiplied by `factor` and rounded.

    Args:
        value: Frozen dataclasses, tuples and dicts of them. Counts of 0 (never, or at once) stay 0; None stays None.
        factor: New length over old length of the run, above 0.
    """
    return rescale_like(value, factor, None)


def rescale_like(value: T, factor: float, like: Any) -> T:
    """As `rescale`, but with the counts of `like` wherever they are the same up to rounding.

    So a schedule that was shortened from a third one and then made longer can be compared with one that was shortened
    from it at once.
    """
    if not (math.isfinite(factor) and factor > 0):
        raise BadInput(f"steps can be scaled by a factor above 0, got {factor}")
    return _rescale(type(value), value, factor, like)


def log_linear(start: float, end: float, share: float) -> float:
    """From `start` to `end`, both above 0, evenly in the logarithm, at a share of the way held within [0, 1]."""
    if not (start > 0 and end > 0):
        raise BadInput(f"a log-linear schedule needs a start and an end above 0, got {start} and {end}")
    share = min(max(share, 0.0), 1.0)
    return start ** (1 - share) * end**share


def _rescale(hint: Any, value: Any, factor: float, like: Any) -> Any:
    marker = _marker(hint)
    if marker is not None and isinstance(value, int) and value > 0:
        scaled = max(rounded(value * factor), marker.lowest(value, factor))
        return like if isinstance(like, int) and _alike(marker, value, like, factor) else scaled
    if is_dataclass(value) and not isinstance(value, type):
        hints = hints_of(type(value))
        old = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
        new = {name: _rescale(hints[name], item, factor, getattr(like, name, None)) for name, item in old.items()}
        try:
            return replace(value, **{name: item for name, item in new.items() if item is not old[name]})
        except ValueError as error:
            raise BadInput(f"scaling the steps by {factor:g}: {error}") from error
    inner = _element_hints(hint, value)
    if isinstance(value, tuple):
        likes = like if isinstance(like, tuple) and len(like) == len(value) else [None] * len(value)
        return tuple(_rescale(kind, item, factor, other) for kind, item, other in zip(inner, value, likes, strict=True))
    if isinstance(value, dict):
        like_of = like if isinstance(like, dict) else {}
        return {key: _rescale(inner[0], item, factor, like_of.get(key)) for key, item in value.items()}
    return value


def _alike(marker: StepCount, value: int, like: int, factor: float) -> bool:
    """Whether one count may be rounded from what the other, times `factor`, was rounded from."""
    slack = (1 + factor) / 2
    lowest = value * factor - slack
    if value <= marker.floor:  # held there, or by its stretch below it, or at 1
        lowest = marker.floor if math.isinf(marker.stretch) else 1 if value == 1 else min(marker.floor, lowest)
    return lowest <= like <= value * factor + slack


def _alternatives(hint: Any) -> list[Any]:
    """The members of a hint with unions taken apart; their marks stay on them."""
    if get_origin(hint) in (Union, types.UnionType):
        return [member for arg in get_args(hint) for member in _alternatives(arg)]
    if get_origin(hint) is Annotated and get_origin(get_args(hint)[0]) in (Union, types.UnionType):
        inner, *marks = get_args(hint)
        return [Annotated[(member, *marks)] for member in _alternatives(inner)]
    return [hint]


def _marker(hint: Any) -> StepCount | None:
    for member in _alternatives(hint):
        if get_origin(member) is Annotated:
            for mark in get_args(member)[1:]:
                if isinstance(mark, StepCount):
                    return mark
    return None


def _element_hints(hint: Any, value: Any) -> list[Any]:
    """A hint for each element of a tuple, or one for all values of a dict."""
    count = len(value) if isinstance(value, tuple) else 1
    for member in _alternatives(hint):
        bare = get_args(member)[0] if get_origin(member) is Annotated else member
        args = get_args(bare)
        if get_origin(bare) is dict and isinstance(value, dict):
            return [args[1]]
        if get_origin(bare) is tuple and isinstance(value, tuple):
            return [args[0]] * count if args[1:] == (...,) else list(args)
    return [Any] * count


@dataclass(frozen=True)
class LearningRate:
    """A learning rate."""

    start: float
    """Learning rate at the first step."""

    end: float | None = None
    """Learning rate at the last step, reached along a straight line in the logarithm; constant if unset."""

    def __post_init__(self) -> None:
        if self.start < 0 or (self.end is not None and (self.end <= 0 or self.start == 0)):
            raise BadInput(f"a rate goes from {self.start} to {self.end}; rates must be positive (a constant may be 0)")

    def at(self, index: int, steps: int) -> float:
        """The rate of step `index` of 1..`steps`."""
        return self.start if self.end is None else log_linear(self.start, self.end, index / steps)
