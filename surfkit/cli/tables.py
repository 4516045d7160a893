"""Ablation tables on the command line: `table:NAME`, as `recipe:NAME` for recipes, and tables of users in files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Union

import tyro

from surfkit.cli.recipes import ARGV
from surfkit.core.check import BadInput
from surfkit.study.ablation import Table, offered_tables
from surfkit.study.table_file import is_table_file, read_table

TABLE_PREFIX = "table:"


def tables(argv: Sequence[str] = ()) -> dict[str, Table]:
    """Offered tables by name, and the table of every file that `argv` names as table:FILE."""
    named = [word.removeprefix(TABLE_PREFIX) for word in argv if word.startswith(TABLE_PREFIX)]
    return offered_tables() | {name: read_table(name) for name in named if is_table_file(name)}


def files_as_choices(argv: Sequence[str]) -> list[str]:
    """The same words, with FILE.json, FILE.py and FILE.py:NAME rewritten to table:FILE, where they are no value."""
    before = ["", *argv]
    return [
        TABLE_PREFIX + word
        if is_table_file(word) and not word.startswith(("-", TABLE_PREFIX)) and not last.startswith("--")
        else word
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


def _subcommand(name: str, table: Any) -> Any:
    def run():
        return table

    run.__annotations__["return"] = type(table)
    return Annotated[type(table), tyro.conf.subcommand(f"table:{name}", constructor=run, description=table.about)]
