"""Commands that packages add."""

import importlib
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from pages import ROOT, code

import surfkit
from surfkit.cli import main, overview
from surfkit.core.registry import plugins


def module_of_page(folder, monkeypatch):
    """What a package is whose `__init__.py` is the block of the page with this hook."""
    (text,) = [block.text for block in code(ROOT / "docs" / "python.md") if "surfkit_commands" in block.text]
    (folder / "surfkit_count.py").write_text(text)
    monkeypatch.syspath_prepend(folder)
    return importlib.import_module("surfkit_count")


@pytest.fixture
def package():
    """Registers the plugin that it is given."""
    given = []

    def register(plugin):
        given.append(plugin)
        plugins().register(plugin, "added")
        return plugin

    yield register
    for plugin in given:
        if plugins().is_registered(plugin):
            plugins().unregister(plugin)


def offer(**commands):
    @surfkit.hookimpl
    def surfkit_commands():
        return commands

    return SimpleNamespace(surfkit_commands=surfkit_commands)


def test_the_one_of_the_page(package, tmp_path, monkeypatch, capsys):
    package(module_of_page(tmp_path, monkeypatch))
    seen = SimpleNamespace(splats=SimpleNamespace(means=[0] * 7))
    monkeypatch.setattr("surfkit.api.open_run", lambda folder: seen)
    assert main(["count", "--run-folder", "RUN"]) == 0
    assert capsys.readouterr().out.strip() == "7"
    assert main(["count", "--help"]) == 0
    assert "Folder that" in capsys.readouterr().out
    assert main(["count"]) == 2 and capsys.readouterr().err.count("\n") == 1


@dataclass(frozen=True)
class Quiet:
    """Give an exit status."""

    status: int = 3

    def run(self):
        return self.status


def test_its_exit_status_and_its_name_in_the_messages(package, capsys):
    package(offer(quiet=Quiet))
    assert main(["quiet"]) == 3 and main(["quiet", "--status", "0"]) == 0
    assert main(["quit"]) == 2
    assert "did you mean 'quiet'?" in capsys.readouterr().err
    assert main(["plugins"]) == 0
    assert "surfkit plugins" in overview()


class NoDataclass:
    """It has run()."""

    def run(self):
        return 0


@pytest.mark.parametrize("wrong", [NoDataclass, Quiet(), dataclass(type("Silent", (), {"run": lambda self: 0}))])
def test_what_is_no_command_is_told_and_not_in_use(package, wrong, capsys):
    package(offer(wrong=wrong))
    assert main(["wrong"]) == 2
    assert "no command 'wrong'" in capsys.readouterr().err


def test_a_name_that_surfkit_has_is_refused(package, capsys):
    package(offer(mesh=Quiet))
    assert main(["quit"]) == 2
    assert "'mesh': surfkit (surfkit.apps) and added" in capsys.readouterr().err


LAZY = """
from dataclasses import dataclass


@dataclass(frozen=True)
class Lazy:
    \"\"\"Give an exit status.\"\"\"

    def run(self):
        return 4


COMMAND = Lazy
"""


@pytest.mark.parametrize(
    ("text", "status", "said"),
    [
        (LAZY, 4, ""),
        ("import nowhere_to_be_found", 2, "No module named 'nowhere_to_be_found'"),
        ("MAND = 1", 2, "COMMAND"),
    ],
)
def test_a_module_that_is_loaded_when_its_command_is_given(package, tmp_path, monkeypatch, capsys, text, status, said):
    (tmp_path / "lazily_loaded.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lazily_loaded", raising=False)
    package(offer(lazily=surfkit.LazyCommand("lazily_loaded", "Give an exit status.")))
    assert main(["lazily"]) == status
    line = capsys.readouterr().err
    assert said in line and line.count("\n") == bool(said)
