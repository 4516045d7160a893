"""`bench/gpu_paper.py`: what it says of parts and rows that were cut, and that it goes on with them."""

import importlib
import json
import os
import signal
import sys
import time
from types import SimpleNamespace

import pytest
from interrupted import Watch
from pages import ROOT

from surfkit.core.events import StepDone
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.core.signals import terminable
from surfkit.runs.execute.base import Inline
from surfkit.testing.synthetic import Flight, photograph, write_colmap


@pytest.fixture(scope="module")
def load():
    """A module of bench/, which finds those beside it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "bench"))
        yield importlib.import_module
    for name in ("gpu_paper", "gpu", "machine", "scenes"):
        sys.modules.pop(name, None)


@pytest.fixture(scope="module")
def paper(load):
    return load("gpu_paper")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A tiny data set with a true surface, a square as large as the scene."""
    folder = tmp_path_factory.mktemp("data") / "tiny"
    write_colmap(folder, photograph(Flight(views=9, width=32, height=24, points=60)))
    (folder / "gt").mkdir()
    lines = [f"v {x} {y} 0" for x, y in ((-20, -20), (20, -20), (20, 20), (-20, 20))]
    (folder / "gt/mesh.obj").write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4", ""]))
    return folder


class Stop(Watch):
    """Asks this process to stop after a step, the `at`-th that is made."""

    def __init__(self, at):
        self.left = at

    @hookimpl
    def surfkit_event(self, event):
        if isinstance(event, StepDone):
            self.left -= 1
            if self.left == 0:
                os.kill(os.getpid(), signal.SIGTERM)


def test_rows_that_are_cut_say_where_and_go_on(paper, scene, quick_comparison, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(paper, "Pool", lambda count: Inline())
    monkeypatch.setattr(paper, "WAVES", paper.WAVES[:1])
    monkeypatch.setattr(signal, "alarm", lambda seconds: None)
    words = f"rows=500 --data {scene} --gt {scene}/gt/mesh.obj --device cpu --steps 4 --tau 5 --out {tmp_path}/out"
    monkeypatch.setattr(sys, "argv", ["gpu_paper", *words.split(), "--work", str(tmp_path / "work")])

    def rows():
        parts = json.loads((tmp_path / "out/gpu_paper.json").read_text())["figures"]["parts"]
        assert [parts[name]["state"] for name in ("parity", "table")] == ["not begun"] * 2
        return {(row["table"], row["row"]): row for row in parts["rows"]["rows"]}

    stop = Stop(6)
    plugins().register(stop)
    try:
        assert paper.main() == 130
    finally:
        plugins().unregister(stop)
    found = rows()
    first, second = found["gradient", 1], found["gradient", 4]
    assert first["state"] == "finished" and {"psnr", "f1"} <= first["measured"].keys() and first["steps"] == 4
    assert found["model", 2] == first | {"table": "model", "row": 2, "label": "+ elongation filter"}, "one recipe"
    assert (second["state"], second["measured"]) == ("cut after 2 of 4 steps", None)
    assert [(each["step"], each["views"]) for each in second["psnr_on_the_way"]] == [(1, 2), (2, 2)]
    assert found["model", 1] == {
        "table": "model",
        "row": 1,
        **{"label": "baseline", "run": found["model", 1]["run"]},
    } | {"state": "not begun"}
    assert "the same command goes on" in capsys.readouterr().err
    assert paper.main() == paper.CUT  # the other rows are those of the waves that are left out
    again = rows()
    assert again["gradient", 1] == first and again["gradient", 4]["state"] == "finished"
    said = capsys.readouterr()
    assert "going on after step 2 of 4" in said.err and "rows: cut after 3 of 6 rows" in said.out


def test_work_is_stopped_at_its_time(paper):
    with terminable():
        began = time.monotonic()
        with paper.interrupted_at(began + 0.1):
            time.sleep(20)
        assert time.monotonic() - began < 10
        with pytest.raises(KeyboardInterrupt), paper.interrupted_at(time.monotonic() + 100):
            os.kill(os.getpid(), signal.SIGTERM)  # of somebody else
            time.sleep(20)


@pytest.mark.parametrize(
    ("program", "state"),
    [
        ("print('well')", "finished"),
        ("print('well'); print('no such thing'); exit(4)", "failed: exit status 4: no such thing"),
        ("import time; print('well', flush=True); time.sleep(60)", "cut after 7 tests"),
    ],
)
def test_what_became_of_a_program(paper, tmp_path, program, state):
    log = tmp_path / "log"
    assert paper.state_of(log, "after 7 tests") == "not begun"
    paper.run_program(["-c", program], time.monotonic() + 2.4, log)
    assert log.read_text().startswith("well\n") and paper.state_of(log, "after 7 tests") == state


def test_tests_are_counted_as_they_end(paper, monkeypatch, tmp_path):
    (tmp_path / "tests").mkdir()
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = -q -rsfE\nmarkers = cuda: needs a GPU\n")
    (tmp_path / "tests/test_some.py").write_text(
        "import pytest\n\npytestmark = pytest.mark.cuda\n\ndef test_a():\n    pass\n\n"
        "@pytest.mark.parametrize('x', ['a b', 'c'])\n"
        "def test_b(x):\n    assert x == 'c'\n\ndef test_c():\n    pytest.skip('no GPU')\n"
    )
    bench, log = SimpleNamespace(work=tmp_path), tmp_path / "parity.log"
    monkeypatch.setitem(paper.ENVIRONMENT, "PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setattr(paper, "ROOT", tmp_path)
    paper.run_program(["-m", "pytest", "-vv", "-m", "cuda", "tests"], time.monotonic() + 60, log)
    found = paper.Bench.parity(bench)
    assert (found["passed"], found["skipped"], found["failed"]) == (2, 1, ["tests/test_some.py::test_b[a b]"])
    assert found["state"].startswith("failed: exit status 1: ")


@pytest.mark.parametrize("word", ["rows", "rows=", "rows=-3", "rows=1.5", "rows=0", "row=30"])
def test_a_part_that_is_none(paper, monkeypatch, word, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu_paper", word])
    with pytest.raises(SystemExit) as stop:
        paper.main()
    assert stop.value.code == 2 and f"{word!r}: give PART=SECONDS, such as rows=360" in capsys.readouterr().err


def test_figures_that_are_there_are_not_measured_again(load, monkeypatch, tmp_path):
    gpu, calls = load("gpu"), []
    values = {"a": lambda: calls.append("a") or 1, "b": lambda: calls.append("b") or 2}
    monkeypatch.setattr(gpu, "measurements", lambda rasterizer, options: dict(values))

    def run(*words):
        calls.clear()
        monkeypatch.setattr(sys, "argv", ["gpu", "--device", "cpu", "--out", str(tmp_path), *words])
        gpu.main()
        return json.loads((tmp_path / "gpu.json").read_text())["figures"]

    del values["b"]
    assert run()["a"] == 1 and calls == ["a"]
    values["b"] = lambda: calls.append("b") or 2
    assert run("--go-on") | {"device": ""} == {"device": "", "a": 1, "b": 2} and calls == ["b"]
    assert run()["b"] == 2 and calls == ["a", "b"]
    known = tmp_path / "gpu.json"
    known.write_text(known.read_text().replace('"device": "', '"device": "another '))
    assert run("--go-on")["a"] == 1 and calls == ["a", "b"], "figures of another device"
