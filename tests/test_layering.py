"""A folder imports only folders on lower floors, and no file grows too long."""

import ast
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import surfkit

ROOT = Path(surfkit.__file__).parent
FLOORS = (
    "core",
    "scene",
    "io raster",
    "primitives losses depth",
    "densify appearance start",
    "partition mesh evaluate",
    "train",
    "compress",
    "runs",
    "study",
    "cli api",
    "apps",
    "testing",
)
INSIDE = {
    "io": (".", "splats", "datasets"),
    "raster": ("native nvrtc", "."),
    "compress": (". levels",),
    "train": (".", "refine"),
    "runs": ("execute methods", ".", "blocks", "pipeline run_status"),
    "study": (".", "recipes"),
    "apps": ("sfm doctor report render texture new", "maps view", "quality", ".", "make benchmark"),
}
"""Floors inside a folder; "." is all in it that is not named."""
LEVEL = {name: level for level, floor in enumerate(FLOORS) for name in floor.split()}
MOST_FOLDERS, MOST_ARROWS = 21, 140
"""A house that one can hold in the head: folders, and pairs of folders of which one imports the other."""
TEMPLATES = ROOT / "apps" / "new" / "templates"
"""Files of other packages: `surfkit new` writes them."""
FILES = sorted(path for path in ROOT.rglob("*.py") if TEMPLATES not in path.parents)
LONGEST = 400
ENTRIES = {"__init__", "__main__", "plugin"}
"""Of the package itself, above all folders."""


def imported(source: str, package: tuple[str, ...] = ("surfkit",)) -> Iterator[str]:
    """Full names of everything a module imports, also inside functions; `package` is where it lies."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else ()
            yield from (".".join([*base, *filter(None, [node.module]), alias.name]) for alias in node.names)


def upward(source: str, here: str) -> list[str]:
    """Imports of a module in folder `here` that lie on no lower floor."""
    names = [name.split(".")[1] for name in imported(source, ("surfkit", here)) if name.startswith("surfkit.")]
    return [there for there in names if there != here and LEVEL.get(there, len(FLOORS)) >= LEVEL[here]]


def test_nothing_imports_upwards():
    wrong = []
    for path in FILES:
        here = path.relative_to(ROOT).with_suffix("").parts[0]
        if here not in ENTRIES:
            wrong += [f"{path.relative_to(ROOT)} imports {there}" for there in upward(path.read_text(), here)]
    assert not wrong


def test_few_folders_and_few_arrows_between_them():
    arrows = set()
    for path in FILES:
        here, *inner = path.relative_to(ROOT).with_suffix("").parts
        names = imported(path.read_text(), ("surfkit", here, *inner[:-1])) if here not in ENTRIES else ()
        arrows |= {(here, name.split(".")[1]) for name in names if name.startswith("surfkit.")}
    arrows = {(here, there) for here, there in arrows if here != there and there in LEVEL}
    assert len(LEVEL) <= MOST_FOLDERS and 100 < len(arrows) <= MOST_ARROWS


@pytest.mark.parametrize("folder", INSIDE)
def test_nothing_inside_a_folder_imports_upwards(folder):
    level = {name: level for level, floor in enumerate(INSIDE[folder]) for name in floor.split()}
    wrong, met = [], set()
    for path in (ROOT / folder).rglob("*.py"):
        if TEMPLATES in path.parents:
            continue
        inner = path.relative_to(ROOT / folder).with_suffix("").parts
        here = inner[0] if inner[0] in level else "."
        for name in imported(path.read_text(), ("surfkit", folder, *inner[:-1])):
            if name.startswith(f"surfkit.{folder}."):
                there = name.split(".")[2] if name.split(".")[2] in level else "."
                met |= {here, there}
                wrong += [f"{path} imports {name}"] * (here != there and level[there] >= level[here])
    assert not wrong and met >= level.keys() - {"new"}


def included(path: Path) -> list[str]:
    """Folders of surfkit that a C++ file includes files of."""
    found = re.findall(r'(?m)^#include "([^"]+)"', path.read_text())
    inside = [os.path.relpath((path.parent / name).resolve(), ROOT) for name in found]
    return [Path(name).parts[0] for name in inside]


def test_nothing_includes_upwards():
    """The same floors hold for the C++ sources; the one module that binds them all names the others' functions only."""
    sources = [*ROOT.rglob("*.cpp"), *ROOT.rglob("*.h"), *ROOT.rglob("*.cu")]
    wrong = []
    for path in sources:
        here = path.relative_to(ROOT).parts[0]
        lower = {here, *(name for name, level in LEVEL.items() if level < LEVEL[here])}
        wrong += [f"{path.relative_to(ROOT)} includes {there}" for there in included(path) if there not in lower]
    assert len(sources) > 10 and not wrong
    assert any("raster" in included(path) for path in sources), "the check reads includes"


def test_every_folder_has_a_floor():
    tops = {path.relative_to(ROOT).with_suffix("").parts[0] for path in FILES} - ENTRIES
    assert tops <= LEVEL.keys()


def test_core_and_the_command_table_are_light():
    for path in [*(ROOT / "core").glob("*.py"), ROOT / "__init__.py", ROOT / "cli" / "__init__.py"]:
        heavy = {name.split(".")[0] for name in imported(path.read_text())} & {"torch", "numpy", "PIL", "pycolmap"}
        assert not heavy, f"{path.relative_to(ROOT)} imports {heavy}"


def test_files_are_short():
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in FILES}
    assert not {name: length for name, length in lengths.items() if length > LONGEST}


def test_the_check_sees_every_way_to_import():
    for source in (
        "import surfkit.train.stage",
        "from surfkit.train import stage",
        "from surfkit import train",
        "def f():\n    from surfkit.train.stage import Stage",
        "from ..train import stage",
    ):
        assert upward(source, "densify") == ["train"], source
    assert upward("from surfkit.mesh import x", "partition") == ["mesh"]  # neighbours on one floor
    assert upward("from surfkit.losses import x", "primitives") == ["losses"]
    assert not upward("from surfkit.core import x\nfrom .adc import ADC\nimport torch", "densify")
    assert upward("from surfkit import Prune", "densify") == ["Prune"]  # the public names may lie on any floor


def test_every_conftest_below_the_first_is_in_a_package():
    """Two modules called `conftest` shadow each other: classes of the first lose their source, and so their texts."""
    tests = Path(__file__).parent
    found = [path for path in tests.rglob("conftest.py") if path.parent != tests]
    assert found and not [path for path in found if not (path.parent / "__init__.py").exists()]
