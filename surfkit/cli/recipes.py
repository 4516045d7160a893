"""Recipes on the command line: which there are, and how a command takes one.

A command that needs a recipe declares the field

    recipe: Annotated[Recipe, chosen_recipe]

and the user writes `recipe:NAME` or `recipe:FILE.json`; settings inside follow as `--pretrain.steps 7000`, without a
leading "recipe.", and parts as `pretrain.densify:none`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any, Union

import tyro

from surfkit.cli.component_overrides import with_parts
from surfkit.cli.help_cache import HELP_FLAGS
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.registry import offered_once

ARGV: ContextVar[tuple[str, ...]] = ContextVar("argv", default=())
"""The words being parsed. tyro builds unions without telling for which command line; `parse` sets this."""


def recipes(argv: Sequence[str] = ()) -> dict[str, Any]:
    """Offered recipes by name, and every FILE.json that `argv` names as recipe:FILE.json.

    The one that `argv` chooses has the parts that `argv` adds, and not those that it removes.
    """
    named = offered_once("surfkit_recipes", "a recipe")
    named |= {file: _read(file) for file in _files(argv)}
    if (name := chosen_name(argv)) in named:
        named[name] = _complete(with_parts(named[name], argv)[0], argv)
    return named


def _complete(recipe: Any, argv: Sequence[str]) -> Any:
    """The recipe with a flag for each learning rate of the primitive that `argv` chooses."""
    from surfkit.runs.recipe import complete

    return complete(recipe, next((w.removeprefix("primitive:") for w in argv if w.startswith("primitive:")), None))


def chosen_name(argv: Sequence[str]) -> str | None:
    """The first recipe that the words choose."""
    return next((word.removeprefix("recipe:") for word in argv if word.startswith("recipe:")), None)


def recipe_choice(argv: Sequence[str] = ()) -> Any:
    """The union of recipes as tyro subcommands `recipe:NAME`, whose values are the defaults of the flags.

    All of them for help and for no words; otherwise the chosen one and one more, without which tyro sees no choice. It
    would search every part of all of them for what a wrong word might have meant, which takes seconds.
    """
    known = recipes(argv)
    if not known:
        raise BadInput("no plugin in use offers a recipe; name a file instead: recipe:FILE.json")
    if argv and not HELP_FLAGS & set(argv):
        known = dict(sorted(known.items(), key=lambda item: item[0] != chosen_name(argv))[:2])
    members = tuple(_subcommand(name, recipe) for name, recipe in known.items())
    return Union[members]  # noqa: UP007 (made at run time)


chosen_recipe = tyro.conf.arg(constructor_factory=lambda: recipe_choice(ARGV.get()), name="")
"""Marks the field of a command that takes a recipe."""


def part_of_run(field: str, otherwise: Callable[[], Any]) -> Any:
    """The part at a field of the recipe of the run that the command line names; `otherwise()` if there is none."""
    for word in ARGV.get():
        path = Path(word) / "recipe.json"
        if not word.startswith("-") and path.is_file():
            from surfkit.runs.recipe import Recipe

            return getattr(read_json(path, Recipe), field) or otherwise()
    return otherwise()


def settled(recipe: Any) -> Any:
    """The chosen recipe; after a word has changed its method, without what the new one does not use.

    Raises:
        BadInput: Another word, or the recipe itself, sets something that the method does not use.
    """
    from surfkit.runs.recipe import refuse_unused, unused, without_unused

    words, names = ARGV.get(), [name.replace("_", "-") for name in recipe.unused]
    for word in words:
        setting = re.split("[=:]", word.removeprefix("--"))[0]
        is_flag_or_choice = word.startswith("--") or ":" in word
        if is_flag_or_choice and setting.partition(".")[0] in names:
            raise BadInput(unused(recipe, word))
    if any(word.startswith("method:") for word in words):
        return without_unused(recipe)
    refuse_unused(recipe)
    return recipe


def about(recipe: Any) -> str:
    """What a recipe says of itself, in one line."""
    return " ".join(recipe.about.split())


def _subcommand(name: str, recipe: Any) -> Any:
    return Annotated[type(recipe), tyro.conf.subcommand(f"recipe:{name}", default=recipe, description=about(recipe))]


def _files(argv: Sequence[str]) -> list[str]:
    names = [word.removeprefix("recipe:") for word in argv if word.startswith("recipe:")]
    return [name for name in names if name.endswith(".json")]


def _read(file: str) -> Any:
    from surfkit.runs.recipe import Recipe

    return read_json(Path(file), Recipe)
