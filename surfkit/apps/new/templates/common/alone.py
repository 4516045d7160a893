"""A plugin of surfkit: a part that is chosen on the command line."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, hookimpl

from .new_part import NewPart


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The part, by the name that commands use."""
    return {"new-part": NewPart}
