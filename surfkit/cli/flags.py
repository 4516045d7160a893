"""The flags of a command line, and what a flag that does not exist was probably meant to be."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, get_args, get_origin

import tyro

from surfkit.cli.recipes import chosen_name, chosen_recipe, recipes
from surfkit.cli.slots import join, members, slots
from surfkit.core.hints import hints_of
from surfkit.core.registry import Component, components, kebab

MIN_LIKENESS = 0.75
"""Least similarity of two flags, from 0 to 1, for one to be suggested in place of the other."""


def flags(command: type, argv: Sequence[str]) -> list[str]:
    """All flags of a command, such as "--pretrain.steps", with the recipe and the parts that `argv` chooses."""
    return [flag for flag, _ in _flags_of(command, command, "", argv)]


def negations_with_their_flag(command: type, argv: Sequence[str]) -> list[str]:
    """The same words, with `--PART.NAME` before each `--PART.no-NAME`: tyro finds a part that nobody chose, and so is
    the default one, by the former alone. What comes last counts."""
    if not any(".no-" in word for word in argv):
        return list(argv)
    switches = {flag for flag, hint in _flags_of(command, command, "", argv) if bool in members(hint)}
    turned_on = [word.replace(".no-", ".") if ".no-" in word else "" for word in argv]
    return [part for flag, word in zip(turned_on, argv, strict=True) for part in ([flag] * (flag in switches) + [word])]


def explain_flag(command: type, flag: str, argv: Sequence[str]) -> str | None:
    """What to do about a flag that does not exist, in one line; None where nothing is similar."""
    if bringing := owners(command, flag, argv):
        return f"{flag} does not apply here; it belongs to {' or '.join(bringing[:3])}, which is not chosen"
    known = {name: name.removeprefix("--").rpartition(".")[2] for name in flags(command, argv)}
    near = difflib.get_close_matches(flag, known, n=2, cutoff=MIN_LIKENESS)
    if not near:  # perhaps the path before its last name was left out, or is wrong
        last = difflib.get_close_matches(flag.removeprefix("--").rpartition(".")[2], known.values(), 1, MIN_LIKENESS)
        near = [name for name, its_last in known.items() if its_last in last][:3]
    return f"no option {flag}; perhaps you meant {' or '.join(near)}" if near else None


def owners(command: type, flag: str, argv: Sequence[str]) -> list[str]:
    """The choices `SLOT:NAME` that would bring a flag."""
    found = []
    for slot, names in slots(command, argv).items():
        others = [word for word in argv if not word.startswith(f"{slot}:")]
        if flag.startswith(f"--{slot}."):
            found += [f"{slot}:{name}" for name in names if flag in flags(command, [*others, f"{slot}:{name}"])]
    return sorted(found)


def _flags_of(owner: Any, kind: type, path: str, argv: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """The flags of all fields of a class, with the type of each; `owner` has their values: an instance, or the class
    for its defaults."""
    hints = hints_of(kind)
    for field in fields(kind):
        hint = hints[field.name]
        marks = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        if {tyro.conf.Positional, tyro.conf.Suppress} & {mark for mark in marks if mark.__hash__}:
            continue
        named = [mark.name for mark in marks if getattr(mark, "name", None) is not None]
        below = join(path, named[0] if named else field.name.replace("_", "-")) if named != [""] else path
        if chosen_recipe in marks:
            value = recipes(argv).get(chosen_name(argv) or "")
        elif owner is kind:
            value = field.default_factory() if callable(field.default_factory) else field.default
        else:
            value = getattr(owner, field.name)
        yield from _flags_in(hint, value, below, argv)


def _flags_in(hint: Any, value: Any, path: str, argv: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """The flags of one setting of that type and value, with their types; its own flag would be `--path`."""
    chosen = [word.removeprefix(f"{path}:") for word in argv if path and word.startswith(f"{path}:")]
    kinds = [kind for kind in members(hint) if isinstance(kind, type) and get_origin(kind) is None]
    kinds = [kind for kind in kinds if is_dataclass(kind) or issubclass(kind, Component)]
    if chosen and kinds:
        value = _made(kinds, chosen[-1])
    if is_dataclass(value):
        yield from _flags_of(value, type(value), path, argv)
    elif items := _components_in(value):
        held = [get_args(kind)[-1] if isinstance(value, dict) else get_args(kind)[0] for kind in members(hint)]
        for key, item in items.items():
            yield from _flags_in(held[0], item, join(path, str(key).replace("_", "-")), argv)
    elif path and not kinds:
        yield f"--{path}", hint


def _components_in(value: Any) -> dict[Any, Any]:
    """The components in a dict or a tuple, by key or position; none for another value."""
    items = value if isinstance(value, dict) else dict(enumerate(value)) if isinstance(value, tuple) else {}
    return items if any(map(is_dataclass, items.values())) else {}


def _made(kinds: list[type], name: str) -> Any:
    """A part with its default settings, by the name that a user chooses it by; None if there is none."""
    for kind in kinds:
        named = components(kind) if issubclass(kind, Component) else {kebab(kind.__name__): kind}
        if name in named:
            return named[name]()
    return None
