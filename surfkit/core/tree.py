"""Changing one value deep inside a recipe, by the path that the flags use too."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from surfkit.core.check import BadInput

T = TypeVar("T")


def evolve(node: T, path: str, value: Any) -> T:
    """A copy of `node` with the value at a dotted path replaced.

    Args:
        node: Nested frozen dataclasses, dicts and tuples.
        path: Field names, dict keys and tuple positions: "tune.prune.0.ratio". A dict may gain a new last key.
        value: What to put there.
    """
    return _evolve(node, path.split("."), 0, value)


def _evolve(node: Any, path: list[str], depth: int, value: Any) -> Any:
    if depth == len(path):
        return value
    name, here = path[depth], ".".join(path[:depth]) or type(node).__name__
    last = depth + 1 == len(path)
    if isinstance(node, dict):
        if name not in node and not last:
            raise BadInput(f"{here} has no {name!r}; it has {', '.join(node) or 'nothing'}")
        return node | {name: value if last else _evolve(node[name], path, depth + 1, value)}
    if isinstance(node, tuple):
        if not (name.isdecimal() and int(name) < len(node)):
            raise BadInput(f"{here} has no position {name!r}; {_positions(node)}")
        at = int(name)
        return (*node[:at], _evolve(node[at], path, depth + 1, value), *node[at + 1 :])
    if not is_dataclass(node):
        raise BadInput(f"{here} is {node!r}, which has no {name!r} inside; set {here} itself")
    names = [field.name for field in fields(node) if field.init]
    if name not in names:
        raise BadInput(f"{here} has no {name!r}; it has {', '.join(names) or 'no settings'}")
    changed = {name: _evolve(getattr(node, name), path, depth + 1, value)}
    try:
        return replace(node, **changed)
    except ValueError as error:
        raise BadInput(f"{'.'.join(path)}: {error}") from error


def _positions(node: tuple[Any, ...]) -> str:
    return f"its positions are 0 to {len(node) - 1}" if node else "it is empty"
