"""Ablation tables on the command line: `table:NAME`, as `recipe:NAME` for recipes, and tables of users in files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Union

import tyro

from surfkit.cli.recipes import ARGV
from surfkit.cli.table import print_failures, print_table
from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.core.registry import unknown
from surfkit.core.tree import differences
from surfkit.report.ablation import Table, build, built_on, offered_tables
from surfkit.report.table_file import is_table_file, read_table

MARK = "table:"


def tables(argv: Sequence[str] = ()) -> dict[str, Table]:
    """Offered tables by name, and the table of every file that `argv` names as table:FILE."""
    named = [word.removeprefix(MARK) for word in argv if word.startswith(MARK)]
    return offered_tables() | {name: read_table(name) for name in named if is_table_file(name)}


def files_as_choices(argv: Sequence[str]) -> list[str]:
    """The same words, with FILE.json, FILE.py and FILE.py:NAME rewritten to table:FILE, where they are no value."""
    before = ["", *argv]
    return [
        MARK + word if is_table_file(word) and not word.startswith(("-", MARK)) and not last.startswith("--") else word
        for last, word in zip(before, argv, strict=False)
    ]


def table_choice(argv: Sequence[str] = ()) -> Any:
    """The union of all tables as tyro subcommands `table:NAME`."""
    known = tables(argv)
    if not known:
        raise BadInput("no plugin in use offers an ablation table; name a file instead: FILE.json or FILE.py")
    members = tuple(_subcommand(name, table) for name, table in known.items())
    return Union[members]  # noqa: UP007 (made at run time)


chosen_table = tyro.conf.arg(constructor_factory=lambda: table_choice(ARGV.get()), name="")
"""Marks the field of a command that takes a table."""


@dataclass(frozen=True)
class Tables:
    """List the ablation tables that `surfkit ablate table:NAME` accepts, or the rows of one."""

    table: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[table:NAME|FILE]")] = None
    """Show the rows of this table, and what they change: table:NAME, FILE.json or FILE.py."""

    def run(self) -> None:
        """Print one line per table, or one per row."""
        if self.table is None:
            known = tables()
            print_table(("table", "rows", "what it shows"), [(n, str(len(t.rows)), t.about) for n, t in known.items()])
            print_failures()
            return
        name = self.table.removeprefix(MARK)
        known = tables([MARK + name])
        if name not in known:
            raise BadInput(unknown("table", name, known) + "; or name a file, FILE.json or FILE.py")
        print(f"{known[name].about}\n")
        print_table(("", "row", "on", "what it changes"), rows_of(known[name]))


COMMAND = Tables


def rows_of(table: Table) -> list[tuple[str, str, str, str]]:
    """Number, label, number of the row that it builds on, and what it changes, of every row."""
    recipes, below = build(table), built_on(table)
    numbers = {row.label: str(at) for at, row in enumerate(table.rows, 1)}
    found = []
    for row in table.rows:
        label = f"({row.label})" if row.is_given_up else row.label
        before = recipes[below[row.label]] if below[row.label] else table.base
        after = replace(recipes[row.label], about=before.about)
        changes = [f"{path} = {json.dumps(value)}" for path, value in differences(dump(before), dump(after))]
        what = "a recipe of its own" if row.recipe else "; ".join(changes) or "nothing: the base"
        found.append((numbers[row.label], label, numbers.get(below[row.label] or "", ""), what))
    return found


def _subcommand(name: str, table: Any) -> Any:
    def run():
        return table

    run.__annotations__["return"] = type(table)
    return Annotated[type(table), tyro.conf.subcommand(f"table:{name}", constructor=run, description=table.about)]
