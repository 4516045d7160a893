"""Ablation tables of users: a JSON file, or a Python file that defines TABLE or TABLES."""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load, read_json
from surfkit.core.registry import offered_once, unknown
from surfkit.runs.recipe import Recipe
from surfkit.study.ablation import Row, Table, build, built_on

ENDINGS = (".json", ".py")
"""Of files with tables."""


@dataclass(frozen=True)
class RowJson:
    """A row in a JSON file; see `Row`.

    Attributes:
        label: Its name in the table.
        change: New values, as a recipe in JSON has them, by dotted path into the recipe.
        recipe: Name of the recipe that is changed, or the recipe; that of the row it builds on if left out.
        kept: Whether later rows build on it.
        on: Label of the row above that it builds on.
        group: Heading of the part of the table that begins with it.
        paper: What was published for it.
    """

    label: str
    change: dict[str, Any] = field(default_factory=dict)
    recipe: Any = None
    kept: bool = True
    on: str | None = None
    group: str = ""
    paper: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class TableJson:
    """A table in a JSON file; see `Table`.

    Attributes:
        name: Of the table.
        base: Name of the recipe that the first row changes, or the recipe.
        rows: From top to bottom.
        about: What it shows, in one line.
        columns: Shown where they were measured, beside those that every table shows.
    """

    name: str
    base: Any
    rows: tuple[RowJson, ...]
    about: str = ""
    columns: tuple[str, ...] = ()


def is_table_file(word: str) -> bool:
    """Whether a word names a file with tables: FILE.json, FILE.py, or FILE.py:NAME for one of several."""
    return Path(word.partition(".py:")[0] + ".py" if ".py:" in word else word).suffix in ENDINGS


def read_table(word: str) -> Table:
    """The table of FILE.json, of FILE.py, or the one called NAME of FILE.py:NAME.

    Raises:
        BadInput: There is none, or a row of it cannot be built; the message says where.
    """
    if word.endswith(".json"):
        return _from_json(Path(word))
    file, _, name = word.partition(".py:")
    path = Path(f"{file}.py" if name else word)
    tables = _from_python(path)
    if name and name not in tables:
        raise BadInput(f"{path}: {unknown('table', name, tables)}")
    if not name and len(tables) > 1:
        raise BadInput(f"{path}: it has the tables {', '.join(tables)}; name one, such as {path}:{next(iter(tables))}")
    table = tables[name] if name else next(iter(tables.values()))
    try:
        build(table)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from error
    return table


def _from_json(path: Path) -> Table:
    entry = read_json(path, TableJson)
    if not entry.rows:
        raise BadInput(f"{path}: rows: there are none; give at least one")
    try:
        base = _recipe(entry.base, "base")
        rows: list[Row] = []
        recipes: dict[str, Recipe] = {}
        for at, one in enumerate(entry.rows):
            plain = Row(one.label, {}, one.kept, one.paper, None, one.on, one.group)
            below = built_on(Table(entry.name, entry.about, base, (*rows, plain)))[one.label]
            own = None if one.recipe is None else _recipe(one.recipe, f"rows.{at}.recipe")
            recipe, change = _changed(own or recipes.get(below or "", base), one.change, f"rows.{at}.change")
            recipes[one.label] = recipe
            rows.append(replace(plain, change=change, recipe=own))
        table = Table(entry.name, entry.about, base, tuple(rows), entry.columns)
        build(table)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from error
    return table


def _recipe(given: Any, at: str) -> Recipe:
    """A recipe by its name, or as plain data."""
    if not isinstance(given, str):
        return load(Recipe, given, at)
    known = offered_once("surfkit_recipes", "a recipe")
    if given not in known:
        raise BadInput(f"{at}: {unknown('recipe', given, known)}; or give the recipe itself, as in recipe.json")
    return known[given]


def _changed(recipe: Recipe, change: Mapping[str, Any], at: str) -> tuple[Recipe, dict[str, Any]]:
    """A recipe after changes that are plain data, and these as the values that they stand for."""
    values = {}
    for path, plain in change.items():
        data = dump(recipe)
        try:
            _put(data, path, plain)
            recipe = load(Recipe, data)
        except BadInput as error:
            raise BadInput(f"{at}.{path}: {error}") from error
        values[path] = _get(recipe, path)
    return recipe, values


def _put(data: Any, path: str, plain: Any) -> None:
    """Put plain data at a dotted path into plain data; a dict may get a new last key."""
    *places, last = path.split(".")
    for depth, name in enumerate(places):
        data = _inside(data, name, ".".join(places[:depth]))
    here = ".".join(places) or "the recipe"
    if isinstance(data, list):
        _inside(data, last, here)
        data[int(last)] = plain
    elif isinstance(data, dict):
        data[last] = plain  # what has no such place is refused when it is loaded
    else:
        raise BadInput(f"{here} is {data!r}, which has no {last!r} inside; set {here} itself")


def _inside(data: Any, name: str, here: str) -> Any:
    here = here or "the recipe"
    if isinstance(data, list) and name.isdecimal() and int(name) < len(data):
        return data[int(name)]
    if isinstance(data, dict) and name in data:
        return data[name]
    if isinstance(data, dict):
        raise BadInput(f"{here} has no {name!r}; it has {', '.join(key for key in data if key != 'use') or 'nothing'}")
    if isinstance(data, list):
        raise BadInput(f"{here} has no position {name!r}; it has {len(data)} elements, counted from 0")
    raise BadInput(f"{here} is {data!r}, which has no {name!r} inside; set {here} itself")


def _get(value: Any, path: str) -> Any:
    for name in path.split("."):
        if isinstance(value, dict):
            value = value[name]
        else:
            value = value[int(name)] if isinstance(value, tuple) else getattr(value, name)
    return value


def _from_python(path: Path) -> dict[str, Table]:
    """The tables of a Python file, which is run; by name."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise BadInput(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read: {error}") from error
    names: dict[str, Any] = {"__name__": path.stem, "__file__": str(path)}
    try:
        exec(compile(text, str(path), "exec"), names)
    except Exception as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        kind = "" if isinstance(error, BadInput) else f"{type(error).__name__}: "
        where = path if line is None else f"{path}, line {line}"
        raise BadInput(f"{where}: {kind}{' '.join(str(error).split())}") from error
    found = names.get("TABLES", [names["TABLE"]] if "TABLE" in names else None)
    if found is None:
        raise BadInput(f"{path}: it defines neither TABLE nor TABLES; assign a surfkit.Table, or several")
    tables = list(found.values() if isinstance(found, Mapping) else found if isinstance(found, Iterable) else [found])
    if wrong := [one for one in tables if not isinstance(one, Table)]:
        raise BadInput(f"{path}: TABLE or TABLES holds {wrong[0]!r}, which is no surfkit.Table")
    if not tables:
        raise BadInput(f"{path}: TABLES is empty; give at least one surfkit.Table")
    return {table.name: table for table in tables}
