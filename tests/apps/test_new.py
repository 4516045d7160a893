"""`surfkit new plugin`: the package of every kind is installed as its pyproject says, listed, built into recipes and
tables, and passes its own tests; nothing is overwritten, and names that cannot be used are refused."""

import ast
import json
import os
import sys
from importlib import metadata

import pytest
import tomllib
from forks import Forked
from needs import needs_native

from surfkit.apps.components import by_kind, owner_of
from surfkit.apps.new import write
from surfkit.apps.new.plugin_names import Names
from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.core import registry
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.runs.recipe import Recipe
from surfkit.study.ablation import build, offered_tables

KINDS = write.kinds()
ALONE = {
    "executor",
    "feature-extractor",
    "feature-matcher",
    "format",
    "split",
    "reader",
    "depth-layout",
    "rasterizer",
    "command",
}
"""Kinds that stand in no recipe."""


def names(kind):
    return Names(f"surfkit-tried-{kind}", kind)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A package of each kind, written by the command, with the files that pip writes of it; no other is in use."""
    site = tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SURFKIT_PLUGINS", "none")
        registry.reload()
        for kind in KINDS:
            folder = site / "written" / kind
            assert main(["new", "plugin", names(kind).package, "--kind", kind, "--out", str(folder)]) == 0
            project = tomllib.loads((folder / "pyproject.toml").read_text())
            for package in project["tool"]["setuptools"]["packages"]:
                (site / package).symlink_to(folder / package)
            info = site / f"{names(kind).module}-{project['project']['version']}.dist-info"
            info.mkdir()
            version = f"Name: {project['project']['name']}\nVersion: {project['project']['version']}\n"
            (info / "METADATA").write_text(f"Metadata-Version: 2.1\n{version}")
            points = [f"{key} = {value}\n" for key, value in project["project"]["entry-points"]["surfkit"].items()]
            (info / "entry_points.txt").write_text("[surfkit]\n" + "".join(points))
        patch.setenv("SURFKIT_PLUGINS", ",".join(names(kind).part for kind in KINDS))
        patch.syspath_prepend(str(site))
        registry.reload()
        yield site
    registry.reload()


def test_every_kind_has_a_template(monkeypatch):
    monkeypatch.setenv("SURFKIT_PLUGINS", "none")
    registry.reload()
    assert {*by_kind(), "command"} == set(KINDS)
    registry.reload()


def test_the_part_is_listed_under_its_kind(site):
    assert not registry.failures()
    owners = owner_of()
    for kind in by_kind():
        assert owners[by_kind()[kind][names(kind).part]] == names(kind).package


@pytest.mark.parametrize("kind", KINDS)
def test_recipes_and_tables(site, kind):
    part = names(kind).part
    assert (part in recipes()) == (part in offered_tables()) == (kind not in ALONE)
    if kind in ALONE:
        return
    baseline, changed = build(offered_tables()[part]).values()
    for recipe in (recipes()[part], baseline, changed):
        recipe.refuse_unfit()
        assert load(Recipe, json.loads(json.dumps(dump(recipe)))) == recipe
    assert f'"use": "{part}"' in json.dumps(dump(recipes()[part]))
    assert f'"use": "{part}"' in json.dumps(dump(changed))
    assert f'"use": "{part}"' not in json.dumps(dump(baseline))


@needs_native
def test_their_own_tests_pass(site, tmp_path):
    """In one process, that has loaded torch."""
    paths = [str(site), *filter(None, [os.environ.get("PYTHONPATH")])]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(site / "written")]
    given = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    with open(tmp_path / "log", "ab") as log:
        process = Forked(command, given, None, log, log, True)
    status, said = process.wait(), (tmp_path / "log").read_text()
    assert status == 0, said[-4_000:]
    assert "passed" in said and "skipped" not in said
    for kind in KINDS:
        tests = (site / "written" / kind / "tests" / f"test_{names(kind).identifier}.py").read_text()
        assert tests.count("\ndef test_") >= 2


@pytest.mark.parametrize("kind", KINDS)
def test_the_files(site, kind):
    folder = site / "written" / kind
    there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if "__pycache__" not in path.parts}
    module, part = names(kind).module, names(kind).identifier
    files = {f"{module}/__init__.py", f"{module}/{part}.py", f"tests/test_{part}.py"}
    assert there == {".gitignore", "README.md", "pyproject.toml", module, "tests", *files}
    for name in there - {module, "tests"}:
        text = (folder / name).read_text()
        assert not [word for word in ("new_p", "new-p", "NewPart", "new-kind", "NEW_") if word in text], name
        assert len(text) > 50 and text.endswith("\n"), name
    needed = set(tomllib.loads((folder / "pyproject.toml").read_text())["project"]["dependencies"])
    assert needed == imported(folder / module), "dependencies are what is imported"
    for name in needed - {"surfkit"}:
        assert metadata.version(name)


def imported(folder):
    """Packages that the files of a folder import, but the standard library."""
    nodes = [node for path in folder.glob("*.py") for node in ast.walk(ast.parse(path.read_text()))]
    found = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    found |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and not node.level}
    return {name.split(".")[0] for name in found} - set(sys.stdlib_module_names)


def test_what_is_printed_can_be_given_next(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "plugin", "surfkit-oversized"]) == 0
    printed = capsys.readouterr().out
    assert "wrote surfkit-oversized: oversized, a part of the kind prune" in printed
    for command in (
        "pip install -e surfkit-oversized  ",
        "surfkit components prune  ",
        "pytest surfkit-oversized/tests  ",
        "surfkit ablate table:oversized --data DATA  ",
    ):
        assert f"\n  {command}" in printed
    assert main(["new", "plugin", "acme-columns", "--kind", "format", "--out", "a b"]) == 0
    printed = capsys.readouterr().out
    assert "pip install -e 'a b'" in printed and "ablate" not in printed
    assert (tmp_path / "a b" / "acme_columns" / "acme_columns.py").is_file()


def refused(capsys, *words):
    """The line that is printed where a command is refused."""
    capsys.readouterr()
    assert main(["new", "plugin", *words]) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    "name, said",
    [
        ("Surfkit-Large", "not a package name in kebab-case"),
        ("surfkit_large", "not a package name in kebab-case"),
        ("surfkit--large", "not a package name in kebab-case"),
        ("../large", "not a package name in kebab-case"),
        ("surfkit-" + "a" * 60, "60 characters at most"),
        ("surfkit-3d", "which Python cannot import"),
        ("surfkit-class", "which Python cannot import"),
        ("surfkit-interval", "is a name that its files import"),
        ("surfkit-replace", "is a name that its files import"),
        ("surfkit-trim", "a component named 'trim' is there already"),
        ("surfkit-2dgs", "which Python cannot import"),
        ("surfkit-model", "an ablation table named 'model' is there already"),
        ("surfkit-stereo", "a component named 'stereo' is there already"),
        ("surfkit-surface", "a recipe named 'surface' is there already"),
        ("torch", "a Python package named 'torch' is there already"),
        ("surfkit", "a Python package named 'surfkit' is there already"),
    ],
)
def test_names_that_are_refused(tmp_path, monkeypatch, capsys, name, said):
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, name)
    assert said in line and line.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_name_with_a_placeholder_in_it(tmp_path):
    out = tmp_path / "here"
    assert main(["new", "plugin", "surfkit-new-kind", "--kind", "loss", "--out", str(out)]) == 0
    assert "of the kind loss: new-kind" in (out / "pyproject.toml").read_text()
    assert "class NewKind(Loss)" in (out / "surfkit_new_kind" / "new_kind.py").read_text()


def test_kinds_that_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:  # a kind of another package
        patch.setattr(write, "kinds", lambda: [kind for kind in KINDS if kind != "rasterizer"])
        line = refused(capsys, "surfkit-large", "--kind", "rasterizer")
    assert "no template for the kind 'rasterizer'" in line and "docs/kinds.md" in line
    assert all(kind in line for kind in KINDS if kind != "rasterizer")
    line = refused(capsys, "surfkit-large", "--kind", "prunes")
    assert "'prunes'; did you mean 'prune'" in line
    assert "no kind" in refused(capsys, "surfkit-large", "--kind", "common")
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten_and_nothing_is_left_half_written(tmp_path, monkeypatch, capsys):
    out = tmp_path / "surfkit-large"
    out.mkdir()
    assert "exists already" in refused(capsys, "surfkit-large", "--out", str(out))
    assert not list(out.iterdir())
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    assert "exists already" in refused(capsys, "surfkit-large", "--out", str(tmp_path / "link"))
    with monkeypatch.context() as patch:

        def broken(*given):
            yield "README.md", "text"
            raise BadInput("the disk is gone")

        patch.setattr(write, "files", broken)
        assert "the disk is gone" in refused(capsys, "surfkit-large", "--out", str(tmp_path / "new"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "surfkit-large"]
