"""Tables for people and for pipes."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from surfkit.core.check import printable
from surfkit.core.events import say
from surfkit.core.registry import failures


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]], errors: Sequence[int] = ()) -> None:
    """Print rows under a head: coloured and fitted to a terminal, else aligned text with one line per row.

    Args:
        head: Names of the columns.
        rows: Texts, as many in each row as in the head.
        errors: Positions of the rows shown in red.
    """
    head, *rows = ([printable(text) for text in row] for row in (head, *rows))
    if sys.stdout.isatty():
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
        for text in head:
            table.add_column(Text(text))
        for i, row in enumerate(rows):
            table.add_row(*map(Text, row), style="red" if i in errors else None)
        Console().print(table)
        return
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    for row in [head, *rows]:
        print("  ".join(f"{text:<{width}}" for text, width in zip(row, widths, strict=True)).rstrip())


def tell(text: str) -> None:
    """Print a line that holds names of files or other foreign text."""
    print(printable(text))


def print_failures() -> None:
    """Say on stderr which installed plugins are not in use, and so not in a list that was printed."""
    for plugin in failures():
        say(f"surfkit: plugin {plugin} is not in use: {plugin.error}")
