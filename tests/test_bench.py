"""The scripts of bench/ name what is there, also in the programs that they write: nothing else would tell."""

import ast
import importlib
import re
from contextlib import suppress

import pytest
from pages import ROOT

SCRIPTS = sorted((ROOT / "bench").rglob("*.py"))
INSIDE = re.compile(r"^(?:from surfkit|import surfkit)[\w.]*.*$", re.M)
"""An import at the beginning of a line, in a text that is a program."""


def imports(source):
    """Module and name of everything from surfkit that a script imports; the name is None for a mere module."""
    tree = ast.parse(source)
    texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    for found in [tree, *(ast.parse("\n".join(INSIDE.findall(text))) for text in texts if INSIDE.search(text))]:
        for node in ast.walk(found):
            if isinstance(node, ast.Import):
                yield from ((alias.name, None) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield from ((node.module, alias.name) for alias in node.names)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.relative_to(ROOT / "bench").as_posix())
def test_imports_are_there(path):
    for module, name in imports(path.read_text()):
        if module.split(".")[0] != "surfkit":
            continue
        home = importlib.import_module(module)
        if name is not None and not hasattr(home, name):
            with suppress(ModuleNotFoundError):
                importlib.import_module(f"{module}.{name}")
                continue
            pytest.fail(f"{path.name} imports {name}, which {module} does not have")


def test_programs_inside_are_seen():
    source = (
        'RUN = """\nfrom surfkit.runs.recipe import Recipe, Lost\n"""\n\ndef f():\n    from surfkit import Mesher\n'
    )
    assert set(imports(source)) == {
        ("surfkit.runs.recipe", "Recipe"),
        ("surfkit.runs.recipe", "Lost"),
        ("surfkit", "Mesher"),
    }
