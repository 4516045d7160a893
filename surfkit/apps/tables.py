"""`surfkit tables`: which ablation tables there are, and what their rows change."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from surfkit.cli.console_table import print_failures, print_table
from surfkit.cli.tables import TABLE_PREFIX, tables
from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.core.registry import unknown
from surfkit.core.tree import differences
from surfkit.study.ablation import Table, build, built_on


@dataclass(frozen=True)
class TablesCommand:
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
        name = self.table.removeprefix(TABLE_PREFIX)
        known = tables([TABLE_PREFIX + name])
        if name not in known:
            raise BadInput(unknown("table", name, known) + "; or name a file, FILE.json or FILE.py")
        print(f"{known[name].about}\n")
        print_table(("", "row", "on", "what it changes"), rows_of(known[name]))


COMMAND = TablesCommand


def rows_of(table: Table) -> list[tuple[str, str, str, str]]:
    """Number, label, number of the row that it builds on, and what it changes, of every row."""
    recipes, below = build(table), built_on(table)
    numbers = {row.label: str(at) for at, row in enumerate(table.rows, 1)}
    found = []
    for row in table.rows:
        label = f"({row.label})" if row.is_given_up else row.label
        before = recipes[base] if (base := below[row.label]) else table.base
        after = replace(recipes[row.label], about=before.about)
        changes = [f"{path} = {json.dumps(value)}" for path, value in differences(dump(before), dump(after))]
        what = "a recipe of its own" if row.recipe else "; ".join(changes) or "nothing: the base"
        found.append((numbers[row.label], label, numbers.get(base or "", ""), what))
    return found
