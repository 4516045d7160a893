"""Values that a program gives for settings: checked against the type hint, and made what is saved."""

from __future__ import annotations

import types
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from surfkit.core.check import BadInput
from surfkit.core.codec import load, place, unfit
from surfkit.core.hints import hints_of
from surfkit.core.registry import Component, find, unknown

T = TypeVar("T")


def fit(hint: Any, value: Any, at: str = "") -> Any:
    """The value of a setting: a part may be given by its name, a tuple as a list, a path as text, a number as numpy's.

    Args:
        hint: What it must be.
        value: What came.
        at: Its dotted path, for messages; "" for none.

    Raises:
        BadInput: It is of another type; names the place, what came and what is allowed.
    """
    kind, args = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return fit(args[0], value, at)
    if kind in (Union, types.UnionType):
        return _fit_union(args, value, at)
    if kind is tuple and isinstance(value, Iterable) and not isinstance(value, (str, Mapping)):
        value = tuple(value)  # also of an array
        hints = args[:1] * len(value) if args[1:] == (...,) else args
        if len(hints) != len(value):
            raise BadInput(f"{place(at)}expected {len(hints)} values, got {len(value)}")
        return tuple(fit(each, item, f"{at}.{i}") for i, (each, item) in enumerate(zip(hints, value, strict=True)))
    if kind is dict and isinstance(value, Mapping):
        return {fit(args[0], key, f"{at}: its key"): fit(args[1], item, f"{at}.{key}") for key, item in value.items()}
    if isinstance(hint, type) and (is_dataclass(hint) or issubclass(hint, Component)):
        return _fit_part(hint, value, at)
    if hint is Path:
        if not isinstance(value, (str, Path)):
            raise unfit(at, "a path", value)
        return Path(value)
    return load(hint, _plain(value), at)


def settings_of(cls: type[T], given: Mapping[str, Any], where: str, what: str = "setting") -> T:
    """A dataclass of settings from those that a call gives by name.

    Args:
        cls: The dataclass.
        given: Values by name; the others have their defaults.
        where: The function that was called, for messages.
        what: What a setting is called there.

    Raises:
        BadInput: There is none of this name, or a value is of another type or not allowed.
    """
    known = [each.name for each in fields(cls) if each.init]  # type: ignore[arg-type]  # a dataclass
    for name in given:
        if name not in known:
            raise BadInput(f"{where}: {unknown(what, name, known)}")
    plain: type = cls
    hints = hints_of(plain)
    return cls(**{name: fit(hints[name], value, f"{where}: {name}") for name, value in given.items()})


def _fit_union(args: tuple[Any, ...], value: Any, at: str) -> Any:
    if value is None and type(None) in args:
        return None
    errors = []
    for member in [arg for arg in args if arg is not type(None)]:
        try:
            return fit(member, value, at)
        except BadInput as error:
            errors.append(str(error))
    raise BadInput("; or ".join(errors))


def _fit_part(cls: type, value: Any, at: str) -> Any:
    if isinstance(value, cls):
        return value
    if not issubclass(cls, Component):
        raise unfit(at, f"a {cls.__name__}", value)
    if not isinstance(value, str):
        raise unfit(at, f"a {cls.__name__}, or the name of one", value)
    try:
        return find(cls, value)()
    except BadInput as error:
        raise BadInput(f"{place(at)}{error}") from error


def _plain(value: Any) -> Any:
    """A number of numpy as Python's, a path as text; anything else as it is."""
    if isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, Path):
        return str(value)
    return int(value) if isinstance(value, Integral) else float(value) if isinstance(value, Real) else value
