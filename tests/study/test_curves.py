"""Numbers of runs, step by step, in one chart."""

import json

import numpy as np
import pytest
from PIL import Image

from surfkit.cli import main
from surfkit.evaluate.geometry.line_plot import PlotLine, write_lines

BLUE, ORANGE = (31, 119, 180), (255, 127, 14)


@pytest.fixture
def folder(tmp_path):
    """A run of 1,000 steps with as many points as steps made, a block of 10 steps with 50 points, a refinement of 5."""
    (tmp_path / "blocks" / "000").mkdir(parents=True)
    (tmp_path / "refine0").mkdir()
    (tmp_path / "refine0-copy").mkdir()  # somebody's own
    (tmp_path / "recipe.json").write_text("{}")
    parts = ((tmp_path, 1_000, None), (tmp_path / "blocks" / "000", 10, 50), (tmp_path / "refine0", 5, 40))
    for where, steps, points in parts:
        lines = [
            {
                "event": "StepDone",
                "time": 0.0,
                "index": index,
                "losses": {"a": 1.0, "b": 0.5},
                "points": points or index,
            }
            for index in range(1, steps + 1)
        ]
        (where / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return tmp_path


def seen(path, color):
    """Places of the pixels of nearly a colour, as shares of the width and of the height of the axes."""
    picture = np.asarray(Image.open(path).convert("RGB")).astype(int)
    frame = (picture < 60).all(2)
    left, right = np.flatnonzero(frame.mean(0) > 0.6)[[0, -1]]
    top, bottom = np.flatnonzero(frame.mean(1) > 0.6)[[0, -1]]
    rows, columns = np.nonzero((abs(picture - color) < 30).all(2)[:bottom])
    return (columns - left) / (right - left), (bottom - rows) / (bottom - top)


def test_points_rise_along_the_diagonal(folder, tmp_path):
    assert main(["curves", str(folder), "--out", str(tmp_path / "c.png")]) == 0
    x, y = seen(tmp_path / "c.png", BLUE)
    assert len(x) > 500 and abs(y - x / 1.05).max() < 0.02  # a twentieth of the height is left free above


def test_blocks_and_several_runs(folder, tmp_path, capsys):
    words = ["curves", str(folder), str(folder), "--block", "0", "--of", "loss", "--out", str(tmp_path / "c.png")]
    assert main(words) == 0
    assert capsys.readouterr().out.count("1.5") == 6
    _, y = seen(tmp_path / "c.png", ORANGE)  # the second lies on the first
    assert abs(y - 1 / 1.05).max() < 0.02


def test_a_chart_has_the_same_bytes_under_any_name_and_style(tmp_path, monkeypatch):
    import matplotlib

    steps = np.arange(1, 5.0)
    for name in ("a", "b"):
        write_lines(
            tmp_path / name, [PlotLine("_10$ run$", steps, steps), PlotLine("x" * 80, steps, 0 * steps)], "$", "steps"
        )
        monkeypatch.setitem(matplotlib.rcParams, "figure.facecolor", "red")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    picture = np.asarray(Image.open(tmp_path / "a").convert("RGB")).astype(int)
    legend = (abs(picture[-60:] - BLUE) < 30).all(2)  # matplotlib leaves names with an underscore out of its own
    assert legend.sum() > 20


def test_a_refinement(folder, tmp_path, capsys):
    assert main(["curves", str(folder), "--refinement", "0", "--out", str(tmp_path / "c.png")]) == 0
    assert capsys.readouterr().out.splitlines()[1].split()[1:] == ["40", "40", "40"]


@pytest.mark.parametrize(
    "words",
    [
        ["/nowhere"],
        [],
        ["RUN", "--block", "7"],
        ["RUN", "--refinement", "1"],
        ["RUN", "--refinement", "0", "--block", "0"],
        ["RUN", "--of", "memory"],
    ],
)
def test_what_cannot_be_drawn(folder, tmp_path, capsys, words):
    words = [str(folder) if word == "RUN" else word for word in words]
    assert main(["curves", *words, "--out", str(tmp_path / "c.png")]) == 2
    assert capsys.readouterr().err.startswith("surfkit: ") and not (tmp_path / "c.png").exists()
