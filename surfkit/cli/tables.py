"""Ablation tables on the command line: `table:NAME`, as `recipe:NAME` for recipes."""

from __future__ import annotations

from typing import Annotated, Any, Union

import tyro

from surfkit.core.registry import offered_once


def tables() -> dict[str, Any]:
    """The tables that are offered, by name."""
    return offered_once("surfkit_tables", "an ablation table")


def table_choice() -> Any:
    """The union of all tables as tyro subcommands `table:NAME`."""
    members = tuple(_subcommand(name, table) for name, table in tables().items())
    return Union[members]  # noqa: UP007 (made at run time)


chosen_table = tyro.conf.arg(constructor_factory=table_choice, name="")
"""Marks the field of a command that takes a table."""


def _subcommand(name: str, table: Any) -> Any:
    def run():
        return table

    run.__annotations__["return"] = type(table)
    return Annotated[type(table), tyro.conf.subcommand(f"table:{name}", constructor=run, description=table.about)]
