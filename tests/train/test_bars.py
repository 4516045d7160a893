"""Progress on a terminal and elsewhere."""

import io

from rich.console import Console

from surfkit.core.events import Progress, emit
from surfkit.train.progress import outer
from surfkit.train.progress_bars import ProgressBars, bars


def test_without_a_terminal_there_is_a_line_now_and_then():
    said = io.StringIO()
    with bars(Console(file=said)):
        for at in range(1, 1001):
            emit(Progress("fusing views", at, 1000))
    lines = said.getvalue().splitlines()
    assert 1 <= len(lines) < 10 and lines[-1] == "fusing views  1000/1000"


def test_on_a_terminal_there_is_a_bar_that_ends():
    said = io.StringIO()
    shown = ProgressBars(Console(file=said, force_terminal=True, width=100))
    for at in range(1, 4):
        shown.surfkit_event(Progress("fusing tiles", at, 3))
        assert (shown.live is None) == (at == 3)
    assert "fusing tiles" in said.getvalue() and "3/3" in said.getvalue()


def test_nothing_is_drawn_into_a_larger_display():
    said = io.StringIO()
    with bars(Console(file=said)), outer(lambda *_: None):
        emit(Progress("fusing views", 1, 1))
    assert not said.getvalue()
