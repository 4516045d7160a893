"""A plugin of surfkit: a command."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit import LazyCommand, hookimpl


@hookimpl
def surfkit_commands() -> Mapping[str, LazyCommand]:
    """The command, by the word that users type; its module is imported only when it is given."""
    return {"new-part": LazyCommand("new_plugin.new_part", "Count the splats of a run by their opacity.")}
