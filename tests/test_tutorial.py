"""What the pages show is so: the plugin tutorial, docs/plugins.md, step by step; the output of doctor; a run folder."""

import json
import os
import re
import shlex
import subprocess
import sys
import sysconfig
import venv
from importlib import metadata
from itertools import groupby
from pathlib import Path

import pytest
from needs import needs_native
from pages import ROOT, code, spans

from surfkit.cli import main

TUTORIAL = ROOT / "docs" / "plugins.md"
RUN_FOLDER = ROOT / "docs" / "run_folder.md"
APPENDED, PART = ", appended", ", a part"
"""How titles of code end that is added to a file, and of code that stands in one as it is."""
SHOWN = {"surfkit plugins", "surfkit components prune"}
"""Commands whose output the page shows a line of."""


def newest(package):
    """The version of a package as numbers; none where it is not installed."""
    try:
        return tuple(int(part) for part in re.findall(r"\d+", metadata.version(package))[:2])
    except metadata.PackageNotFoundError:
        return ()


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """The interpreter of a new virtual environment that finds all that is installed here, and installs into itself."""
    if newest("setuptools") < (70, 1) or not newest("pip"):
        pytest.skip("packages are installed without network here: needs pip, and setuptools 70.1 or newer")
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=True)
    own = dict.fromkeys(sysconfig.get_paths()[name] for name in ("purelib", "platlib"))
    lines = [f"import site; site.addsitedir({path!r})" for path in own]  # with its .pth files
    lines += [path for path in sys.path if path.endswith("-packages") and path not in own]
    site = sysconfig.get_paths(vars={"base": str(folder), "platbase": str(folder)}, scheme="venv")["purelib"]
    Path(site, "outer.pth").write_text("\n".join(lines))
    return folder / "bin" / "python"


@needs_native
def test_every_step(python, tmp_path):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    shown = {}
    for block in code(TUTORIAL):
        if block.title.endswith(PART):
            assert block.text in (tmp_path / block.title.removesuffix(PART)).read_text(), block.title
        elif block.language == "diff":
            change(tmp_path / block.title, block.text)
        elif block.title:
            path = tmp_path / block.title.removesuffix(APPENDED)
            path.write_text(f"{path.read_text()}\n\n{block.text}")
        elif block.language == "sh":
            shown |= give_all(python, block.text.splitlines(), tmp_path)
        elif block.text.startswith("surfkit-oversized/"):
            names = block.text.split()
            assert {names[0] + name for name in names[1:]} == files(tmp_path / "surfkit-oversized", tmp_path)
        else:
            lines = " ".join(" ".join(shown[command].split()) for command in sorted(SHOWN))
            for line in block.text.splitlines():
                assert " ".join(line.split()) in lines, f"{line!r} is not shown"
    assert "4 passed" in shown["pytest surfkit-oversized/tests"]
    assert "2DGS without large points" in shown["surfkit tables methods"]
    run = tmp_path / "runs" / "oversized"
    prune = json.loads((run / "recipe.json").read_text())["pretrain"]["prune"]
    assert prune == [{"use": "oversized", "largest": 0.05, "every": 1}]
    assert "oversized (surfkit-oversized 0.1.0)" in json.loads((run / "run.json").read_text())["plugins"]
    every_file_is_explained(run)
    the_table_is_finished(tmp_path / "runs" / "boruszyn-ablate-oversized")


def change(path, text):
    """A diff of the page: what stands there is found once in the file, and what is to stand there takes its place."""
    whole = path.read_text()
    for hunk in text.split("@@\n"):
        lines = [(line[:1] or " ", line[1:] + "\n") for line in hunk.splitlines()]
        before, after = ("".join(line for mark, line in lines if mark != other) for other in "+-")
        assert whole.count(before) == 1, f"{path.name} has {whole.count(before)} times\n{before}"
        whole = whole.replace(before, after)
    path.write_text(whole)


def give_all(python, lines, folder):
    """What each command prints; those of surfkit that follow one another share a process, and take less."""
    shown = {}
    for is_surfkit, group in groupby(lines, lambda line: line.startswith("surfkit ")):
        group = list(group)
        if is_surfkit:
            less = [line.replace("--steps 60", "--steps 6").replace("--scale 8", "--scale 16") for line in group]
            words = [shlex.split(line)[1:] for line in less]
            printed = give(python, ["-c", COMMANDS, json.dumps(words)], folder).split("\0\n")
        else:
            printed = [give(python, command(shlex.split(line)), folder) for line in group]
        shown |= zip(group, printed, strict=False)
    return shown


COMMANDS = """
import json, sys
from surfkit.cli import main
for words in json.loads(sys.argv[1]):
    if main(words) != 0:
        sys.exit(f"surfkit {words} failed")
    print("\\0", flush=True)
"""


def command(words):
    """The words after the name of the interpreter."""
    if words[:2] == ["pip", "install"]:
        words = ["pip", "install", "--no-build-isolation", "--no-deps", "--no-index", "--quiet", *words[2:]]
    return ["-m", *words]


def give(python, words, folder):
    """What a process prints."""
    env = {name: value for name, value in os.environ.items() if name not in ("SURFKIT_PLUGINS", "PYTHONPATH")}
    done = subprocess.run(
        [python, *words],
        cwd=folder,
        env=env | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, f"{shlex.join(words)}: {done.stdout[-2_000:]} {done.stderr[-2_000:]}"
    return done.stdout


def files(folder, above):
    return {path.relative_to(above).as_posix() for path in folder.rglob("*") if path.is_file()}


def the_table_is_finished(folder):
    """Each row is in the results and in the report. That none has failed is told by the status of the command."""
    results, page = (folder / "ablation.json").read_text(), (folder / "report.html").read_text()
    for label in ("2DGS", "+ oversized", "+ half as large", "+ to the end"):
        assert label in results and label in page


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
    shown = next(block for block in code(page) if block.text.startswith("data set       examples/boruszyn"))
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("COLUMNS", "400")
    assert main(command.split()[1:]) == 0
    printed = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    for line in shown.text.splitlines():
        assert any(there.startswith(line.removesuffix("...")) for there in printed), f"{line!r} is not printed"
