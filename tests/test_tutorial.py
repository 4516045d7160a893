"""What the pages show is so: the plugin tutorial, docs/plugins.md, step by step; the output of doctor; a run folder."""

import json
import re
import runpy
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from needs import needs_native
from pages import ROOT, code, spans

from surfkit.cli import main
from surfkit.core import registry

TUTORIAL = ROOT / "docs" / "plugins.md"
RUN_FOLDER = ROOT / "docs" / "run_folder.md"
APPENDED = ", appended"
TABLED = {"surfkit plugins", "surfkit components prune"}
"""Commands whose output the page shows a line of."""


def newest(package):
    """The version of a package as numbers; none where it is not installed."""
    try:
        return tuple(int(part) for part in re.findall(r"\d+", metadata.version(package))[:2])
    except metadata.PackageNotFoundError:
        return ()


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A working folder, and the folder that packages are installed into, from which they are found."""
    if newest("setuptools") < (70, 1) or not newest("pip"):
        pytest.skip("packages are installed without network here: needs pip, and setuptools 70.1 or newer")
    here, site = tmp_path_factory.mktemp("tutorial"), tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        patch.syspath_prepend(str(site))
        patch.setenv("SURFKIT_PLUGINS", "oversized")
        patch.setenv("COLUMNS", "200")
        yield here, site
    registry.reload()


def install(package, site):
    """As `pip install PACKAGE` does, with what is here already, into a folder."""
    words = ["--no-build-isolation", "--no-deps", "--no-index", "--quiet", "--upgrade", "--target", str(site), package]
    subprocess.run([sys.executable, "-m", "pip", "install", *words], check=True)
    for name in [name for name in sys.modules if name == "surfkit_oversized"]:
        del sys.modules[name]
    registry.reload()


@needs_native
def test_every_step(place, capsys):
    here, site = place
    shown = {}
    for block in code(TUTORIAL):
        if block.title:
            write(here / block.title.removesuffix(APPENDED), block.text, block.title.endswith(APPENDED))
        elif block.language == "sh":
            for line in block.text.splitlines():
                shown[line] = give(shlex.split(line), site, capsys)
        elif any(command in shown for command in TABLED):
            lines = " ".join(" ".join(shown[command].split()) for command in sorted(TABLED))
            for line in block.text.splitlines():
                assert " ".join(line.split()) in lines, f"{line!r} is not shown"
            shown = {}
    recipe = json.loads((here / "runs/oversized/recipe.json").read_text())
    assert recipe["pretrain"]["prune"] == [{"use": "oversized", "largest": 0.05, "every": 1}]
    assert "oversized (surfkit-oversized 1.0)" in json.loads((here / "runs/oversized/run.json").read_text())["plugins"]
    assert (here / "runs/small-points/metrics.json").exists()
    every_file_is_explained(here / "runs" / "small-points")


def write(path: Path, text: str, more: bool) -> None:
    """A file of the page, or what is appended to one."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"{path.read_text()}\n\n{text}" if more else text)


def give(words, site, capsys):
    """A command of the page; what it prints."""
    if words[:2] == ["pip", "install"]:
        install(words[2], site)
    elif words[0] == "pytest":  # in this process, as another one would import torch once more
        tests = {name: test for name, test in runpy.run_path(words[1]).items() if name.startswith("test_")}
        assert len(tests) == 3
        for test in tests.values():
            test()
    else:
        capsys.readouterr()
        assert main(words[1:]) == 0, words
    return capsys.readouterr().out


def every_file_is_explained(run):
    """Every file of a run folder is in the page about run folders, by itself or by a folder that it lies in."""
    known = {name.rstrip("/") for span in spans(RUN_FOLDER) for name in span.split(", ")}
    for path in run.rglob("*"):
        name = path.relative_to(run)
        above = {parent.as_posix() for parent in [name, *name.parents]}
        if path.is_file():
            assert above & known, f"run_folder.md does not explain {name}"


def test_what_doctor_prints(monkeypatch, capsys):
    page = ROOT / "docs" / "own_photographs.md"
    command = next(span for span in spans(page) if span.startswith("surfkit doctor examples/"))
    shown = next(block for block in code(page) if block.text.startswith("examples/boruszyn"))
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("COLUMNS", "400")
    assert main(command.split()[1:]) == 0
    printed = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    for line in shown.text.splitlines():
        assert any(there.startswith(line.removesuffix("...")) for there in printed), f"{line!r} is not printed"
