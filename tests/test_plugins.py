"""Discovery through real entry points: packages in a folder of their own, found on sys.path."""

import re
import sys
import types
from importlib import metadata
from pathlib import Path

import pytest

from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import components, failures, find, plugins, records

CEILING = Path(__file__).parents[1] / "plugins" / "surfkit-ceiling"

GOOD = """
from dataclasses import dataclass
from conftest_world import Loss
from surfkit.core.hooks import hookimpl

@dataclass(frozen=True)
class Acme(Loss):
    '''From far away.'''

@hookimpl
def surfkit_components():
    return {NAME: Acme}
"""
OFFER = "from surfkit import hookimpl\n\n@hookimpl\ndef surfkit_component():\n    return {}\n"


@pytest.fixture
def install(world, bare, tmp_path, monkeypatch):
    """A function that installs a package of one module with an entry point, as pip would; no other is installed."""

    def here(**which):
        found = [point for package in metadata.distributions(path=[str(tmp_path)]) for point in package.entry_points]
        return metadata.EntryPoints(found).select(**which)

    monkeypatch.setattr(metadata, "entry_points", here)
    shared = types.ModuleType("conftest_world")
    shared.Loss = world.Loss
    monkeypatch.setitem(sys.modules, "conftest_world", shared)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delenv("SURFKIT_PLUGINS")

    def put(point: str, source: str, version: str = "1.0") -> None:
        module = f"{point}_module_{tmp_path.name}"
        (tmp_path / f"{module}.py").write_text(source)
        info = tmp_path / f"{point}_dist-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {point}-dist\nVersion: {version}\n")
        (info / "entry_points.txt").write_text(f"[surfkit]\n{point} = {module}\n")
        bare.reload()
        plugins().register(world.Plugin(), "stand-in")

    return put


def test_a_plugin_is_found(world, install):
    install("acme", GOOD.replace("NAME", "'far'"), "2.5")
    assert find(world.Loss, "far").__name__ == "Acme"
    acme = next(plugin for plugin in records() if plugin.name == "acme")
    assert (acme.distribution, acme.version, acme.hooks, acme.error) == (
        "acme-dist",
        "2.5",
        ("surfkit_components",),
        None,
    )
    assert str(acme) == "acme (acme-dist 2.5)"


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import no_such_thing", "ModuleNotFoundError: No module named 'no_such_thing'"),
        ("raise RuntimeError('no\\n licence')", "RuntimeError: no licence"),
        ("import sys\n\nsys.exit(3)", "SystemExit: 3"),
        (OFFER, "unknown hook 'surfkit_component'; did you mean 'surfkit_components'?"),
        (OFFER.replace("component():", "event(evnt):"), "PluginValidationError: "),
        (
            "def surfkit_components():\n    return {}",
            "surfkit_components is not marked; put @surfkit.hookimpl above it",
        ),
        (OFFER.replace("component", "components").replace("impl\n\ndef", "impl(wrapper=True)\ndef"), ""),
    ],
)
def test_a_broken_plugin_is_reported_and_breaks_nothing(world, install, capsys, source, reason):
    if not reason:
        source, reason = source.replace("@hookimpl", "@hookimpl(wrapper=True)"), "surfkit_components is a wrapper"
        source = source.replace("return {}", "yield {}")
    install("broken", source)
    assert set(components(world.Loss)) == {"l1", "depth"}
    assert [plugin.name for plugin in failures()] == ["broken"]
    assert failures()[0].error.startswith(reason)
    with pytest.raises(BadInput, match=r"known: depth, l1; .*broken \(broken-dist 1\.0\)"):
        find(world.Loss, "l2")
    assert main(["plugins"]) == 0
    assert f"broken-dist  1.0      not in use: {reason}" in capsys.readouterr().out
    assert main(["train", "recipe:discs", "--data", "d"]) == 0


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ("    every: int\n", "Acme: setting 'every' has no default; 'far' alone must choose a usable part"),
        ("    every: 'Nope' = 3\n", "Acme: a type of its settings cannot be found: NameError: name 'Nope' is not"),
        ("    @abc.abstractmethod\n    def weigh(self): pass\n", "Acme lacks weigh, which every Loss must have"),
    ],
)
def test_a_part_that_cannot_be_used_is_not_offered(world, install, capsys, more, reason):
    install("acme", "import abc\n" + GOOD.replace("NAME", "'far'").replace("away.'''\n", f"away.'''\n\n{more}"))
    assert set(components(world.Loss)) == {"l1", "depth"}
    assert reason in failures()[0].error
    for words in (["components", "loss"], ["recipes"], ["tables"]):
        assert main(words) == 0
        assert capsys.readouterr().err.startswith("surfkit: plugin acme (acme-dist 1.0) is not in use: surfkit_compo")
    assert main(["train", "recipe:discs", "--data", "d"]) == 0


@pytest.mark.parametrize(
    ("hook", "value", "reason"),
    [
        ("recipes", "{'about': 'fast'}", "'mine' is {'about': 'fast'}, and not a surfkit.Recipe"),
        ("tables", "[1, 2]", "'mine' is [1, 2], and not a surfkit.Table"),
        ("rows", "Acme()", "'mine' is Acme(), and not a tuple of surfkit.Row"),
        ("rows", "(1, Acme())", "'mine' is (1, Acme()), and not a tuple of surfkit.Row"),
    ],
)
def test_offers_of_another_kind_take_only_their_plugin(world, install, capsys, hook, value, reason):
    more = f"\n@hookimpl\ndef surfkit_{hook}():\n    return {{'mine': {value}}}\n"
    install("acme", GOOD.replace("NAME", "'far'") + more)
    assert main(["plugins"]) == 0 and main(["recipes"]) == 0 and main(["tables"]) == 0
    assert f"not in use: surfkit_{hook}: {reason}" in capsys.readouterr().out


def test_a_taken_name_names_both_owners(world, install):
    install("acme", GOOD.replace("NAME", "'depth'"))
    with pytest.raises(BadInput) as caught:
        components(world.Loss)
    assert "conftest.Depth (stand-in)" in str(caught.value) and ".Acme (acme)" in str(caught.value)
    assert main(["train", "recipe:discs", "--data", "d"]) == 2


def test_narrowing(world, install, monkeypatch, bare):
    install("acme", GOOD.replace("NAME", "'far'"))
    install("bolt", GOOD.replace("NAME", "'near'"))
    for value, wanted in {
        "": {"far", "near"},
        "none": set(),
        "acme": {"far"},
        "bolt, acme": {"far", "near"},
    }.items():
        monkeypatch.setenv("SURFKIT_PLUGINS", value)
        bare.reload()
        assert set(components(world.Loss)) == wanted
    monkeypatch.setenv("SURFKIT_PLUGINS", "acme,blot")
    bare.reload()
    with pytest.raises(BadInput, match="SURFKIT_PLUGINS: .*'blot' .*installed: acme, bolt"):
        components(world.Loss)


def test_one_module_under_two_names(world, install, bare, tmp_path):
    install("acme", GOOD.replace("NAME", "'far'"))
    points = tmp_path / "acme_dist-1.0.dist-info" / "entry_points.txt"
    points.write_text(points.read_text() + points.read_text().splitlines()[1].replace("acme =", "again =") + "\n")
    bare.reload()
    assert set(components(world.Loss)) == {"far"}
    assert "another entry point has this name or this module" in failures()[0].error


def test_a_recipe_hook_that_fails_takes_only_its_plugin(world, install, capsys):
    install("acme", GOOD.replace("NAME", "'far'") + "\n@hookimpl\ndef surfkit_recipes():\n    return 1 / 0\n")
    assert main(["recipes"]) == 0
    assert "discs" in capsys.readouterr().out
    assert failures()[0].error == "surfkit_recipes: ZeroDivisionError: division by zero"


def test_memory_that_gives_out_is_no_fault_of_a_plugin(world, install):
    once = "ERRORS = [MemoryError()]\n\n@hookimpl\ndef surfkit_components():\n    if ERRORS: raise ERRORS.pop()"
    install("acme", GOOD.replace("NAME", "'far'").replace("@hookimpl\ndef surfkit_components():", once))
    with pytest.raises(MemoryError):
        components(world.Loss)
    assert "far" in components(world.Loss) and not failures()
    with pytest.raises(MemoryError):
        install("bolt", "raise MemoryError")


def test_two_recipes_of_one_name(world, bare, capsys):
    class Other:
        @hookimpl
        def surfkit_recipes(self):
            return {"discs": world.Recipe()}

    bare.plugins().register(Other(), "other")
    assert main(["recipes"]) == 2
    assert "recipe named 'discs': stand-in and other" in capsys.readouterr().err


class TestCeiling:
    """The plugin in plugins/surfkit-ceiling, found through the entry point that its own pyproject declares."""

    @pytest.fixture
    def ceiling(self, monkeypatch, tmp_path):
        from surfkit.core import registry
        from surfkit.densify.base import Prune

        project = (CEILING / "pyproject.toml").read_text()
        declared = re.search(r'^\[project\.entry-points\.surfkit\]\n(\w+) = "(\w+)"$', project, re.M)
        info = tmp_path / "surfkit_ceiling-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: surfkit-ceiling\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[surfkit]\n{declared[1]} = {declared[2]}\n")
        monkeypatch.syspath_prepend(str(CEILING))
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.setenv("SURFKIT_PLUGINS", "ceiling")
        registry.reload()
        yield find(Prune, "ceiling")
        registry.reload()

    def test_drops_one_side(self, ceiling, crowd):
        points, step = crowd
        heights = points.params["means"][:, 1]
        above = ceiling(height=0.5, axis="y").edit(points, step)
        below = ceiling(height=0.5, axis="y", drop="below").edit(points, step)
        assert above.drop.tolist() == [height > 0.5 for height in heights.tolist()]
        assert below.drop.tolist() == [height < 0.5 for height in heights.tolist()]
        assert 0 < int(above.drop.sum()) < len(points)
        assert ceiling(every=7).edit(points, step) is None

    def test_conforms(self, ceiling):
        from surfkit.testing import check

        check(ceiling(height=0.25, axis="x", drop="below", every=50))
        with pytest.raises(BadInput, match="ceiling.every is 0"):
            ceiling(every=0)
