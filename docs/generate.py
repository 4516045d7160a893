"""Writes the pages that follow from the code: components.md, kinds.md, commands.md and floors.svg.

python docs/generate.py

A test holds them to it, so run this after a change of a setting, a default, a help text or a floor.
"""

from __future__ import annotations

import ast
import builtins
import contextlib
import importlib
import inspect
import io
import os
import re
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints
from xml.sax.saxutils import escape

HERE = Path(__file__).parent
ROOT = HERE.parent
REGENERATE = "Written by `python docs/generate.py`."
KINDS_INTRODUCTION = (
    "A part is a frozen dataclass that extends the base class of its kind. [Write a plugin](plugins.md) makes one,",
    "step by step, and [Components](components.md) lists those that there are. Each base class is shown with all that",
    "a part inherits: what is marked `@abstractmethod` must be written, the other methods may be replaced, and class",
    "variables and settings may have other values. [Conventions](conventions.md) has the letters of shapes, the frames",
    "and the units.",
)
INTRODUCTION = (
    "`surfkit COMMAND --help` shows the same, and the options of the parts that are chosen with `FIELD:NAME`;",
    "[Components](components.md) lists those. What stands in brackets may be left out. An option that is on or off",
    "(`true`, `false`) is turned on with `--NAME` and off with `--no-NAME`.",
)
BOX, GAP, LEFT, WIDTH = 44, 12, 90, 900
"""Sizes in the picture of the floors, pixels."""
WIDE = 96
"""Columns of Python code, so that it fits the pages."""


def main() -> None:
    """Write them."""
    for name, text in pages().items():
        (HERE / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """The text of every generated file, by name."""
    return {"components.md": components(), "kinds.md": kinds(), "commands.md": commands(), "floors.svg": floors()}


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


def kinds() -> str:
    """The page of what a plugin writes for a part of each kind: the base classes with their methods."""
    from surfkit.core.registry import kebab, kind_of, offered

    bases = {kind_of(cls) for owner, _, cls in offered("surfkit_components") if owner.startswith("surfkit.")}
    lines = ["# Kinds of parts", "", REGENERATE, "", *KINDS_INTRODUCTION]
    for base in sorted(bases, key=lambda base: base.__name__):
        about, _, _ = inspect.cleandoc(base.__doc__ or "").partition("\nAttributes:\n")
        lines += ["", f"## {kebab(base.__name__)}", "", about.strip(), "", _home(base), ""]
        lines += _contract(base)
    return "\n".join(lines) + "\n"


def _home(base: type) -> str:
    """Where a base class is imported from and stands, and what checks its parts."""
    from surfkit import plugin, testing
    from surfkit.core.registry import kebab

    home = "surfkit.plugin" if base.__name__ in plugin.__all__ else base.__module__
    names = (f"check_{kebab(cls.__name__).replace('-', '_')}" for cls in base.__mro__)
    check = next((f", checked by `surfkit.testing.{name}`" for name in names if name in testing.__all__), "")
    return f"`{home}.{base.__name__}`, in `{base.__module__.replace('.', '/')}.py`{check}."


def _contract(base: type) -> Iterator[str]:
    """A base class as Python: what a part inherits, the abstract methods before those that it may replace."""
    values: dict[str, list[str]] = {}
    methods: dict[str, list[str]] = {}
    imports: dict[str, set[str]] = {"surfkit.plugin": {"Component"}}
    for cls, node, text in _members(base):
        if isinstance(node, ast.AnnAssign):
            values[node.target.id] = ["    " + ast.unparse(node).replace("'", '"'), *_docstring(text, 4)]
            _import(imports, cls, [node.annotation])
        else:
            methods[node.name] = [*_signature(node), *_docstring(text, 8)]
            _import(imports, cls, [*(each.annotation for each in node.args.args), node.returns])
    yield "```python"
    for module, names in sorted(imports.items()):
        if used := ", ".join(sorted(names - {base.__name__})):
            yield f"from {module} import {used}" if module else f"import {used}"
    yield from ("", "", f"class {base.__name__}(Component):")
    before: list[str] = []
    for lines in (
        *values.values(),
        *(methods[n] for n in sorted(methods, key=lambda n: n not in base.__abstractmethods__)),
    ):
        yield from ([""] if len(before) > 1 or (before and len(lines) > 1) else []) + lines
        before = lines
    yield "```"


def _members(base: type) -> Iterator[tuple[type, ast.AnnAssign | ast.FunctionDef, str | None]]:
    """Public variables and methods of a base class and its own bases: the class, the source and the docstring."""
    from surfkit.core.registry import Component

    for cls in reversed(base.__mro__):
        if not issubclass(cls, Component) or cls is Component:
            continue
        body, told = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body, _attributes(cls)
        for node, after in zip(body, [*body[1:], None], strict=True):
            if isinstance(node, ast.AnnAssign) and not node.target.id.startswith("_"):
                yield cls, node, after.value.value if isinstance(after, ast.Expr) else told.get(node.target.id)
            elif isinstance(node, ast.FunctionDef) and (node.name == "__call__" or not node.name.startswith("_")):
                yield cls, node, ast.get_docstring(node)


def _signature(node: ast.FunctionDef) -> Iterator[str]:
    """A method's first lines, in lines of WIDE columns."""
    yield from (f"    @{ast.unparse(each)}" for each in node.decorator_list)
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    line = f"    def {node.name}({ast.unparse(node.args)}){returns}:".replace("'", '"')
    if len(line) <= WIDE:
        yield line
        return
    given = [ast.unparse(each) for each in node.args.args]
    defaults = [f" = {ast.unparse(each)}".replace("'", '"') for each in node.args.defaults]
    defaults = [""] * (len(given) - len(defaults)) + defaults
    yield f"    def {node.name}("
    yield from (f"        {name}{default}," for name, default in zip(given, defaults, strict=True))
    yield f"    ){returns}:"


def _docstring(text: str | None, indent: int) -> list[str]:
    """A docstring in lines of WIDE columns: paragraphs and the entries of lists are filled anew."""
    if not text:
        return []
    groups: list[str] = []
    for line in inspect.cleandoc(text).splitlines():
        entry = re.match(r" +(- |\w[\w, ]*: )|\w+:$", line)
        if not groups or not line or not groups[-1] or entry or re.fullmatch(r"\w+:", groups[-1]):
            groups.append(line)
        else:
            groups[-1] += " " + line.strip()
    lines: list[str] = []
    for group in groups:
        own = len(group) - len(group.lstrip())
        more = " " * (indent + own + (4 if own else 0))
        lines += textwrap.wrap(group.strip(), WIDE, initial_indent=" " * (indent + own), subsequent_indent=more) or [""]
    lines[0] = f'{" " * indent}"""{lines[0].lstrip()}'
    return [*lines, " " * indent + '"""'] if len(lines) > 1 else [lines[0] + '"""']


def _import(imports: dict[str, set[str]], cls: type, hints: list[ast.expr | None]) -> None:
    """Add from where the names in type hints of a class are imported, from surfkit.plugin if it has them."""
    from surfkit import plugin

    for hint in hints:
        for name in {node.id for node in ast.walk(hint) if isinstance(node, ast.Name)} if hint else ():
            found = getattr(importlib.import_module(cls.__module__), name, getattr(builtins, name, None))
            home = getattr(found, "__module__", None)
            if name in plugin.__all__:
                home = "surfkit.plugin"
            elif inspect.ismodule(found):
                home = ""
            elif home is None or getattr(importlib.import_module(home), name, None) is not found:
                home = cls.__module__  # a name for another type
            if home != "builtins":
                imports.setdefault(home, set()).add(name)


def _attributes(cls: type) -> dict[str, str]:
    """What the docstring of a class says of its attributes."""
    _, _, listed = inspect.cleandoc(cls.__doc__ or "").partition("\nAttributes:\n")
    found = re.finditer(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", listed, re.M)
    return {each[1]: " ".join(each[2].split()) for each in found}


def commands() -> str:
    """The page of all commands with their options."""
    from surfkit.cli import COMMANDS

    lines = ["# Commands", "", REGENERATE, "", *INTRODUCTION]
    for name in COMMANDS:
        found = importlib.import_module(COMMANDS[name].module).COMMAND
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
