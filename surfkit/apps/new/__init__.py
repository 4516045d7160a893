"""`surfkit new plugin`: a package of one part, with tests, to begin with."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.apps.new.plugin_names import Names, checked_names
from surfkit.apps.new.write import Template, template_of, write_package


@dataclass(frozen=True)
class NewPluginCommand:
    """Write the files of a new plugin: an installable package with one working part of a chosen kind, its tests and,
    where the part belongs into a recipe, a recipe and an ablation table.

    The part is named as the package is, without "surfkit-". Nothing is overwritten.
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Name of the package in kebab-case, such as surfkit-oversized."""

    kind: str = "prune"
    """Kind of the part: one of those that `surfkit components` lists, such as prune, densify, loss or mesher, or
    `command` for a command of surfkit."""

    out: Path | None = None
    """Folder to write, which must not exist. Default: NAME."""

    def run(self) -> None:
        """Write the files, and print what to do next."""
        template = template_of(self.kind)
        names = checked_names(self.name, self.kind, template)
        out = self.out or Path(self.name)
        write_package(out, names, template)
        print(_next(out, names, template))


COMMAND = {"plugin": NewPluginCommand}


def _next(out: Path, names: Names, template: Template) -> str:
    """What was written, and the commands that come next."""
    folder = shlex.quote(str(out))
    steps = [
        (f"pip install -e {folder}", "install it; later changes of its files need no other installation"),
        (template.listed, f"see {names.part} among the others"),
        (f"pytest {folder}/tests", "run its tests"),
    ]
    if template.is_in_recipes:
        steps.append((f"surfkit ablate table:{names.part} --data DATA", "train without it and with it, and compare"))
    width = max(len(command) for command, _ in steps)
    lines = [f"  {command:<{width}}  # {what}" for command, what in steps]
    part = out / names.module / f"{names.identifier}.py"
    return "\n".join([f"wrote {out}: {names.part}, a part of the kind {names.kind}, in {part}", "", "next:", *lines])
