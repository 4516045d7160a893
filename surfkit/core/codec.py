"""Recipes to plain data and back. A component carries its registered name under `use`."""

from __future__ import annotations

import json
import math
import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from surfkit.core.check import BadInput
from surfkit.core.files import replacing
from surfkit.core.hints import hints_of
from surfkit.core.registry import Component, components, find, name_of

_JSON_NAMES = {dict: "an object", list: "a list", str: "text", bool: "true or false", type(None): "null"}
_NON_FINITE = ("inf", "-inf", "nan")
"""How floats that JSON lacks are written."""
MAX_NESTING_DEPTH = 100
"""Objects and lists within one another that are read: more has no meaning here, and recursion would end at a number
that depends on who calls."""


def dump(value: Any, at: str = "") -> Any:
    """Plain data (what JSON has) for dataclasses, dicts, tuples, paths and scalars; every default is written out.

    `at` is the dotted path of the value, for messages.
    """
    if is_dataclass(value) and not isinstance(value, type):
        tag = {"use": name_of(value)} if isinstance(value, Component) else {}
        return tag | {
            field.name: dump(getattr(value, field.name), _join(at, field.name)) for field in fields(value) if field.init
        }
    if isinstance(value, dict):
        return {str(key): dump(item, _join(at, key)) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [dump(item, _join(at, i)) for i, item in enumerate(value)]
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    came = f"{place(at)}{type(value).__name__} cannot be saved"
    raise TypeError(f"{came}; settings are dataclasses, tuples, dicts and plain values")


def load(hint: Any, data: Any, at: str = "") -> Any:
    """The value that `dump` gave `data` for, checked against a type hint.

    Args:
        hint: What the value must be.
        data: From JSON.
        at: Dotted path of `data` in its file, for messages; "" at the top.
    """
    kind, args = get_origin(hint), get_args(hint)
    if kind is Annotated:
        return load(args[0], data, at)
    if kind in (Union, types.UnionType):
        return _load_union(args, data, at)
    if kind is Literal:
        if any(data == arg and type(data) is type(arg) for arg in args):
            return data
        raise unfit(at, " or ".join(map(repr, args)), data)
    if kind is tuple:
        return _load_tuple(args, data, at)
    if kind is dict:
        _require(dict, data, at)
        return {key: load(args[1], item, _join(at, key)) for key, item in data.items()}
    if isinstance(hint, type) and issubclass(hint, Component):
        return _load_component(hint, data, at)
    if isinstance(hint, type) and is_dataclass(hint):
        return _load_dataclass(hint, data, at)
    return _load_scalar(hint, data, at)


def read_json(path: Path, hint: Any) -> Any:
    """The value in a JSON file, checked against a type hint; `Any` takes it as it is.

    Raises:
        BadInput: Names the file, the place in it, what came and what is allowed.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise BadInput(f"{path}: no such file") from error
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:  # bytes that are no UTF-8, a name with a zero in it
        raise BadInput(f"{path}: not JSON: {error}") from error
    try:
        return load(hint, from_json(text))
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from error


def from_json(text: str) -> Any:
    """What a JSON text says. All JSON that is not of this process comes through here.

    Raises:
        BadInput: Not JSON, a key twice in an object, or nested more than `MAX_NESTING_DEPTH` deep.
    """
    try:
        data = json.loads(text, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        raise BadInput(f"not JSON: {error.msg} at line {error.lineno}, column {error.colno}") from error
    except RecursionError as error:
        raise BadInput("not JSON: nested too deeply") from error
    except ValueError as error:  # BadInput, a number of thousands of digits
        raise BadInput(f"not JSON: {error}") from error
    inner = [data]
    for _ in range(MAX_NESTING_DEPTH):
        inner = [item for one in inner for item in _items(one) if isinstance(item, (dict, list))]
        if not inner:
            return data
    raise BadInput(f"not JSON: nested too deeply; {MAX_NESTING_DEPTH} levels are allowed")


def read_keys(path: Path, hints: Mapping[str, Any], remedy: str) -> dict[str, Any]:
    """The values of some keys of the object in a JSON file, each checked against its type hint; others do not matter.

    Raises:
        BadInput: Names the file, the place in it, what came, what is allowed, and the remedy.
    """
    try:
        data = read_json(path, dict[str, Any])
        return {key: load(hint, data.get(key), f"{path}: {key}") for key, hint in hints.items()}
    except BadInput as error:
        raise BadInput(f"{error}; {remedy}") from error


def write_json(path: Path, value: Any) -> None:
    """Save a value as JSON; the file is whole or not there, also when the process dies."""
    write_text(path, json.dumps(dump(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Save text; the file is whole or not there, also when the process dies."""
    with replacing(path) as file:
        file.write(text.encode("utf-8", "backslashreplace"))  # half a character, as JSON writes it too


def _load_union(args: tuple[Any, ...], data: Any, at: str) -> Any:
    if data is None and type(None) in args:
        return None
    members = [arg for arg in args if arg is not type(None)]
    if len(members) == 1:
        return load(members[0], data, at)
    errors = []
    for member in members:
        try:
            return load(member, data, at)
        except BadInput as error:
            errors.append(str(error))
    raise BadInput("; or ".join(errors))


def _load_tuple(args: tuple[Any, ...], data: Any, at: str) -> tuple[Any, ...]:
    _require(list, data, at)
    hints = args[:1] * len(data) if args[1:] == (...,) else args
    if len(hints) != len(data):
        raise BadInput(f"{place(at)}expected a list of {len(hints)}, got {len(data)} elements")
    return tuple(load(hint, item, _join(at, i)) for i, (hint, item) in enumerate(zip(hints, data, strict=True)))


def _load_component(base: type[Component], data: Any, at: str) -> Any:
    _require(dict, data, at)
    rest = dict(data)
    name = rest.pop("use", None)
    if not isinstance(name, str):
        came = "without" if name is None else f"with {name!r} as"
        raise BadInput(
            f'{place(at)}a {base.__name__} {came} its name; add "use": one of {", ".join(components(base)) or "none"}'
        )
    try:
        cls = find(base, name)
    except BadInput as error:
        raise BadInput(f"{place(at)}{error}") from error
    return _load_dataclass(cls, rest, at)


def _load_dataclass(cls: type, data: Any, at: str) -> Any:
    """A dataclass; one whose settings have changed has a class method `upgraded`: today's JSON from that of before."""
    _require(dict, data, at)
    if upgraded := getattr(cls, "upgraded", None):
        data = upgraded(data)
    known = {field.name: field for field in fields(cls) if field.init}
    if wrong := [key for key in data if key not in known]:
        raise BadInput(
            f"{_join(at, wrong[0])}: unknown setting; {cls.__name__} has {', '.join(known) or 'no settings'}"
        )
    needed = [name for name, f in known.items() if f.default is MISSING and f.default_factory is MISSING]
    if missing := [name for name in needed if name not in data]:
        raise BadInput(f"{place(at)}{', '.join(missing)} missing; {cls.__name__} needs {', '.join(needed)}")
    hints = hints_of(cls)
    values = {key: load(hints[key], item, _join(at, key)) for key, item in data.items()}
    try:
        return cls(**values)
    except ValueError as error:
        raise BadInput(f"{place(at)}{error}") from error


def _load_scalar(hint: Any, data: Any, at: str) -> Any:
    if hint is Any:
        return data
    if hint is type(None):
        if data is None:
            return None
        raise unfit(at, "null", data)
    if hint is float:
        if isinstance(data, float) or (isinstance(data, int) and not isinstance(data, bool) and abs(data) < 2**1023):
            return float(data)
        if isinstance(data, str) and data in _NON_FINITE:
            return float(data)
        raise unfit(at, "a number", data)
    if hint is Path:
        return Path(_require(str, data, at))
    if hint is int:
        if isinstance(data, int) and not isinstance(data, bool) and abs(data) < 2**63:
            return data
        raise unfit(at, "a whole number", data)
    if hint in (str, bool):
        return _require(hint, data, at)
    raise TypeError(f"{place(at)}settings of type {hint} cannot be loaded from JSON")


def _require(kind: type, data: Any, at: str) -> Any:
    """`data` if it is of a JSON kind; tuples pass for lists."""
    if isinstance(data, (list, tuple) if kind is list else kind):
        return data
    raise unfit(at, _JSON_NAMES[kind], data)


def unfit(at: str, wanted: str, data: Any) -> BadInput:
    """The error of a value that is not what is wanted at a place."""
    shown = json.dumps(data, default=repr)
    return BadInput(f"{place(at)}expected {wanted}, got {shown if len(shown) <= 60 else shown[:57] + '...'}")


def _items(data: Any) -> Any:
    return data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object, refused if a key is there twice: one of the two would be lost without a word."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise BadInput(f"{key!r} is there twice in one object")
        found[key] = value
    return found


def place(at: str) -> str:
    """How a message begins that is about a dotted path; "" for none."""
    return f"{at}: " if at else ""


def _join(at: str, key: object) -> str:
    return f"{at}.{key}" if at else str(key)
