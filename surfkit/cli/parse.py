"""From the words of a command line to a command: tyro parses them, and its errors become one line each."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import fields, is_dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

import tyro

# Private to tyro, but its only errors that are not drawn as boxes: pyproject.toml limits the versions of tyro for it.
from tyro._errors import (
    BadValue,
    InstantiationFailure,
    InvalidChoice,
    MissingArgs,
    MissingSubcommand,
    ParseErrorEvent,
    UnrecognizedArgs,
    on_parse_error,
)

from surfkit.cli.flags import explain_flag, flags, negations_with_their_flag
from surfkit.cli.help_cache import HELP_FLAGS
from surfkit.cli.help_text import described, rules_of_help
from surfkit.cli.recipes import ARGV
from surfkit.cli.slots import (
    WHOLE_PREFIXES,
    bare_words,
    choices_first,
    explain_bare,
    explain_choice,
    flags_as_choices,
    slots,
)
from surfkit.cli.tables import files_as_choices
from surfkit.core.check import BadInput

if TYPE_CHECKING:
    from tyro._arguments import ArgumentDefinition

T = TypeVar("T")

COMMON_RECIPES = ("surface", "citygs2", "2dgs", "3dgs")
"""Recipes that an error names where there are more than so many; a command lists them all."""
_CONFIG = (tyro.conf.CascadeSubcommandArgs,)
_NO_TYPE = re.compile(r"no type matching (.*) could be instantiated from \[(.*?)\]\. Got errors:.*")
_REWORDED = {
    r"invalid literal for int\(\) with base 10: (.*)": r"expected a whole number, got \1",
    r"could not convert string to float: (.*)": r"expected a number, got \1",
}
"""What Python says, and how a user would want it said."""
_TYPES = {"INT": "a whole number", "FLOAT": "a number", "{None}": "none", "|": " or "}


def parse(command: type[T], argv: Sequence[str], prog: str) -> T:
    """The command that the words ask for.

    Args:
        command: A dataclass; its fields become flags, and choices of components `field:NAME` in any order.
        argv: Words after the command's name.
        prog: How the user called it, such as "surfkit train".

    Raises:
        BadInput: One line about the words that do not fit, or about the values they give.
        SystemExit: After `--help` was printed.
    """
    if hasattr(command, "default_table"):
        argv = files_as_choices(argv)
    argv = negations_with_their_flag(command, flags_as_choices(command, [*argv, *_default(command, argv)]))
    token = ARGV.set(tuple(argv))

    def refuse(event: ParseErrorEvent) -> None:
        if line := _explained(event, command, argv, prog):
            raise BadInput(line)

    try:
        with on_parse_error(refuse):
            words, rules = choices_first(command, argv), rules_of_help()
            with described(command):
                found = tyro.cli(command, prog=prog, description="", args=words, config=_CONFIG, registry=rules)
            _refuse_flags_without_values(found, argv)
            return _refuse_nan(found)
    finally:
        ARGV.reset(token)


def _refuse_flags_without_values(settings: Any, argv: Sequence[str], at: str = "") -> None:
    """BadInput where a flag that takes any number of values has none, and so asks for nothing."""
    empty = [word for word, then in pairwise([*argv, "--"]) if then.startswith("--") or ":" in then]
    for field in fields(settings):
        value, flag = getattr(settings, field.name), field.name.replace("_", "-")
        if is_dataclass(value):
            _refuse_flags_without_values(value, argv, f"{at}{flag}.")
        elif value == field.default == ():
            for name in (f"--{flag}", f"--{at}{flag}"):
                if name in empty:
                    raise BadInput(f"{name}: a value must follow")


def _refuse_nan(settings: T, at: str = "") -> T:
    """The settings, or BadInput if one at any depth is nan, which passes most checks, or has no place in 64 bits."""
    inner: Iterable[tuple[Any, Any]] = ()
    if isinstance(settings, float) and math.isnan(settings):
        raise BadInput(f"{at.removeprefix('recipe.')} is nan; give a number")
    if isinstance(settings, int) and abs(settings) >= 2**63:
        raise BadInput(f"{at.removeprefix('recipe.')} is {settings}; give a whole number between -9.2e18 and 9.2e18")
    if is_dataclass(settings):
        inner = ((field.name, getattr(settings, field.name)) for field in fields(settings))
    elif isinstance(settings, dict):
        inner = settings.items()
    elif isinstance(settings, tuple):
        inner = enumerate(settings)
    for name, value in inner:
        _refuse_nan(value, f"{at}.{name}" if at else str(name))
    return settings


def _default(command: type, argv: Sequence[str]) -> list[str]:
    """The word for the recipe or the table that a command takes when none is named, if it has one in `default_recipe`
    or in `default_table`."""
    for whole in WHOLE_PREFIXES:
        name = getattr(command, f"default_{whole.rstrip(':')}", None)
        if name is not None and not any(word.startswith(whole) for word in argv) and not HELP_FLAGS & set(argv):
            return [f"{whole}{name}"]
    return []


def _explained(event: ParseErrorEvent, command: type, argv: Sequence[str], prog: str) -> str | None:
    """One line for what tyro found wrong; None for a kind of error that this does not know."""
    known = slots(command, argv)
    for whole in WHOLE_PREFIXES:
        slot = whole.rstrip(":")
        if slot in known and not any(word.startswith(whole) for word in argv):
            return _nothing_chosen(slot, known[slot], command, argv)
    if isinstance(event, UnrecognizedArgs):
        return _unrecognised(event.tokens[0], command, argv, prog)  # the next may be its value
    if isinstance(event, MissingArgs):
        if event.unrecognized_tokens:
            return _unrecognised(event.unrecognized_tokens[0], command, argv, prog)
        names = [_name(missing.arg, with_value=True) for missing in event.missing_arguments]
        return f"{' and '.join(names)} missing; see {prog} --help"
    if isinstance(event, InvalidChoice):
        choices = ", ".join(map(repr, event.choices))
        return f"{_name(event.argument)}: expected one of {choices}, got {event.value!r}"
    if isinstance(event, BadValue):
        if event.reason == "fixed":
            return f"{_name(event.argument)} cannot be set here; leave it out"
        return _without_value(event, command, argv, prog)
    if isinstance(event, MissingSubcommand):
        return f"nothing chosen: add one of {', '.join(event.subcommand_spec.parser_from_name)}"
    if isinstance(event, InstantiationFailure):
        return ": ".join(filter(None, [_place(event), _reworded(event.message)]))
    return None


def _nothing_chosen(slot: str, names: Sequence[str], command: type, argv: Sequence[str]) -> str:
    """No recipe or table was named; perhaps a word that stands alone was meant to be it."""
    meant = next(filter(None, (explain_bare(command, word, argv) for word in bare_words(command, argv))), None)
    if meant is not None and f"{slot}:" in meant:
        return f"no {slot} chosen: {meant}"
    shown = (
        names
        if len(names) <= len(COMMON_RECIPES)
        else [name for name in COMMON_RECIPES if name in names] or names[: len(COMMON_RECIPES)]
    )
    listed = f"; `surfkit {slot}s` lists all {len(names)}" if len(shown) < len(names) else ""
    chosen = f"no {slot} chosen: add one of {', '.join(f'{slot}:{name}' for name in shown)}{listed}"
    return f"{meant} And {chosen}" if meant is not None else chosen


def _without_value(event: BadValue, command: type, argv: Sequence[str], prog: str) -> str:
    """An argument lacks its value: at the end of the words, or because an unknown flag stands in its place."""
    name, count = _name(event.argument), event.argument.lowered.nargs
    if not event.argument.is_positional():
        return f"{name}: {f'{count} values' if isinstance(count, int) and count > 1 else 'a value'} must follow"
    known = flags(command, argv)
    wrong = [word for word in argv if word.startswith("--") and word.partition("=")[0] not in known]
    return _unrecognised(wrong[0], command, argv, prog) if wrong else f"{name} missing; see {prog} --help"


def _place(event: InstantiationFailure) -> str:
    """The flag or the part whose value is wrong; "" for the command as a whole."""
    if event.argument is not None:
        return _name(event.argument)
    error = sys.exc_info()[1]  # tyro calls while it handles this one, which knows the part
    return str(getattr(error, "arg", "")).removeprefix("recipe.")


def _name(argument: ArgumentDefinition, with_value: bool = False) -> str:
    """What the help calls an argument."""
    lowered = argument.lowered
    if argument.is_positional():
        return str(lowered.metavar)
    return f"{lowered.name_or_flags[-1]} {lowered.metavar}" if with_value else lowered.name_or_flags[-1]


def _reworded(message: str) -> str:
    message = " ".join(message.split())
    if found := _NO_TYPE.match(message):
        kinds = found[1]
        for written, meant in _TYPES.items():
            kinds = kinds.replace(written, meant)
        return f"expected {kinds}, got {found[2]}"
    for pattern, meant in _REWORDED.items():
        message = re.sub(pattern, meant, message)
    return message


def _unrecognised(word: str, command: type, argv: Sequence[str], prog: str) -> str:
    """What to do about a word that has no place."""
    if not word.startswith("-"):
        found = explain_choice(command, word, argv) or explain_bare(command, word, argv)
        return found or f"unexpected {word!r}; settings are given as --NAME VALUE"
    flag = word.partition("=")[0]
    if names := slots(command, argv).get(flag.removeprefix("--")):
        return f"{flag}: one of {', '.join(names)} must follow"
    return explain_flag(command, flag, argv) or f"no option {flag}; see {prog} --help"
