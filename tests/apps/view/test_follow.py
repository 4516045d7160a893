"""What is read of a run while it goes on."""

import json
import time

import numpy as np
import pytest

from surfkit.apps.view.control import TrainingControl
from surfkit.apps.view.follow_journal import JournalFollower, StageHistory, journals, newest_pictures, running_blocks
from surfkit.apps.view.live_panel import ELSEWHERE, NO_STEPS, OPAQUE_METHOD, in_words
from surfkit.core.codec import dump
from surfkit.core.events import Measured, StageBegan, StepDone, emit
from surfkit.runs.execute.block_state import BlockState, state_path
from surfkit.runs.journal import record_events


def step(index, **losses):
    return StepDone(index, 40, losses, 100 + index)


def test_a_journal_is_read_piece_by_piece(tmp_path):
    follower = JournalFollower(tmp_path)
    assert not follower.read() and follower.history.index == 0
    with record_events(tmp_path):
        emit(StageBegan("pretrain", 40, 100))
        emit(step(1, l1=0.5, ssim=0.25))
        assert follower.read() and follower.history.index == 1
        emit(step(2, l1=0.25, ssim=0.25))
        emit(Measured(2, {"a": 20.0, "b": 30.0}))
        assert follower.read() and not follower.read()
    found = follower.history
    assert (found.title, found.index, found.steps, found.points) == ("pretrain", 2, 40, 102)
    assert found.held_out == [(2, 25.0)]
    lines = found.losses()
    assert lines["step"].tolist() == [1, 2] and lines["all"].tolist() == [0.75, 0.5]
    assert lines["l1"].tolist() == [0.5, 0.25] and list(lines) == ["step", "all", "l1", "ssim"]


def test_a_line_that_is_being_written_is_read_when_it_is_whole(tmp_path):
    follower, path = JournalFollower(tmp_path), tmp_path / "events.jsonl"
    line = json.dumps({"event": "StepDone", "time": 1.0, "index": 7, "steps": 9, "losses": {"l1": 1}, "points": 3})
    path.write_text(line[:20])
    assert not follower.read()
    path.write_text(line + "\n")
    assert follower.read() and follower.history.rows == [(7, {"l1": 1.0})]


def test_steps_that_are_taken_back_are_forgotten(tmp_path):
    follower = JournalFollower(tmp_path)
    with record_events(tmp_path):
        emit(StageBegan("pretrain", 40, 100))
        for index in range(1, 9):
            emit(step(index, l1=1.0))
        follower.read()
        emit(StageBegan("pretrain", 40, 100, first=5))
        emit(step(5, l1=0.5))
    assert follower.read()
    assert [index for index, _ in follower.history.rows] == [1, 2, 3, 4, 5]
    assert follower.history.losses()["all"][-1] == 0.5


def test_damaged_lines_are_passed_over(tmp_path):
    good = '{"event": "StepDone", "time": 1, "index": 2, "steps": 9, "losses": {"l1": 1}, "points": 3}\n'
    bad = ["{\n", '{"event": "StepDone", "time": 1, "index": 1}\n', '{"event": "Measured", "time": 1, "index": 1}\n']
    bad += ['{"event": "StepDone", "time": 1, "index": 2, "steps": 9, "losses": [1], "points": 3}\n', "\0\xff\n"]
    (tmp_path / "events.jsonl").write_text("".join(bad) + good)
    follower = JournalFollower(tmp_path)
    assert follower.read() and len(follower.history.rows) == 1


def block(out, index, **state):
    folder = out / "blocks" / f"{index:03}"
    folder.mkdir(parents=True)
    (folder / "events.jsonl").write_text("")
    state_path(folder).write_text(json.dumps(dump(BlockState(**state))))
    return folder


def test_blocks_of_other_processes(tmp_path):
    (tmp_path / "events.jsonl").write_text("")
    block(tmp_path, 2, status="done", step=40, steps=40)
    folder = block(tmp_path, 10, status="running", step=1234, steps=5000, heard=time.time())
    block(tmp_path, 11, status="running", heard=time.time() - 1000)
    (tmp_path / "blocks" / "000-copy").mkdir()
    (tmp_path / "blocks" / "plan.json").write_text("{}")
    found = journals(tmp_path)
    assert found["block 10"] == folder and set(found) == {"whole scene", "block 2", "block 10", "block 11"}
    running = running_blocks(tmp_path)
    assert list(running) == [10]
    said = in_words(StageHistory(), None, running, TrainingControl())
    assert said.startswith(ELSEWHERE) and "block 10: step 1,234 of 5,000" in said
    state_path(folder).write_text("{")
    assert not running_blocks(tmp_path)
    assert in_words(StageHistory(), None, {}, TrainingControl()) == NO_STEPS


def test_a_method_that_makes_its_own_steps():
    history = StageHistory("field", 10, 0, [time.time()], [(7, {"sdf": 0.5})])
    said = in_words(history, None, {}, TrainingControl())
    assert said == f"**field** step 7 of 10, loss 0.5000\n\n{OPAQUE_METHOD}"
    history.times[-1] -= 1000
    assert in_words(history, None, {}, TrainingControl()).startswith(NO_STEPS)
    history.times[-1], history.steps = time.time(), 7
    assert in_words(history, None, {}, TrainingControl()).startswith(NO_STEPS)


def test_the_last_pictures(tmp_path):
    assert not newest_pictures(tmp_path)
    for name in ("000500/a.png", "001000/sub/b.png"):
        (tmp_path / "progress" / name).parent.mkdir(parents=True)
        (tmp_path / "progress" / name).write_bytes(b"")
    assert newest_pictures(tmp_path) == [tmp_path / "progress" / "001000" / "sub" / "b.png"]


@pytest.mark.parametrize("count", [2, 5000])
def test_curves_have_few_dots(count):
    history = StageHistory()
    for index in range(1, count + 1):
        history.rows.append((index, {"l1": float(index)}))
    lines = history.losses()
    assert len(lines["step"]) == min(count, 300) and lines["step"][-1] == count and list(lines) == ["step", "all"]
    assert lines["all"][0] == (1 if count == 2 else 9), "the mean of the first 17"


def test_the_speed_is_that_of_the_last_steps():
    history = StageHistory(times=[0.0, 100.0, *np.arange(200, 210, 0.5)])
    assert (
        history.speed == 2.0
        and StageHistory(times=[1.0]).speed is None
        and StageHistory(times=[1.0, 1.0]).speed is None
    )
