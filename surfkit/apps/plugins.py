"""`surfkit plugins`: what is installed beside surfkit itself."""

from __future__ import annotations

from dataclasses import dataclass

from surfkit.cli.console_table import print_table
from surfkit.core.registry import Plugin, offered, records


@dataclass(frozen=True)
class PluginsCommand:
    """List the plugins: package, components, and the error if one does not load.

    The environment variable SURFKIT_PLUGINS limits which are used: "none", or names separated by commas.
    """

    def run(self) -> None:
        """Print one line per plugin."""
        offers: dict[str, list[str]] = {}
        prefixes = {
            "surfkit_components": "",
            "surfkit_recipes": "recipe:",
            "surfkit_tables": "table:",
            "surfkit_rows": "rows of table:",
            "surfkit_commands": "command ",
        }
        for hook, prefix in prefixes.items():  # before `records`, which then knows what failed here
            for owner, name, _ in offered(hook):
                offers.setdefault(owner, []).append(prefix + name)
        known = records()
        rows = [(p.name, p.distribution, p.version, _offers_text(p, offers.get(p.name, []))) for p in known]
        failed = [i for i, plugin in enumerate(known) if plugin.error]
        print_table(("plugin", "package", "version", "offers"), rows, errors=failed)


COMMAND = PluginsCommand


def _offers_text(plugin: Plugin, offers: list[str]) -> str:
    if plugin.error:
        return f"not in use: {plugin.error}"
    return ", ".join([*offers, *["listens to events"] * ("surfkit_event" in plugin.hooks)]) or "nothing"
