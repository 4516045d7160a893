"""Numbers of runs, step by step, in one chart."""

import json

import numpy as np
import pytest
from PIL import Image

from surfkit.cli import main
from surfkit.evaluate.geometry.chart import BLUE, LEFT, ORANGE, RIGHT, SIZE, round_above


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
    """Rows and columns of the pixels of nearly a colour, between the axes."""
    picture = np.asarray(Image.open(path)).astype(int)[:400, LEFT + 3 : SIZE[0] - RIGHT - 3]
    return np.nonzero((abs(picture - color) < 30).all(2))


def test_points_rise_along_the_diagonal(folder, tmp_path):
    assert main(["curves", str(folder), "--out", str(tmp_path / "c.png")]) == 0
    rows, columns = seen(tmp_path / "c.png", BLUE)
    slope, _ = np.polyfit(columns, rows, 1)
    assert slope == pytest.approx(-(SIZE[1] - 44 - 56) / (SIZE[0] - LEFT - RIGHT), rel=0.02)


def test_blocks_and_several_runs(folder, tmp_path, capsys):
    words = ["curves", str(folder), str(folder), "--block", "0", "--of", "loss", "--out", str(tmp_path / "c.png")]
    assert main(words) == 0
    assert capsys.readouterr().out.count("1.5") == 6
    rows, _ = seen(tmp_path / "c.png", ORANGE)  # the second lies on the first
    assert rows.max() - rows.min() <= 3 and round_above(1.5) == 2.0


def test_a_refinement(folder, tmp_path, capsys):
    assert main(["curves", str(folder), "--refinement", "0", "--out", str(tmp_path / "c.png")]) == 0
    assert capsys.readouterr().out.count("40") == 3


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
