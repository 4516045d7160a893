"""From words to a command: tyro parses, and what it objects to becomes one line."""

from __future__ import annotations

import contextlib
import difflib
import io
import math
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro

from surfkit.cli.recipes import ARGV
from surfkit.cli.slots import WHOLE, choices_first, explain_choice, flags_as_choices, owners, slots
from surfkit.core.check import BadInput
from surfkit.core.registry import Component
from surfkit.recipe import Recipe

T = TypeVar("T")

_CONFIG = (tyro.conf.CascadeSubcommandArgs,)
_FLAG = re.compile(r"--[\w.\-]+")
_REWORDED = {
    r"^Error parsing (recipe\.)?": "",
    r"no type matching (.*) could be instantiated from \[(.*?)\]\. Got errors:.*": r"expected \1, got \2",
    r"invalid literal for int\(\) with base 10: (.*)": r"expected a whole number, got \1",
    r"could not convert string to float: (.*)": r"expected a number, got \1",
    r"^invalid choice '(.*)' for argument '(.*)'\. Expected one of \((.*?),?\)\.$": r"\2: expected one of \3, got '\1'",
    r"^Missing value for argument '(.*)'\. Expected 1 values\.$": r"\1: a value must follow",
    r"^Missing value for argument '(.*)'\. Expected (\d+) values\.$": r"\1: \2 values must follow",
}
"""What Python and tyro say, and how a user would want it said."""


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
    argv = flags_as_choices(command, [*argv, *_default(command, argv)])
    token = ARGV.set(tuple(argv))
    said = io.StringIO()
    try:
        with _wide_boxes(argv), contextlib.redirect_stderr(said):
            return _with_numbers(tyro.cli(command, prog=prog, args=choices_first(command, argv), config=_CONFIG))
    except SystemExit as stop:
        if stop.code != 2:
            raise
        box = said.getvalue()
        said.truncate(0)
        raise BadInput(_condensed(box, command, argv, prog)) from None
    finally:
        ARGV.reset(token)
        sys.stderr.write(said.getvalue())  # what was not tyro's box: warnings


def _with_numbers(settings: T, at: str = "") -> T:
    """The settings, or BadInput if one at any depth is nan, which passes most checks, or has no place in 64 bits."""
    inner: Iterable[tuple[Any, Any]] = ()
    if isinstance(settings, float) and math.isnan(settings):
        raise BadInput(f"{at.removeprefix('recipe.')} is nan, which is no number")
    if isinstance(settings, int) and abs(settings) >= 2**63:
        raise BadInput(f"{at.removeprefix('recipe.')} is {settings}; whole numbers lie within 9.2e18 of 0")
    if is_dataclass(settings):
        inner = ((field.name, getattr(settings, field.name)) for field in fields(settings))
    elif isinstance(settings, dict):
        inner = settings.items()
    elif isinstance(settings, tuple):
        inner = enumerate(settings)
    for name, value in inner:
        _with_numbers(value, f"{at}.{name}" if at else str(name))
    return settings


def _default(command: type, argv: Sequence[str]) -> list[str]:
    """The word for the recipe that a command takes when none is named, if it has one in `default_recipe`."""
    name = getattr(command, "default_recipe", None)
    if name is None or any(word.startswith("recipe:") for word in argv) or {"-h", "--help"} & set(argv):
        return []
    return [f"recipe:{name}"]


def _condensed(text: str, command: type, argv: Sequence[str], prog: str) -> str:
    """One line for the box that tyro prints: a title, then sections between rules."""
    known = slots(command, argv)
    for whole in WHOLE:
        slot = whole.rstrip(":")
        if slot in known and not any(word.startswith(whole) for word in argv):
            return f"no {slot} chosen: add one of {', '.join(whole + name for name in known[slot])}"
    title, sections = _sections(text)
    message = _reworded(" ".join(" ".join(sections[0]).split())) if sections else ""
    if title == "Unrecognized options" and (found := _unrecognised(message, sections[1:], command, argv, prog)):
        return found
    if title == "Missing subcommand" and (names := re.search(r"\{(.*)\}", message)):
        return f"nothing chosen: add one of {names[1]}"
    if title == "Required options":
        return f"{' and '.join(_outermost(sections[0]))} missing; see {prog} --help"
    if title in ("Value error", "Invalid choice", "Missing argument"):
        return message.removeprefix(f"{command.__name__}: ")  # of the whole command, not of one setting
    return f"{': '.join(filter(None, [title, message])) or 'these words do not fit'}; see {prog} --help"


def _reworded(message: str) -> str:
    for said, meant in _REWORDED.items():
        message = re.sub(said, meant, message)
    return message


def _unrecognised(message: str, more: list[list[str]], command: type, argv: Sequence[str], prog: str) -> str | None:
    """What to do about words that have no place. Only the first is named; the next may be its value."""
    message = re.sub(r"\(applied to [^)]*\)", "", message.partition("Arguments are applied")[0])
    found = {word: re.search(rf"(?<!\S){re.escape(word)}(?=[\s,]|$)", message) for word in argv}
    unplaced = {word: at.start() for word, at in found.items() if at}
    if not unplaced:
        return None
    word = min(unplaced, key=unplaced.__getitem__)  # not by their order in argv: a value may stand there twice
    if not word.startswith("-"):
        return explain_choice(command, word, argv) or f"unexpected {word!r}; settings are given as --NAME VALUE"
    flag = word.partition("=")[0]
    if names := slots(command, argv).get(flag.removeprefix("--")):
        return f"{flag}: one of {', '.join(names)} must follow"
    if plain := difflib.get_close_matches(flag, list(_plain_flags(command)), n=2, cutoff=0.75):
        return f"no option {flag}; perhaps you meant {' or '.join(plain)}"
    similar = [line.strip() for section in more if _about(flag, section[0].strip()) for line in section[1:]]
    near = list(dict.fromkeys(found[0] for line in similar if (found := _FLAG.match(line))))
    bringing = list(dict.fromkeys(re.findall(r"(\S+:\S+) --help", " ".join(_entry(flag, similar)))))
    if bringing := bringing or owners(command, flag, argv):
        return f"{flag} does not apply here; it belongs to {' or '.join(bringing[:3])}, which is not chosen"
    return f"no option {flag}; " + (f"perhaps you meant {' or '.join(near[:3])}" if near else f"see {prog} --help")


def _plain_flags(command: type) -> Iterator[str]:
    """The flags of a command itself; tyro puts those of its parts first, as they stand in every recipe."""
    for name, hint in get_type_hints(command, include_extras=True).items():
        kind, marks = (get_args(hint)[0], get_args(hint)[1:]) if get_origin(hint) is Annotated else (hint, ())
        if {tyro.conf.Positional, tyro.conf.Suppress} & set(marks):
            continue  # no flag
        if isinstance(kind, type) and issubclass(kind, (Component, Recipe)):
            continue
        if is_dataclass(kind):
            yield from _plain_flags(kind)
        else:
            yield f"--{name.replace('_', '-')}"


def _outermost(lines: list[str]) -> list[str]:
    """The least indented of the indented lines: what is missing, without its help."""
    depths = [len(line) - len(line.lstrip()) for line in lines]
    least = min((depth for depth, line in zip(depths, lines, strict=True) if not line.endswith(":")), default=0)
    return [line.strip() for depth, line in zip(depths, lines, strict=True) if depth == least]


def _about(flag: str, head: str) -> bool:
    """Whether a section lists flags similar to this one."""
    return head.startswith(("Perhaps you meant", f"Arguments similar to {flag}"))


def _entry(flag: str, lines: list[str]) -> list[str]:
    """The lines about one flag in a list of similar ones."""
    found, inside = [], False
    for line in lines:
        if name := _FLAG.match(line):
            inside = name[0] == flag
        if inside:
            found.append(line)
    return found


def _sections(text: str) -> tuple[str, list[list[str]]]:
    """Title of a box and the lines between its rules; drawn with lines, or with hyphens where UTF-8 is not at hand."""
    lines = re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines() or [""]
    sections: list[list[str]] = [[]]
    for line in lines[1:]:
        inside = re.sub(r"^│ ?|\s*│?\s*$", "", line)
        if re.fullmatch(r"\W*[─-]{3,}\W*", inside):
            sections.append([])
        elif inside.strip():
            sections[-1].append(inside)
    return re.sub(r"^\W+|\W+$", "", lines[0]), [section for section in sections if section]


@contextlib.contextmanager
def _wide_boxes(argv: Sequence[str]) -> Iterator[None]:
    """Let tyro write each sentence on one line; help keeps the width of the terminal."""
    before = os.environ.get("COLUMNS")
    if not {"-h", "--help"} & set(argv):
        os.environ["COLUMNS"] = "10000"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("COLUMNS", None)
        else:
            os.environ["COLUMNS"] = before
