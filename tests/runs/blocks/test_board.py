"""What is told of blocks while they are tuned."""

import io
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.console import Console

from surfkit.apps.status import rows
from surfkit.runs.blocks.block_display import BlockDisplay, BlockProgress, progress_table, read_state_since
from surfkit.runs.blocks.eta import (
    describe_progress,
    seconds_elapsed,
    seconds_left,
    steps_per_second,
    total_seconds_left,
)
from surfkit.runs.execute.block_state import BlockState, read_state, write_state
from surfkit.runs.run_status import SHOWN_FIELDS, BlockStatus, Status
from surfkit.train import progress

RUNNING = BlockState("running", step=130, steps=300, first=30, began=1000.0, heard=1020.0)
DONE = BlockState("done", step=300, steps=300, began=1000.0, heard=1030.0)
FAILED = BlockState("failed", step=70, steps=300, error="numbers", began=1000.0, heard=1020.0)
STATES = {0: RUNNING, 1: DONE, 2: BlockState(), 3: FAILED}


def wait_until(what):
    while not what():
        time.sleep(0.01)


def test_time_left_of_a_block():
    assert (seconds_elapsed(RUNNING), steps_per_second(RUNNING), seconds_left(RUNNING)) == (20.0, 5.0, 34.0)
    assert describe_progress(RUNNING) == "step 130/300, 0:20, 0:34 left"
    early = replace(RUNNING, heard=1001.0)
    assert steps_per_second(early) is None and describe_progress(early) == "step 130/300, 0:01"
    assert seconds_elapsed(FAILED) is None and seconds_left(DONE) is None


def test_a_block_that_is_worked_on_no_more(monkeypatch):
    now = time.time()
    monkeypatch.setattr("surfkit.apps.status.time", SimpleNamespace(time=lambda: now))
    state = {name: getattr(RUNNING, name) for name in SHOWN_FIELDS}
    there = [BlockStatus(0, 9, **state | {"heard": now - ago, "began": now - 200}) for ago in (100, 0)]
    (_, silent), (_, heard) = [row for row in rows(Status("stopped", blocks=tuple(there))) if row[0] == "block 0"]
    assert "running, but silent for 1:40, step 130 of 300" in silent and "left" not in silent
    assert "silent" not in heard and "5:40 left" in heard


def test_time_left_of_all_blocks():
    blocks, rest = list(STATES.values()), (300 - 130) + 300 + (300 - 70)
    assert total_seconds_left(blocks, 300) == pytest.approx(rest / 5)
    assert total_seconds_left(blocks, 300, at_once=2) == pytest.approx(rest / 10)
    assert total_seconds_left(blocks, 300, at_once=9) == pytest.approx(rest / 15), "three are left to work on"
    assert total_seconds_left([RUNNING, replace(RUNNING, heard=1001.0)], 300) == pytest.approx(34), (
        "the new one will be as fast"
    )
    assert total_seconds_left([DONE, BlockState()], 300) == pytest.approx(30), "as long as the one before"
    assert total_seconds_left([DONE], 300) is None and total_seconds_left([BlockState()], 300) is None


def test_lines_where_there_is_no_terminal(monkeypatch):
    monkeypatch.setattr("surfkit.runs.blocks.block_display.BOARD_LINE_EVERY_S", 0.02)
    text, began = io.StringIO(), time.monotonic()
    with BlockDisplay(lambda: BlockProgress(STATES, 300, 2), Console(file=text)):
        wait_until(lambda: text.getvalue().count("\n") > 4)
    lines = text.getvalue().splitlines()
    assert set(lines) == {"1 of 4 blocks done, about 1:10 left; block 0: step 130/300, 0:20, 0:34 left"}
    assert len(lines) <= (time.monotonic() - began) / 0.02


def test_a_table_on_a_terminal():
    console = Console(file=io.StringIO(), force_terminal=True, width=110)
    reduced = replace(RUNNING, reduced=("at most 9 points from step 3 on",))
    console.print(progress_table(BlockProgress(STATES | {2: reduced}, 300, 2)))
    text = console.file.getvalue()
    assert "1 of 4 blocks done" in text and "at most 9 points" in text and "numbers" in text
    assert text.count("/300") == 3 and "silent for" in text, "heard of long ago"


def test_a_larger_display_gets_the_sum(monkeypatch):
    monkeypatch.setattr("surfkit.runs.blocks.block_display.BOARD_EVERY_S", 0.01)
    seen = []
    with progress.outer(lambda *line: seen.append(line)), BlockDisplay(lambda: BlockProgress(STATES, 300)):
        wait_until(lambda: seen)
    assert seen[0] == ("blocks", 130 + 300 + 70, 1200, "1 of 4 blocks done, about 2:20 left")


def test_what_an_earlier_attempt_has_left_is_not_told(tmp_path):
    write_state(tmp_path, read_state(tmp_path), status="running", step=5)
    now = time.time()
    assert (
        read_state_since(tmp_path, now - 60).status == "running"
        and read_state_since(tmp_path, now + 60).status == "planned"
    )
    write_state(tmp_path, read_state(tmp_path), status="done")
    assert read_state_since(tmp_path, now + 60).status == "done"
    (tmp_path / "state.json").write_text("{")
    assert read_state_since(tmp_path, 0) == BlockState()
