"""The files of a new plugin, made from those in `templates`.

Templates are files of Python with placeholders that are legal names: `new_plugin` is the module of the package,
`new_part` that of the part, `NewPart` its class. Each kind has a folder with part.py and test.py, with init.py where
its hooks differ from those in `common`, and with use.txt where another command uses the part.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from surfkit.core.check import BadInput
from surfkit.core.describe import by_kind
from surfkit.core.files import replacing_folder
from surfkit.core.registry import unknown

if TYPE_CHECKING:
    from surfkit.apps.new.plugin_names import Names

TEMPLATES_FOLDER = Path(__file__).parent / "templates"
COMMON = TEMPLATES_FOLDER / "common"
COMMAND = "command"
"""What a package can offer beside components."""


@dataclass(frozen=True)
class Template:
    """What the files of a plugin of one kind are made from.

    Attributes:
        kind: As `surfkit components` names it, or "command".
        part: Text of the module of the part.
        init: Of the package's `__init__.py`, with its hooks.
        test: Of its tests.
        use: A command that uses the part.
        is_in_recipes: Whether it offers a recipe and an ablation table.
    """

    kind: str
    part: str
    init: str
    test: str
    use: str
    is_in_recipes: bool

    @property
    def listed(self) -> str:
        """The command that lists the part among others."""
        return "surfkit plugins" if self.kind == COMMAND else f"surfkit components {self.kind}"

    @property
    def python(self) -> dict[str, str]:
        """Texts of the Python files, by path in the package."""
        return {
            "new_plugin/__init__.py": self.init,
            "new_plugin/new_part.py": self.part,
            "tests/test_new_part.py": self.test,
        }


def kinds() -> list[str]:
    """The kinds that have a template."""
    return sorted(folder.name for folder in TEMPLATES_FOLDER.iterdir() if (folder / "part.py").is_file())


def template_of(kind: str) -> Template:
    """The template of a kind of part.

    Raises:
        BadInput: There is none.
    """
    if kind not in kinds():
        known = by_kind()
        if kind not in known:
            raise BadInput(unknown("kind of component", kind, [*known, COMMAND]))
        raise BadInput(
            f"no template for the kind {kind!r}; those with one are {', '.join(kinds())}; docs/kinds.md shows what a "
            f"{kind} must write, to replace the part of another kind with"
        )
    folder = TEMPLATES_FOLDER / kind
    part, test = _text(folder / "part.py"), _text(folder / "test.py")
    common = COMMON / ("init.py" if "\nCHANGE: " in part else "alone.py")
    init = _text(folder / "init.py" if (folder / "init.py").is_file() else common)
    use = folder / "use.txt" if (folder / "use.txt").is_file() else COMMON / "use.txt"
    return Template(kind, part, init, test, _text(use).strip(), "surfkit_tables" in init)


def write_package(out: Path, names: Names, template: Template) -> None:
    """Write the files of a plugin into a new folder, which appears when it is complete.

    Raises:
        BadInput: The folder exists.
    """
    if out.exists() or out.is_symlink():
        raise BadInput(f"{out} exists already, and is not overwritten; delete it, or name another folder with --out")
    with replacing_folder(out) as folder:
        for path, text in files(names, template):
            (folder / path).parent.mkdir(exist_ok=True)
            (folder / path).write_text(text, encoding="utf-8")


def files(names: Names, template: Template) -> Iterator[tuple[str, str]]:
    """Path and text of each file of a plugin."""
    needs = ", ".join(f'"{name}"' for name in _dependencies(template))
    tables = (COMMON / "readme_table.md").read_text(encoding="utf-8") if template.is_in_recipes else ""
    readme = _text(COMMON / "README.md").replace("NEW_TABLE\n", tables)
    readme = readme.replace("NEW_USE", template.use).replace("NEW_LIST", template.listed)
    texts = {
        ".gitignore": _text(COMMON / "gitignore"),
        "README.md": readme,
        "pyproject.toml": _text(COMMON / "pyproject.toml").replace('"NEW_NEEDS"', needs),
        **template.python,
    }
    for path, text in texts.items():
        yield _named(path, names), _named(text, names)


def _named(text: str, names: Names) -> str:
    """A text with names in the place of placeholders."""
    words = {
        "new_plugin": names.module,
        "new-plugin": names.package,
        "new_part": names.identifier,
        "new-part": names.part,
        "NewPart": names.cls,
        "new-kind": names.kind,
    }
    return re.sub("|".join(words), lambda found: words[found[0]], text)


def _dependencies(template: Template) -> list[str]:
    """The packages that the part and its hooks import, surfkit first; their names are those of their modules."""
    found = set()
    for path, text in template.python.items():
        for node in ast.walk(ast.parse(text)) if path.startswith("new_plugin") else ():
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
            found |= {name.partition(".")[0] for name in names}
    return ["surfkit", *sorted(found - {"surfkit"} - set(sys.stdlib_module_names))]


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")
