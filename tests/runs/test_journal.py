import json

from surfkit.core.events import FileWritten, StageBegan, StepDone, Warned, emit
from surfkit.runs.journal import read, record_events


def steps(path):
    return [line["index"] for line in read(path) if line["event"] == "StepDone"]


def take(folder, first, last):
    emit(StageBegan("pretrain", 9, 5, first))
    for index in range(first, last + 1):
        emit(StepDone(index, 9, {"l1": float("nan") if index == 2 else 0.5}, 5))


def test_events_are_lines_and_none_is_held_back(tmp_path):
    with record_events(tmp_path):
        take(tmp_path, 1, 2)
        emit(FileWritten(tmp_path / "pretrain" / "c", "checkpoint"))
        lines = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [line["event"] for line in lines] == ["StageBegan", "StepDone", "StepDone", "FileWritten"]
    assert lines[2]["losses"] == {"l1": "nan"} and lines[3]["path"] == "pretrain/c" and lines[0]["time"] > 1e9
    emit(Warned("nobody keeps this"))
    assert len(read(tmp_path / "events.jsonl")) == 4


def test_steps_that_come_again_are_there_once(tmp_path):
    path = tmp_path / "events.jsonl"
    with record_events(tmp_path):
        take(tmp_path, 1, 6)
        emit(Warned("stays"))
    with path.open("a") as file:
        file.write('{"event": "StepDone", "ind')  # the process died here
    with record_events(tmp_path):
        take(tmp_path, 4, 8)
        take(tmp_path, 6, 9)  # rolled back
    assert steps(path) == list(range(1, 10))
    assert [line["first"] for line in read(path) if line["event"] == "StageBegan"] == [1, 4, 6]
    assert sum(line["event"] == "Warned" for line in read(path)) == 1
    assert path.read_text().endswith("\n") and not list(tmp_path.glob(".*"))


def test_an_event_after_a_torn_line_is_whole(tmp_path):
    path = tmp_path / "events.jsonl"
    path.write_text('{"time": 1, "event": "StepDone", "index": 1}\n{"event": "War')
    with record_events(tmp_path):
        emit(Warned("next"))
    assert [line["event"] for line in read(path)] == ["StepDone", "Warned"]
