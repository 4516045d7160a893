"""Parts of a recipe that come, change or go by a word: `prune.0:trim`, `losses.depth:depth`, `losses.normal:none`.

tyro swaps what is there; an entry of a dict never changes its class for it, and nothing is added or removed. So these
words change the recipe first, and tyro then parses the rest against what it has become.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, get_args, get_origin

from surfkit.core.hints import hints_of
from surfkit.core.registry import Component, components, find
from surfkit.core.tree import evolve


@dataclass(frozen=True)
class SlotPath:
    """A tuple or dict of components inside a recipe, and one position or key there.

    Attributes:
        path: Of the container, as `evolve` takes it.
        inside: The container.
        key: Position or key.
        base: What kind of component it holds.
    """

    path: str
    inside: tuple | dict
    key: Any
    base: type[Component]

    @property
    def names(self) -> tuple[str, ...]:
        """What may be put there; "none" takes away what is."""
        there = self.key in self.inside if isinstance(self.inside, dict) else self.key < len(self.inside)
        return (*components(self.base), *["none"] * there)

    def put(self, name: str) -> tuple | dict:
        """The container with a new default part of that name at the place, or without what is there."""
        if isinstance(self.inside, dict):
            left = {key: part for key, part in self.inside.items() if key != self.key}
            return left if name == "none" else self.inside | {self.key: find(self.base, name)()}
        part = () if name == "none" else (find(self.base, name)(),)
        return (*self.inside[: self.key], *part, *self.inside[self.key + 1 :])


def with_parts(recipe: Any, argv: Sequence[str]) -> tuple[Any, set[str]]:
    """The recipe after the words that add or remove parts, or change entries of dicts; and the words tyro must not see.

    A word that swaps a part of a tuple is left to tyro, and one that adds a part is seen by both: its settings follow.
    """
    done: set[str] = set()
    for word in argv:
        slot, _, name = word.partition(":")
        if (place := _place(recipe, slot)) is None:
            continue
        keyed = isinstance(place.inside, dict)
        if name in place.names and (keyed or name == "none" or place.key == len(place.inside)):
            recipe = evolve(recipe, place.path, place.put(name))
            done |= {word} if keyed or name == "none" else set()
    return recipe, done


def open_places(recipe: Any, argv: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Slots of the words in `argv` that name a place in a tuple or dict of the recipe, and what may be put there."""
    named = [slot for slot, colon, _ in (word.partition(":") for word in argv) if colon]
    return {slot: place.names for slot in named if (place := _place(recipe, slot))}


def _place(recipe: Any, slot: str) -> SlotPath | None:
    """Where the last step of a slot's path lies, if in a tuple or dict of components and not beyond its end."""
    *path, last = slot.split(".")
    node, hint, taken = recipe, Any, []
    for step in path:
        if is_dataclass(kind := type(node)) and (field := step.replace("-", "_")) in (hints := hints_of(kind)):
            node, hint, step = getattr(node, field), hints[field], field
        elif isinstance(node, tuple) and step.isdecimal() and int(step) < len(node):
            node, hint = node[int(step)], Any
        elif isinstance(node, dict) and step in node:
            node, hint = node[step], Any
        else:
            return None
        taken.append(step)
    base = _held(hint)
    if base is None:
        return None
    if isinstance(node, dict):
        return SlotPath(".".join(taken), node, last, base)
    if isinstance(node, tuple) and last.isdecimal() and int(last) <= len(node):
        return SlotPath(".".join(taken), node, int(last), base)
    return None


def _held(hint: Any) -> type[Component] | None:
    """The component in `dict[str, Loss]` or `tuple[Prune, ...]`."""
    held = get_args(hint)[-1 if get_origin(hint) is dict else 0] if get_args(hint) else None
    held = get_args(held)[0] if get_origin(held) is Annotated else held
    return held if isinstance(held, type) and issubclass(held, Component) else None
