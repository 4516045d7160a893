"""What a plugin may implement: the hooks, and the mark that makes a function one of them. Loads pluggy only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pluggy

if TYPE_CHECKING:
    from surfkit.core.registry import Component

hookspec, hookimpl = pluggy.HookspecMarker("surfkit"), pluggy.HookimplMarker("surfkit")


@dataclass(frozen=True)
class LazyCommand:
    """A command of `surfkit` whose module is imported only when somebody gives it.

    Attributes:
        module: Where it is: `COMMAND` in it is a dataclass whose docstring and fields are the help and whose `run()`
            does the work, or a mapping of several of these, by a second word.
        summary: The line that `surfkit --help` shows.
        goes_on: Given again, it goes on with what an interrupted one has done.
        memory_advice: What a user can lower where memory runs out.
    """

    module: str
    summary: str
    goes_on: bool = False
    memory_advice: str = "more memory is needed"


class Hooks:
    """What a plugin may implement; each function is marked with `hookimpl`. pluggy reads their signatures only."""

    @hookspec
    def surfkit_components(self) -> Mapping[str, type[Component]]:
        """Return the components this package offers, by the name users type."""
        raise NotImplementedError

    @hookspec
    def surfkit_recipes(self) -> Mapping[str, Any]:
        """Return the recipes this package offers, by the name users type."""
        raise NotImplementedError

    @hookspec
    def surfkit_tables(self) -> Mapping[str, Any]:
        """Return the ablation tables this package offers, by the name users type."""
        raise NotImplementedError

    @hookspec
    def surfkit_rows(self) -> Mapping[str, Any]:
        """Return rows that this package adds to tables that are there, a sequence by the name of the table."""
        raise NotImplementedError

    @hookspec
    def surfkit_commands(self) -> Mapping[str, type | LazyCommand]:
        """Return the commands this package adds to `surfkit`, by the word that users type.

        Each is a dataclass: its docstring and its fields are the help, and `run()` does the work and returns an exit
        status, or None for 0. Or it is a `LazyCommand`, which names the module that has it.
        """
        raise NotImplementedError

    @hookspec
    def surfkit_event(self, event: Any) -> None:
        """See one event of a run: a stage began, a step ended, a file was written."""


HOOKS = tuple(name for name in vars(Hooks) if name.startswith("surfkit_"))
