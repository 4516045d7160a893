"""Changing one value deep inside a recipe, by the path that the flags use too."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from surfkit.core.check import BadInput
from surfkit.core.fit import fit
from surfkit.core.hints import hints_of

T = TypeVar("T")


def evolve(node: T, path: str, value: Any) -> T:
    """A copy of `node` with the value at a dotted path replaced.

    Args:
        node: Nested frozen dataclasses, dicts and tuples.
        path: Field names, dict keys and tuple positions: "tune.prune.0.ratio". A dict may gain a new last key, and a
            tuple a new last position.
        value: What to put there; a part may be given by its name, "trim". None for the last key of a dict takes it out.

    Raises:
        BadInput: No such place, or the value is not allowed there.
    """
    return _evolve(node, path.split("."), 0, value)


def differences(before: Any, after: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted paths and new values of what differs between plain data of two recipes, as deep inside as it can be named.

    A part of another kind, a list of another length and a new key are named as a whole; None stands for a key that is
    gone.
    """
    if isinstance(before, dict) and isinstance(after, dict) and before.get("use") == after.get("use"):
        pairs = [(key, before.get(key), after.get(key)) for key in {**before, **after}]
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        pairs = [(str(at), *pair) for at, pair in enumerate(zip(before, after, strict=True))]
    else:
        pairs = []
        if before != after:
            yield path, after
    for key, old, new in pairs:
        yield from differences(old, new, f"{path}.{key}" if path else key)


def _evolve(node: Any, path: list[str], depth: int, value: Any) -> Any:
    if depth == len(path):
        return value
    name, here = path[depth], ".".join(path[:depth]) or type(node).__name__
    last = depth + 1 == len(path)
    if isinstance(node, dict):
        if name not in node and (not last or value is None):
            raise BadInput(f"{here} has no {name!r}; it has {', '.join(node) or 'nothing'}")
        if last and value is None:
            return {key: item for key, item in node.items() if key != name}
        return node | {name: value if last else _evolve(node[name], path, depth + 1, value)}
    if isinstance(node, tuple):
        if not (name.isdecimal() and int(name) < len(node) + last):
            raise BadInput(f"{here} has no position {name!r}; {_positions(node)}")
        at = int(name)
        if at == len(node):
            return (*node, value)
        return (*node[:at], _evolve(node[at], path, depth + 1, value), *node[at + 1 :])
    if not is_dataclass(node):
        raise BadInput(f"{here} is {node!r}, which has no {name!r} inside; set {here} itself")
    names = [field.name for field in fields(node) if field.init]
    if name not in names:
        raise BadInput(f"{here} has no {name!r}; it has {', '.join(names) or 'no settings'}")
    changed = _evolve(getattr(node, name), path, depth + 1, value)
    owner: type = type(node)
    changed = fit(hints_of(owner)[name], changed, ".".join(path[: depth + 1]))
    try:
        return replace(node, **{name: changed})  # type: ignore[type-var]  # is_dataclass is true of classes too
    except ValueError as error:
        raise BadInput(f"{'.'.join(path)}: {error}") from error


def _positions(node: tuple[Any, ...]) -> str:
    return f"its positions are 0 to {len(node) - 1}" if node else "it is empty"
