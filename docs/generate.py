"""Writes the pages that follow from the code: components.md, commands.md and floors.svg.

python docs/generate.py

A test holds them to it, so run this after a change of a setting, a default, a help text or a floor.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import io
import os
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints
from xml.sax.saxutils import escape

HERE = Path(__file__).parent
ROOT = HERE.parent
REGENERATE = "Written by `python docs/generate.py`."
INTRODUCTION = (
    "`surfkit COMMAND --help` shows the same, and the options of the parts that are chosen with `FIELD:NAME`;",
    "[Components](components.md) lists those. What stands in brackets may be left out. An option that is on or off",
    "(`true`, `false`) is turned on with `--NAME` and off with `--no-NAME`.",
)
BOX, GAP, LEFT, WIDTH = 44, 12, 90, 900
"""Sizes in the picture of the floors, pixels."""


def main() -> None:
    """Write them."""
    for name, text in pages().items():
        (HERE / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of every generated file, by name."""
    return {"components.md": components(), "commands.md": commands(), "floors.svg": floors()}


def components() -> str:
    """The page of all components that come with surfkit; those of other packages are left out."""
    from surfkit.cli import main as command
    from surfkit.core import registry

    before, out = os.environ.get("SURFKIT_PLUGINS"), io.StringIO()
    os.environ["SURFKIT_PLUGINS"] = "none"
    registry.reload()
    try:
        with contextlib.redirect_stdout(out):
            command(["components", "--markdown"])
    finally:
        os.environ.pop("SURFKIT_PLUGINS") if before is None else os.environ.update(SURFKIT_PLUGINS=before)
        registry.reload()
    return out.getvalue()


def commands() -> str:
    """The page of all commands with their options."""
    from surfkit.cli import COMMANDS

    lines = ["# Commands", "", REGENERATE, "", *INTRODUCTION]
    for name in COMMANDS:
        found = importlib.import_module(f"surfkit.cli.{name}").COMMAND
        for second, command in (found if isinstance(found, dict) else {"": found}).items():
            lines += ["", *_command(f"{name} {second}".strip(), command)]
    return "\n".join(lines) + "\n"


def _command(name: str, command: type) -> Iterator[str]:
    rows = list(_options(command))
    places = [f"[{shown}]" if default or shown == "KIND" else shown for shown, default, _ in rows if shown[0] != "-"]
    places += ["[OPTIONS]"] if any(shown[0] == "-" for shown, *_ in rows) else []
    yield from (f"## surfkit {name}", "", f"    surfkit {' '.join([name, *places])}", "")
    for paragraph in (command.__doc__ or "").strip().split("\n\n"):
        yield from (" ".join(paragraph.split()), "")
    if rows:
        yield from ("| argument or option | default | |", "|---|---|---|")
    for row in rows:
        cells = (f"`{row[0]}`", f"`{row[1]}`" if row[1] else "", row[2])
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _options(command: type) -> Iterator[tuple[str, str, str]]:
    """What may follow a command, its default and its help; parts of a recipe are on a page of their own."""
    from surfkit.core.describe import settings

    hints = get_type_hints(command, include_extras=True)
    told = {setting.name: setting for setting in settings(command)}
    for field in fields(command):
        hint, marks = _plain(hints[field.name])
        name = next((mark.name for mark in marks if getattr(mark, "name", None)), field.name.replace("_", "-"))
        setting, words = told.get(field.name), {str(mark) for mark in marks}
        if setting is None or any("Suppress" in word for word in words):
            continue
        default = "" if setting.default in ("required", "none", "()") else setting.default.strip("()")
        if any("Positional" in word for word in words):
            metavar = next((mark.metavar for mark in marks if getattr(mark, "metavar", None)), name.upper())
            yield metavar, default, setting.help
        elif any(getattr(mark, "constructor_factory", None) for mark in marks):
            yield f"{field.name}:NAME", default, setting.help
        elif isinstance(hint, type) and is_dataclass(hint):
            yield from _options(hint)
        else:
            value = "" if hint is bool else f" {_value(hint)}"
            yield f"--{name}{value}", default.lower() if hint is bool else default, setting.help


def _plain(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its marks and without None, and the marks."""
    marks: tuple[Any, ...] = ()
    while get_origin(hint) is Annotated:
        hint, *more = get_args(hint)
        marks += tuple(more)
    rest = [part for part in get_args(hint) if part is not type(None)]
    if get_origin(hint) is not None and type(None) in get_args(hint) and rest:
        hint, more = _plain(rest[0] if len(rest) == 1 else Union[tuple(rest)])  # noqa: UP007 (made at run time)
        marks += more
    return hint, marks


def _value(hint: Any) -> str:
    """What follows an option, as a person would write it."""
    from surfkit.core.describe import _type

    if get_origin(hint) is tuple:
        return f"{_value(get_args(hint)[0])} ..."
    text = _type(hint)
    return text.replace("'", "").replace(" or ", "|") if "'" in text else text.upper().replace(" OR ", "|")


def floors() -> str:
    """The picture of the folders of surfkit, floor by floor, the lowest at the bottom."""
    rows = [[name for name in floor.split() if _exists(name)] for floor in _floors()]
    rows = [row for row in rows if row][::-1]
    height = len(rows) * (BOX + GAP) + GAP
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif" '
        f'font-size="15" role="img">',
        "<title>The folders of surfkit: each imports only folders below it</title>",
        f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>',
    ]
    for at, row in enumerate(rows):
        top, number = GAP + at * (BOX + GAP), len(rows) - at
        out.append(f'<text x="{LEFT - 20}" y="{top + 28}" text-anchor="end" fill="#607d8b">floor {number}</text>')
        width = (WIDTH - LEFT - GAP - (len(row) - 1) * GAP) / len(row)
        for place, name in enumerate(row):
            left = LEFT + place * (width + GAP)
            out.append(
                f'<rect x="{left:.1f}" y="{top}" width="{width:.1f}" height="{BOX}" rx="5" fill="#eceff1" '
                f'stroke="#607d8b"/>'
            )
            at_middle = f'x="{left + width / 2:.1f}" y="{top + 28}" text-anchor="middle"'
            out.append(f'<text {at_middle} fill="#263238">{escape(name)}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


def _floors() -> tuple[str, ...]:
    """The floors that tests/test_layering.py holds the code to, from the lowest."""
    tree = ast.parse((ROOT / "tests" / "test_layering.py").read_text(encoding="utf-8"))
    found = next(node for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == "FLOORS")
    return ast.literal_eval(found.value)


def _exists(name: str) -> bool:
    return (ROOT / "surfkit" / name).is_dir() or (ROOT / "surfkit" / f"{name}.py").is_file()


if __name__ == "__main__":
    main()
