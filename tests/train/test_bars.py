"""Progress on a terminal and elsewhere."""

import io

from rich.console import Console

from surfkit.core.events import Progress, emit
from surfkit.train import progress_bars
from surfkit.train.progress import outer
from surfkit.train.progress_bars import ProgressBars, bars


def test_without_a_terminal_there_is_a_line_now_and_then():
    said = io.StringIO()
    with bars(Console(file=said)):
        for at in range(1, 1001):
            emit(Progress("fusing views", at, 1000))
    lines = said.getvalue().splitlines()
    assert 1 <= len(lines) < 10 and lines[-1] == "fusing views  1000/1000"


def test_without_a_terminal_the_time_left_is_told_of_each_work_that_goes_on(monkeypatch):
    """Depth maps of thousands of photographs take hours, of which some may be done before."""
    said, now = io.StringIO(), [1000.0]
    monkeypatch.setattr(progress_bars.time, "perf_counter", lambda: now[0])
    with bars(Console(file=said, width=100)):
        for at in range(100, 201, 50):
            emit(Progress("matching photographs", at, 2000))
            emit(Progress("comparing depth maps", at // 2, 2000))
            now[0] += 60
        emit(Progress("matching photographs", 2000, 2000))
        emit(Progress("matching photographs", 7, 2000))
    assert said.getvalue().splitlines() == [
        "matching photographs  100/2000",
        "matching photographs  150/2000  37:00 left",
        "matching photographs  200/2000  36:00 left",
        "matching photographs  2000/2000",
    ]


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
