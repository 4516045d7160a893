"""The slots of a command: the places whose part the user chooses, as in `pretrain.densify:adc`."""

from __future__ import annotations

import difflib
import os
import types
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin

from surfkit.cli.component_overrides import open_places, with_parts
from surfkit.cli.recipes import chosen_name, chosen_recipe, recipes
from surfkit.cli.tables import chosen_table, tables
from surfkit.core.check import BadInput
from surfkit.core.hints import hints_of
from surfkit.core.registry import Component, components, kebab, unknown

Slots = dict[str, tuple[str, ...]]
WHOLE_PREFIXES = ("recipe:", "table:")
"""What a command is about as a whole, chosen before any part."""


def slots(command: type, argv: Sequence[str]) -> Slots:
    """The names that may follow each slot, by slot; of the recipe that `argv` chooses, if the command takes one."""
    found: Slots = {}
    for name, hint in hints_of(command).items():
        if get_origin(hint) is Annotated and chosen_recipe in get_args(hint):
            known = recipes(argv)
            found["recipe"] = tuple(known)
            if (chosen := known.get(chosen_name(argv) or "")) is not None:
                found |= open_places(chosen, argv) | _below(type(chosen), chosen, "")
        elif get_origin(hint) is Annotated and chosen_table in get_args(hint):
            found["table"] = tuple(tables(argv))
        elif get_origin(hint) is Annotated and any(getattr(mark, "name", None) == "" for mark in get_args(hint)[1:]):
            found |= slots(get_args(hint)[0], argv)  # its settings are typed as if they were the command's own
        else:
            found |= _below(hint, getattr(command, name, None), _flag(name))
    return found


def flags_as_choices(command: type, argv: Sequence[str]) -> list[str]:
    """The same words, with `--SLOT NAME`, `--SLOT=NAME` and `--SLOT SLOT:NAME` rewritten to `SLOT:NAME`."""
    known, found, rest = slots(command, argv), [], list(argv)
    while rest:
        word = rest.pop(0)
        flag, equals, name = word.partition("=")
        if flag.startswith("--") and flag[2:] in known and (equals or (rest and not rest[0].startswith("-"))):
            name = name if equals else rest.pop(0)
            word = f"{flag[2:]}:{name.removeprefix(f'{flag[2:]}:')}"
        found.append(word)
    return found


def choices_first(command: type, argv: Sequence[str]) -> list[str]:
    """The same words in the order that tyro needs: the recipe, choices from the outside in, then the rest.

    A setting before the choice it belongs to would choose the default part. A choice without alternatives is left out:
    tyro sees no choice there.

    Raises:
        BadInput: A word chooses a part that is not there; an option with many values would take it for one of them.
    """
    known = slots(command, argv)
    done = handled(argv) if "recipe" in known else set()
    argv = [word for word in argv if word not in done]
    names = {word: known.get(word.partition(":")[0], ()) for word in argv}
    for before, word in zip(["", *argv], argv, strict=False):
        wrong = names[word] and ":" in word and word.partition(":")[2] not in names[word]
        if wrong and not before.startswith("--") and not Path(word).exists():
            raise BadInput(explain_choice(command, word, argv) or word)
    choices = [word for word in argv if word.partition(":")[2] in names[word]]
    others = [word for word in argv if word.partition(":")[2] not in names[word]]
    choices.sort(key=lambda word: (not word.startswith(WHOLE_PREFIXES), word.partition(":")[0].count(".")))
    done = handled(argv) if "recipe" in known else set()
    return [word for word in choices if len(names[word]) > 1 and word not in done] + [
        w for w in others if w not in done
    ]


def handled(argv: Sequence[str]) -> set[str]:
    """The words that have changed the chosen recipe already."""
    recipe = recipes([word for word in argv if word.startswith("recipe:")]).get(chosen_name(argv) or "")
    return set() if recipe is None else with_parts(recipe, argv)[1]


def explain_choice(command: type, word: str, argv: Sequence[str]) -> str | None:
    """Why `SLOT:NAME` does not fit, in one line; None if the word is not of that form."""
    slot, colon, name = word.partition(":")
    if not colon:
        return None
    known = slots(command, argv)
    if slot not in known:
        near = difflib.get_close_matches(slot, known, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        return f"nothing to choose at {slot!r}; {hint}choices are made at {', '.join(known) or 'no place'}"
    if name not in known[slot]:
        more = {"recipe": "; or name a file, recipe:FILE.json", "table": "; or name a file, FILE.json or FILE.py"}
        if name.isdecimal():
            more["features"] = f"; how many are kept is --max-features {name}"
        return unknown(slot, name, known[slot]) + more.get(slot, "")
    return f"{slot} is chosen twice: {', '.join(w for w in argv if w.startswith(slot + ':'))}; keep one"


def explain_bare(command: type, word: str, argv: Sequence[str]) -> str | None:
    """What a word without a flag and without a slot was meant to be, in one line; None if nothing is known.

    It may be the name of a recipe or of another part without its slot, or a path without its flag.
    """
    known = slots(command, argv)
    if slot := next((slot for slot in (*_whole(known), *known) if word in known[slot]), None):
        return f"unexpected {word!r}; did you mean {slot}:{word}?"
    if "data" in hints_of(command) and (os.sep in word or Path(word).exists()):
        return f"unexpected {word!r}; did you mean --data {word}?"
    for slot in _whole(known):
        if near := difflib.get_close_matches(word, known[slot], n=1):
            return f"unexpected {word!r}; did you mean {slot}:{near[0]}?"
    return None


def bare_words(command: type, argv: Sequence[str]) -> list[str]:
    """The words that stand alone: no flag, no choice, and not behind a flag, whose value they would be."""
    known = slots(command, argv)
    pairs = zip(["", *argv], argv, strict=False)
    alone = (word for before, word in pairs if not word.startswith("-") and not before.startswith("--"))
    return [word for word in alone if word.partition(":")[0] not in known or ":" not in word]


def _whole(known: Slots) -> list[str]:
    return [mark.rstrip(":") for mark in WHOLE_PREFIXES if mark.rstrip(":") in known]


def _below(hint: Any, value: Any, path: str) -> Slots:
    """Slots at and below a setting, given its type and its value."""
    kinds = list(members(hint))
    classes = [m for m in kinds if isinstance(m, type) and get_origin(m) is None]  # tuple[int] is a type in 3.10
    bases = [cls for cls in classes if issubclass(cls, Component)]
    optional = type(None) in kinds
    found: Slots = {}
    if bases and path:
        found[path] = (*components(bases[0]), *["none"] * optional)
    elif optional and (plain := [cls for cls in classes if is_dataclass(cls)]):
        found[path] = (kebab(plain[0].__name__), "none")
    if is_dataclass(value) and not isinstance(value, type):
        hints = hints_of(type(value))
        for field in fields(value):
            found |= _below(hints[field.name], getattr(value, field.name), join(path, _flag(field.name)))
    elif isinstance(value, tuple) and (inner := [get_args(m)[0] for m in kinds if get_origin(m) is tuple]):
        for at, item in enumerate(value):
            found |= _below(inner[0], item, join(path, str(at)))
        if bases := [m for m in members(inner[0]) if isinstance(m, type) and issubclass(m, Component)]:
            found[join(path, str(len(value)))] = tuple(components(bases[0]))  # one more
    elif isinstance(value, dict):  # an entry keeps its class, but there may be slots inside
        for key, item in value.items():
            found |= _below(Any, item, join(path, _flag(key)))
    return found


def members(hint: Any) -> Iterator[Any]:
    """The types in a hint, marks and unions taken apart."""
    if get_origin(hint) is Annotated:
        yield from members(get_args(hint)[0])
    elif get_origin(hint) in (Union, types.UnionType):
        for arg in get_args(hint):
            yield from members(arg)
    else:
        yield hint


def join(path: str, name: str) -> str:
    """The dotted path of a setting inside another."""
    return f"{path}.{name}" if path else name


def _flag(name: str) -> str:
    return name.replace("_", "-")
