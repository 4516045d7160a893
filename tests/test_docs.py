"""What README and docs/ say is true: links, anchors, paths, commands, options, parts, settings. Nothing is run here."""

import ast
import builtins
import importlib.util
import json
import re
import shlex
from functools import cache

import pytest
import test_layering
from pages import NOTES, PAGES, ROOT, anchors, code, named, prose, spans, title

from surfkit.cli import COMMANDS
from surfkit.cli.parse import parse
from surfkit.cli.recipes import recipes
from surfkit.core.codec import dump, write_json
from surfkit.core.hooks import HOOKS
from surfkit.core.registry import kebab, kind_of, offered, records
from surfkit.study.ablation import offered_tables

SLOTS = {
    "mesh": "mesher",
    "depth": "depth-estimator",
    "estimator": "depth-estimator",
    "features": "feature-extractor",
    "matcher": "feature-matcher",
    "losses": "loss",
    "filters": "filter",
    "regularizers": "regularizer",
    "compress": "compressor",
    "lod": "levels-of-detail",
}
"""Kinds of parts whose slot in a recipe or a command has another name."""
TUTORIAL = ROOT / "docs" / "plugins.md"
PLUGINS = {folder.name for folder in (ROOT / "plugins").glob("surfkit-*")}
PLACEHOLDER = re.compile(r"\[|(?:^|:)(?:NAME|COMMAND|FIELD|BLOCK)\b|FIELD:|\.\.\.")
"""In a word of a command that cannot be given as it stands."""
MOST_LINES = 80
"""Of README."""
MOST_BYTES = 8_000
"""Of the results, docs/measured.md: what else was measured is a note in bench/log."""


@pytest.mark.parametrize("page", [*PAGES, *NOTES], ids=title)
def test_links(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f"{title(page)} links to {target}, which is not there"
        if anchor:
            assert anchor in anchors(there), f"{title(page)} links to {target}; {path} has {sorted(anchors(there))}"


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_paths(page):
    for path in named(page):
        assert (ROOT / path).exists(), f"{title(page)} names {path}, which is not there"


@pytest.fixture
def somewhere(tmp_path, monkeypatch):
    """A working folder with the files that commands in the pages name, on a machine that has every package."""
    monkeypatch.setattr("surfkit.runs.mesh_output.require_kernels", lambda what: None)
    for name in ("surfkit.runs.mesh_output", "surfkit.evaluate.geometry.comparison"):
        monkeypatch.setattr(f"{name}.require_area", lambda: None)
    monkeypatch.chdir(tmp_path)
    for name in ("my-recipe.json", "RUN/recipe.json"):
        write_json(tmp_path / name, recipes()["2dgs"])
    write_json(tmp_path / "my-table.json", {"name": "mine", "base": "2dgs", "rows": [{"label": "base"}]})


@pytest.mark.parametrize("page", [page for page in PAGES if page != TUTORIAL], ids=title)
def test_commands_parse(page, somewhere):
    installed = {plugin.distribution for plugin in records() if not plugin.error}
    if lacking := PLUGINS & {page.parent.name} - installed:
        pytest.skip(f"{', '.join(lacking)} is not installed")
    for text in commands(page):
        words = shlex.split(text, comments=True)[1:]
        if words and not any(map(PLACEHOLDER.search, words)):
            parses(tuple(words), f"{title(page)}: {text}")


def commands(page):
    """Every `surfkit ...` of a page, in code or between backticks; mentions of a mere command too."""
    lines = [line.strip() for block in code(page) if block.language in ("", "sh") for line in block.text.splitlines()]
    parts = [part.strip() for line in lines for part in line.split("&&")]
    return [text for text in [*parts, *spans(page)] if re.match(r"surfkit( |$)", text)]


@cache
def parses(words, where):
    name, *rest = words
    if name.startswith("-"):
        return
    assert name in COMMANDS, f"{where}: no such command"
    command, told = importlib.import_module(COMMANDS[name].module).COMMAND, f"surfkit {name}"
    if isinstance(command, dict):
        command, rest = (command[rest[0]], rest[1:]) if rest else (None, [])
    if not rest:
        return  # a mention
    try:
        parse(command, rest, told)
    except SystemExit as stop:
        assert stop.code in (0, None), where
    except Exception as error:
        pytest.fail(f"{where}: {error}")


@cache
def parts():
    """Names of components by kind."""
    found: dict[str, set[str]] = {"recipe": set(recipes()), "table": set(offered_tables())}
    for _, name, cls in offered("surfkit_components"):
        found.setdefault(kebab(kind_of(cls).__name__), set()).add(name)
    return found


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent.name not in PLUGINS], ids=title)
def test_parts_are_there(page):
    for span in spans(page):
        if not (found := re.fullmatch(r"([a-z][\w.]*):([a-z0-9][a-z0-9-]*)", span)) or page == TUTORIAL:
            continue
        last = [word for word in found[1].split(".") if not word.isdecimal()]
        at = next((SLOTS.get(word, word) for word in reversed(last) if SLOTS.get(word, word) in parts()), None)
        assert at, f"{title(page)}: {span}: {found[1]} is no place for a part"
        assert found[2] in parts()[at] | {"none"}, f"{title(page)}: {span}: there is {sorted(parts()[at])}"


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_options_are_there(page):
    known = set(re.findall(r"`--([\w-]+)", (ROOT / "docs" / "commands.md").read_text()))
    known |= {name.removeprefix("no-") for name in known} | set(recipe_settings()) | settings_of_package(page.parent)
    for span in spans(page):
        if not span.startswith("--"):
            continue
        for flag in re.findall(r"(?<!\S)--([A-Za-z][\w.-]*)", span):
            assert flag.split(".")[-1].removeprefix("no-") in known, f"{title(page)}: --{flag} is no option"


def settings_of_package(folder):
    """Names of what may be settings of the parts of a package in plugins/, inherited ones too."""
    if folder.name not in PLUGINS:
        return set()
    package = folder.name.replace("-", "_")
    named = [re.findall(r"^    (\w+):", source.read_text(), re.M) for source in folder.glob(f"{package}/**/*.py")]
    own = (cls for _, _, cls in offered("surfkit_components") if cls.__module__.partition(".")[0] == package)
    named += [list(getattr(cls, "__dataclass_fields__", ())) for cls in own]
    return {name.replace("_", "-") for names in named for name in names}


@cache
def recipe_settings():
    """Names of all settings, of recipes and of their parts, as options have them."""
    page = (ROOT / "docs" / "components.md").read_text()
    plain = set(re.findall(r"^\| `(\w+)`", page, re.M)) | set(vars(recipes()["2dgs"]))
    plain |= set(vars(recipes()["2dgs"].pretrain))
    return [name.replace("_", "-") for name in plain] + ["VARIABLE", "NAME", "help", "version", "context"]


@pytest.mark.parametrize("page", PAGES, ids=title)
def test_targets_and_extras_are_there(page):
    makefile, project = (ROOT / "Makefile").read_text(), (ROOT / "pyproject.toml").read_text()
    text = page.read_text()
    for target in re.findall(r"(?:`|^    )make ([a-z]+)", text, re.M):
        assert re.search(rf"^{target}:", makefile, re.M), f"{title(page)}: make {target}"
    for extra in re.findall(r"surfkit\[([\w,]+)\]", text):
        assert re.search(rf"^{extra} = \[", project, re.M), f"{title(page)}: surfkit[{extra}]"


def test_settings_of_the_paper():
    settings = [span for span in spans(ROOT / "docs" / "paper.md") if re.match(r"[a-z][\w-]*: .* = ", span)]
    assert len(settings) > 20
    for span in settings:
        name, path, value = re.fullmatch(r"([\w-]+): (\S+) = (.*)", span).groups()
        found = dump(recipes()[name])
        for step in path.split("."):
            found = found[int(step)] if isinstance(found, list) else found[step]
        assert found == json.loads(value), f"paper.md says {span}, and it is {found}"


def test_rows_of_the_paper():
    cells = {span for span in spans(ROOT / "docs" / "paper.md")}
    for table in ("model", "gradient"):
        for row in offered_tables()[table].rows:
            assert row.label in cells, f"paper.md lacks the row {row.label!r} of table:{table}"


def test_systems_of_the_paper():
    """Recipes of methods, and rows of `table:methods`, that the table of related work names: they are there, and no row
    is missing but those that the paper does not name."""
    text = (ROOT / "docs" / "paper.md").read_text()
    lines = text[text.index("## Related work") : text.index("## Figures")].splitlines()
    cells = [line.split("|")[1:4] for line in lines if line.startswith("| ")][1:]
    here = " ".join(cell for _, cell, _ in cells)
    named, labels = set(re.findall(r"`recipe:([\w-]+)`", here)), set(re.findall(r"`([^`]+)`", here))
    assert len(cells) > 30 and len(named) > 15 and not named - set(recipes()), named - set(recipes())
    rows = {row.label for row in offered_tables()["methods"].rows}
    for _, cell, _ in cells:
        for spans_of_row in re.findall(r"rows? (`[^`]+`(?:, `[^`]+`)*)", cell):
            assert set(re.findall(r"`([^`]+)`", spans_of_row)) <= rows, cell
    not_named = {"AbsGS", "Taming 3DGS", "PGSR", "Scaffold-GS", "CityGaussianV2", "surface (ours)", "stereo alone"}
    assert rows - labels <= not_named, f"paper.md lacks {rows - labels - not_named}"


@pytest.mark.parametrize("name", ["commands", "kinds", "floors"])
def test_what_is_generated_is_current(name):
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    page = ROOT / "docs" / f"{name}.{'svg' if name == 'floors' else 'md'}"
    assert getattr(module, name)() == page.read_text(), "run `python docs/generate.py`"


def test_every_kind_is_shown_as_python_with_all_its_types():
    page = (ROOT / "docs" / "kinds.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    assert len(blocks) == page.count("\n## ") > 15
    for block in blocks:
        *imports, shown = ast.parse(block).body
        known = {alias.name for line in imports for alias in line.names} | {shown.name, *vars(builtins)}
        methods = [node for node in shown.body if isinstance(node, ast.FunctionDef)]
        assert methods and all(node.returns and ast.get_docstring(node) for node in methods), shown.name
        for node in methods:
            hints = [each.annotation for each in node.args.args[1:]] + [node.returns]
            used = {each.id for hint in hints for each in ast.walk(hint) if isinstance(each, ast.Name)}
            assert used <= known, f"{shown.name}.{node.name}: nothing says where {used - known} come from"


def test_every_folder_is_explained():
    page = (ROOT / "docs" / "architecture.md").read_text()
    tops = {path.relative_to(test_layering.ROOT).with_suffix("").parts[0] for path in test_layering.FILES}
    for folder in tops - test_layering.ENTRIES:
        assert f"| `{folder}` |" in page, f"architecture.md does not say what is in {folder}"


def test_every_hook_is_explained():
    for hook in HOOKS:
        assert re.search(rf"^\| `{hook}\(.*\)` \|", TUTORIAL.read_text(), re.M), f"plugins.md does not explain {hook}"


def test_every_page_can_be_found():
    contents, index = (ROOT / "mkdocs.yml").read_text(), (ROOT / "docs" / "index.md").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert f": {page.name}\n" in contents, f"{page.name} is not in the nav of mkdocs.yml"
        if page.name != "index.md":
            assert f"({page.name})" in index, f"index.md does not link to {page.name}"
            assert f"(docs/{page.name})" in (ROOT / "README.md").read_text(), f"README does not link to {page.name}"


def test_readme_is_short():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= MOST_LINES
    examples = next(block for block in code(ROOT / "README.md") if "recipe:surface" in block.text)
    assert len(examples.text.splitlines()) == 10


def test_results_are_short():
    assert len((ROOT / "docs" / "measured.md").read_bytes()) <= MOST_BYTES
