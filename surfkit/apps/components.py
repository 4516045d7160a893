"""`surfkit components`: the parts that recipes are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from surfkit.cli.console_table import print_failures, print_table
from surfkit.core.check import BadInput
from surfkit.core.describe import Kinds, by_kind, settings, summary
from surfkit.core.registry import Component, kind_of, offered, records, unknown


@dataclass(frozen=True)
class ComponentsCommand:
    """List the components that recipes are made of, by kind."""

    kind: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="KIND")] = None
    """Show only this kind, such as "densify". Default: all kinds."""

    markdown: bool = False
    """Write Markdown with every setting, its default and its help, as in docs/components.md."""

    def run(self) -> None:
        """Print what is offered."""
        kinds = by_kind()
        if self.kind is not None and self.kind not in kinds:
            raise BadInput(unknown("kind of component", self.kind, kinds))
        shown = {kind: parts for kind, parts in kinds.items() if self.kind in (None, kind)}
        if self.markdown:
            print(markdown(shown))
            return
        owners = owner_of()
        rows = [(kind, name, summary(cls), owners[cls]) for kind, parts in shown.items() for name, cls in parts.items()]
        print_table(("kind", "name", "what it does", "from"), rows)
        print_failures()


COMMAND = ComponentsCommand


def owner_of() -> dict[type[Component], str]:
    """The distribution that offers each component."""
    distributions = {plugin.name: plugin.distribution or plugin.name for plugin in records()}
    return {cls: distributions[owner] for owner, _, cls in offered("surfkit_components")}


def markdown(kinds: Kinds) -> str:
    """A page of all components with their settings."""
    lines = ["# Components", "", "Written by `surfkit components --markdown`."]
    for kind, parts in kinds.items():
        lines += ["", f"## {kind}", "", summary(kind_of(next(iter(parts.values()))))]
        for name, cls in parts.items():
            lines += ["", f"### `{name}`", "", summary(cls)]
            rows = [(f"`{s.name}`", s.type, f"`{s.default}`", s.help) for s in settings(cls)]
            if rows:
                lines += ["", "| setting | type | default | |", "|---|---|---|---|"]
                lines += [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows]
    return "\n".join(lines)
