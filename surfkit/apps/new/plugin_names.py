"""The names in a new plugin, all made from that of its package, and what they must not be."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import keyword
import re
from collections.abc import Iterator
from dataclasses import dataclass

from surfkit.apps.new.write import Template
from surfkit.core.check import BadInput
from surfkit.core.registry import offered, records

PREFIX = "surfkit-"
KEBAB = r"[a-z][a-z0-9]*(-[a-z0-9]+)*"
MAX_NAME_LETTERS = 60
"""Letters of a name."""


@dataclass(frozen=True)
class Names:
    """What things are called in a new plugin.

    Attributes:
        package: Of the distribution, such as surfkit-oversized.
        kind: Of the part, such as prune.
    """

    package: str
    kind: str

    @property
    def module(self) -> str:
        """The package as Python imports it."""
        return self.package.replace("-", "_")

    @property
    def part(self) -> str:
        """The part, its recipe and its table, as users type them."""
        return self.package.removeprefix(PREFIX)

    @property
    def identifier(self) -> str:
        """The module of the part."""
        return self.part.replace("-", "_")

    @property
    def cls(self) -> str:
        """The class of the part."""
        return "".join(word.capitalize() for word in self.part.split("-"))


def checked_names(package: str, kind: str, template: Template) -> Names:
    """The names in a plugin of which none is in use.

    Raises:
        BadInput: The package cannot be called so.
    """
    if not re.fullmatch(KEBAB, package) or len(package) > MAX_NAME_LETTERS:
        raise BadInput(
            f"{package!r} is not a package name in kebab-case (lower-case letters, digits, single hyphens, a letter "
            f"first, {MAX_NAME_LETTERS} characters at most); give one such as {PREFIX}oversized"
        )
    names = Names(package, kind)
    if not names.part or not names.identifier.isidentifier() or keyword.iskeyword(names.identifier):
        raise BadInput(f"{package!r}: its part would be named {names.part!r}, which Python cannot import; give another")
    for what, there in _there(names):
        raise BadInput(f"{package!r}: {what} named {there!r} is there already; give another name")
    if {names.cls, names.identifier} & set(_names_used(template)):
        raise BadInput(f"{package!r}: {names.cls} or {names.identifier} is a name that its files import; give another")
    return names


def _names_used(template: Template) -> Iterator[str]:
    """Names that stand in the Python files of a template."""
    for text in template.python.values():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Name):
                yield node.id
            elif isinstance(node, ast.alias):
                yield node.asname or node.name.partition(".")[0]


def _there(names: Names) -> Iterator[tuple[str, str]]:
    """What has one of the names already: what it is, and the name."""
    if importlib.util.find_spec(names.module) is not None:
        yield "a Python package", names.module
    try:
        importlib.metadata.distribution(names.package)
    except importlib.metadata.PackageNotFoundError:
        pass
    else:
        yield "an installed package", names.package
    if names.part in {plugin.name for plugin in records()}:
        yield "a plugin", names.part
    words = {
        "surfkit_components": "a component",
        "surfkit_recipes": "a recipe",
        "surfkit_tables": "an ablation table",
        "surfkit_commands": "a command",
    }
    for hook, what in words.items():
        if names.part in {name for _, name, _ in offered(hook)}:
            yield what, names.part
