"""The picture of a table: bars where the numbers are, read back from the pixels."""

import numpy as np
import pytest
from PIL import Image

from surfkit.study import table_picture
from surfkit.study.table_picture import write_picture

BLUE, GREY = (31, 119, 180), (166, 166, 166)


def row(label, on=None, difference=None, published=None, kept=True):
    steps = {} if difference is None else {"psnr": {"mean": difference, "base": 20.0, "standard_error": 0.1}}
    paper = {} if published is None else {"psnr": published}
    return {
        "number": len(label),
        "label": label,
        "group": "",
        "built_on": on,
        "kept": kept,
        "mean": {"psnr": 20.0 + (difference or 0)},
        "paper": {},
        "paper_difference": paper,
        "difference": steps,
    }


def report(*rows):
    return {
        "table": "two",
        "about": "Costs $1 and $2",
        "steps": 10,
        "max_points": None,
        "seeds": 2,
        "columns": [],
        "data_sets": [{"data": {"path": "/a/scene"}, "rows": list(rows)}],
    }


def columns_of(path, color):
    """First and last column with a color in the picture, above its legend."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    pixels = pixels[: len(pixels) // 2]
    x = np.nonzero((np.abs(pixels - color).max(2) <= 2).sum(0) > 10)[0]  # more than the rims of letters
    return x[0], x[-1]


def test_bars_are_as_long_as_the_differences(tmp_path):
    rows = row("base"), row("+ gain", "base", 2.0, 1.0), row("+ loss", "+ gain", -1.0, 3.0, kept=False)
    path = tmp_path / "ablation.png"
    assert write_picture(path, report(*rows))
    (blue_from, blue_to), (grey_from, grey_to) = columns_of(path, BLUE), columns_of(path, GREY)
    wide = blue_to - blue_from, grey_to - grey_from
    assert wide[0] == pytest.approx(2 * wide[1], abs=4), "2 dB and 1 dB"
    assert blue_from == pytest.approx(grey_to, abs=4), "both begin at 0, to either side"


def test_nothing_is_drawn_before_two_rows_can_be_compared(tmp_path):
    path = tmp_path / "ablation.png"
    path.write_bytes(b"of an earlier command")
    assert not write_picture(path, report(row("base"), row("+ gain", "base")))
    assert not list(tmp_path.iterdir()), "what it showed is no longer so"


def test_columns_that_have_no_differences_have_no_panel():
    both = report(row("base"), row("+ gain", "base", 2.0))
    assert table_picture._panels(both) == ["psnr"]
    assert table_picture._panels(both | {"columns": ["f1"]}) == [], "the user asked for another column"
