"""Whether two values are equal, and whether a part leaves its inputs as they were, with the tensors within them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.registry import Component

C = TypeVar("C", bound=Component)
PLAIN_TYPES = (bool, int, float, str, bytes, type(None), Path)


def leaves(value: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """Path and value of every tensor, array and plain value within dataclasses, dicts, lists and tuples.

    Functions and other objects are left out.
    """
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from leaves(getattr(value, field.name), f"{at}.{field.name}")
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from leaves(item, f"{at}[{key!r}]")
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            yield from leaves(item, f"{at}[{i}]")
    elif isinstance(value, (*PLAIN_TYPES, torch.Tensor, np.ndarray)):
        yield at, value


def difference(first: Any, second: Any) -> str | None:
    """Path of the first leaf in which two values differ, in kind, type, shape or content; None where they are equal."""
    one, two = dict(leaves(first, "")), dict(leaves(second, ""))
    for path in (*one, *two):
        if path not in one or path not in two or not _equal(one[path], two[path]):
            return path.lstrip(".")
    return None


def assert_tensor(what: str, value: object) -> None:
    """AssertionError if what somebody gave is no tensor."""
    assert isinstance(value, Tensor), f"{what} gives {type(value).__name__}, not a tensor"


def assert_same(what: str, first: Any, second: Any, remedy: str) -> None:
    """AssertionError if two results of the same call differ.

    Args:
        what: Who gave them, such as "Trim.edit".
        first: One result.
        second: The other.
        remedy: What to do, after a semicolon.
    """
    if type(first) is not type(second):
        raise AssertionError(f"{what} is not repeatable: {type(first).__name__}, then {type(second).__name__}")
    if (path := difference(first, second)) is not None:
        raise AssertionError(f"{what} is not repeatable{f': {path} differs' if path else ''}; {remedy}")


def twin(part: C) -> C:
    """Another instance of the same settings, as in a run that is resumed."""
    return replace(part)  # type: ignore[type-var]  # all components are dataclasses, `Component` itself is none


@contextmanager
def unchanged(what: str, **inputs: Any) -> Iterator[None]:
    """Within, nothing may change these inputs; AssertionError that names the first that did.

    Args:
        what: Who is called within, such as "Trim.edit".
        inputs: By the name that the message calls them.
    """
    before = {path: _copied(value) for path, value in _named(inputs)}
    yield
    for path, value in _named(inputs):
        assert path not in before or _equal(before[path], value), f"{what} changed its input {path}; work on a copy"


def _named(inputs: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in inputs.items():
        yield from leaves(value, name)


def _copied(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.detach().clone()
    return value.copy() if isinstance(value, np.ndarray) else value


def _equal(one: Any, two: Any) -> bool:
    if type(one) is not type(two):
        return False
    if isinstance(one, torch.Tensor):
        same = one.dtype == two.dtype and one.shape == two.shape
        return same and bool(torch.allclose(one, two, rtol=0, atol=0, equal_nan=one.is_floating_point()))
    if isinstance(one, np.ndarray):
        same = one.dtype == two.dtype and one.shape == two.shape
        return same and np.array_equal(one, two, equal_nan=one.dtype.kind == "f")
    return one == two or (one != one and two != two)


def refuses(what: str, act: Callable[[], object]) -> bool:
    """Whether a call ends in BadInput of one line; AssertionError for another error."""
    try:
        act()
    except BadInput as error:
        assert "\n" not in str(error), f"{what} has a message of several lines"
        return True
    except Exception as error:
        raise AssertionError(f"{what} raises {type(error).__name__} in place of BadInput: {error}") from error
    return False
