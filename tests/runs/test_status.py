import json

import pytest

from surfkit.cli import main
from surfkit.core.codec import write_json
from surfkit.core.events import FileWritten, Measured, StageBegan, StepDone, emit
from surfkit.core.lock import locked
from surfkit.runs.journal import record_events

TOTALS = {"points": 9, "steps": 40, "seconds": 2.0, "cpu_seconds": 3.0}


@pytest.fixture
def folder(tmp_path):
    """A run of 400 steps that got to step 120, with a checkpoint at step 100."""
    out = tmp_path / "run"
    write_json(out / "run.json", {"notes": ["the scene is odd"], "skipped": ["c.jpg"]})
    write_json(out / "recipe.json", {"pretrain": {"steps": 400}})
    with record_events(out):
        emit(StageBegan("pretrain", 400, 50))
        for index in range(1, 121):
            emit(StepDone(index, 400, {"l1": 0.5, "ssim": 0.25}, 50 + index, 10**9))
            if index == 80:
                emit(Measured(80, {"a": 20.0, "b": 21.0}))
            if index == 100:
                emit(FileWritten(out / "pretrain" / "checkpoint.safetensors", "checkpoint"))
    lines = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    for at, line in enumerate(lines):  # as if four steps had been made a second, after ten slow ones
        index = line.get("index", at)
        line["time"] = 1000 + index / 4 if index > 10 else 10 * index
    (out / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return out


def test_a_stopped_run(folder, capsys):
    assert main(["status", str(folder), "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert found == {
        "state": "stopped", "process": None, "stage": "pretrain", "step": 120, "steps": 400, "saved_step": 100,
        "steps_per_second": pytest.approx(4), "seconds_left": None, "points": 170, "loss": 0.75,
        "peak_memory_bytes": 10**9, "peak_gpu_bytes": None, "metrics": {"psnr": 20.5, "views": 2, "step": 80},
        "notes": ["the scene is odd"], "skipped": ["c.jpg"], "blocks": [],
    }  # fmt: skip
    assert main(["status", str(folder)]) == 3
    lines = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert ["state", "stopped"] in lines and ["step", "120 of 400 of pretrain"] in lines
    assert ["speed", "4.0 it/s"] in lines and ["note", "the scene is odd"] in lines and ["skipped", "c.jpg"] in lines


def test_a_running_run_names_its_process_and_the_time_left(folder, capsys):
    with locked(folder):
        assert main(["status", str(folder), "--json"]) == 3
        found = json.loads(capsys.readouterr().out)
        assert found["state"] == "running" and found["process"].startswith("process ")
        assert found["seconds_left"] == pytest.approx(280 / 4, abs=0.2)
        assert main(["status", str(folder)]) == 3
        assert "time left        0:01:10" in capsys.readouterr().out


def test_the_peak_of_memory_is_that_of_the_whole_run(folder, capsys):
    """Steps are not all that takes memory: the mesh and the pictures come after them."""
    kept = json.loads((folder / "run.json").read_text())
    write_json(folder / "run.json", kept | {"memory_bytes": {"peak": 2 * 10**9}})
    main(["status", str(folder)])
    assert "peak memory      2000 MB" in capsys.readouterr().out
    images = {"images": {"psnr": None, "ssim": None, "per_image": {}}}
    write_json(folder / "metrics.json", images | TOTALS | {"peak_memory_bytes": 3 * 10**9})
    main(["status", str(folder)])
    assert "peak memory      3000 MB" in capsys.readouterr().out


def test_a_finished_run(folder, capsys):
    write_json(folder / "metrics.json", {"images": {"psnr": 23.456, "ssim": 0.8, "per_image": {"a": {}}}} | TOTALS)
    (folder / "point_cloud.ply").touch()
    assert main(["status", str(folder)]) == 0
    assert "23.46 dB of 1 views\n" in capsys.readouterr().out
    with locked(folder):
        assert main(["status", str(folder)]) == 3, "someone is at it again"


def test_no_run_is_2(tmp_path, capsys):
    assert main(["status", str(tmp_path)]) == 2
    assert "no run folder" in capsys.readouterr().err
    with locked(tmp_path / "run"):
        assert main(["status", str(tmp_path / "run")]) == 2
        assert "is about to begin one" in capsys.readouterr().err
