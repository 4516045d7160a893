"""Names that tell a terminal what to do are shown, and not obeyed: of photographs, folders and files."""

import io
import json
import re
import shutil
import sys

import pytest
from rich.console import Console

from surfkit.cli import main
from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import printable
from surfkit.core.events import Progress, Warned, emit, say
from surfkit.runs.run_notes import collect_notes
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.progress_bars import bars

NAME = "a\x1b[1mb[red].png"
SHOWN = "a\\x1b[1mb[red].png"
QUICK = "--steps 9 --pictures-every 0 --primitive.sh-degree 0".split()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a b\u00e9\u4e2d\U0001f600 [red] \\", "a b\u00e9\u4e2d\U0001f600 [red] \\"),
        (NAME, SHOWN),
        ("a\nnote: all is well\r\t\0", "a\\nnote: all is well\\r\\t\\x00"),
        ("\x7f\x85\x9b1m", "\\x7f\\x85\\x9b1m"),
        ("photo\u202egnp.exe\u2066\u2029", "photo\\u202egnp.exe\\u2066\\u2029"),
    ],
)
def test_what_is_obeyed_is_written_out(text, shown):
    assert printable(text) == shown
    kept = printable(text, lines=True)
    assert kept.replace("\n", "\\n").replace("\t", "\\t") == shown


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set in a folder of such a name, with two photographs of such names: one to train on, one held out."""
    path = tmp_path_factory.mktemp("names") / NAME
    write_colmap(path, photograph(Flight(views=10, width=64, height=48, points=200)), tracks=True)
    model = path / "sparse/0/images.txt"
    text = model.read_text()
    for number, front in ((0, ""), (1, "b")):
        old = f"view_{number:03d}.png"
        try:
            (path / "images" / old).rename(path / "images" / f"{front}{NAME}")
        except OSError:
            pytest.skip("the file system has no such names")
        text = text.replace(old, f"{front}{NAME}")
    model.write_text(text)
    return path


def test_no_command_obeys_a_name(folder, tmp_path, capfd):
    data, out = tmp_path / NAME, tmp_path / f"run{NAME}"
    shutil.copytree(folder, data)
    photo = data / "images" / f"b{NAME}"
    photo.write_bytes(photo.read_bytes()[:-300])
    assert main(["doctor", str(data), "--probe", "0"]) == 2
    assert main(["train", "recipe:2dgs", *QUICK, "--data", str(data), "--out", str(out)]) == 0
    assert main(["prepare", "depth", str(data), "estimator:plane-sweep", "--estimator.longest", "32"]) == 0
    for words in (["evaluate"], ["mesh"], ["export"], ["compress"], ["status"], ["report"], ["status", "--json"]):
        assert main([words[0], str(out), *words[1:]]) == 0
    assert main(["curves", str(out), "--of", "loss", "--out", str(tmp_path / f"{NAME}.svg")]) in (0, 2)
    assert main(["mesh", str(tmp_path / "no\x1b[1m")]) == 2
    done = capfd.readouterr()
    for said in (done.out, done.err):
        assert "\x1b" not in said and SHOWN in said
    assert f"images/b{SHOWN}: not a whole picture" in done.err
    page = (out / "report.html").read_text()
    assert "\x1b" not in page and SHOWN in page
    assert f"b{NAME}" in json.loads((out / "run.json").read_text())["skipped"], "files keep the name itself"


def test_a_name_is_no_markup_on_a_terminal(capfd, monkeypatch):
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=200, color_system=None, legacy_windows=False)
    with bars(console):
        emit(Progress(f"drawing {NAME}", 1, 1))
    assert f"drawing {SHOWN}" in re.sub(r"\x1b\[\?25[lh]", "", shown.getvalue())
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    print_table((NAME, "[bold]x"), [(NAME, "[/red]\n")])
    tell(NAME)
    say(f"{NAME}\nnote: forged")
    with collect_notes():
        emit(Warned(f"{NAME}\nnote: forged"))
    done = capfd.readouterr()
    assert done.out.count(SHOWN) == 3 and "[bold]x" in done.out and "[/red]\\n" in done.out
    assert done.err == f"{SHOWN}\\nnote: forged\nnote: {SHOWN}\\nnote: forged\n"
