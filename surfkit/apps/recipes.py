"""`surfkit recipes`: which recipes there are."""

from __future__ import annotations

from dataclasses import dataclass

from surfkit.cli.console_table import print_failures, print_table
from surfkit.cli.recipes import about, recipes


@dataclass(frozen=True)
class RecipesCommand:
    """List the recipes that `surfkit train recipe:NAME` accepts."""

    def run(self) -> None:
        """Print one line per recipe."""
        print_table(("recipe", "what it is"), [(name, about(recipe)) for name, recipe in recipes().items()])
        print_failures()


COMMAND = RecipesCommand
