"""Executors with jobs that take no time, in real processes."""

import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.runs.execute import base
from surfkit.runs.execute.base import LOG, Inline, Job, Pool
from surfkit.runs.execute.block_state import STALE_S, BlockState, find_worker, read_state, write_state


def job(folder: Path, index: int, code: str = "", **more) -> Job:
    place = folder / f"{index:02}"
    place.mkdir()
    words = ("-c", f"import os; os.chdir({str(place)!r}); {code or 'pass'}")
    return Job(index, place, lambda: index, words, **more)


def until(path: str) -> str:
    """Code that waits until there is a file, while there is somebody to make it."""
    code = "import time\nparent = os.getppid()\n"
    code += f"while not os.path.exists({path!r}):\n    assert os.getppid() == parent\n    time.sleep(0.02)"
    return f"exec({code!r})"


def test_inline_calls_one_after_the_other(tmp_path):
    assert [(end.job.index, end.status) for end in Inline().run([job(tmp_path, 0), job(tmp_path, 3)])] == [
        (0, 0),
        (3, 3),
    ]


def test_pool_tells_how_each_ended_and_keeps_what_it_printed(tmp_path):
    killed = "import os; os.kill(os.getpid(), 9)"
    jobs = [job(tmp_path, 0, "print('hello')"), job(tmp_path, 1, "raise SystemExit(1)"), job(tmp_path, 2, killed)]
    assert {end.job.index: end.status for end in Pool().run(jobs)} == {0: 0, 1: 1, 2: -9}
    assert (tmp_path / "00" / LOG).read_text() == "hello\n"


def test_pool_reports_what_the_kernel_killed_for_lack_of_memory(tmp_path, monkeypatch):
    kills = iter([2, 3, 3])
    monkeypatch.setattr(base, "oom_kills", lambda: next(kills))
    killed = "import os; os.kill(os.getpid(), 9)"
    jobs = [job(tmp_path, at, killed, cost=3 - at) for at in range(2)] + [job(tmp_path, 2, "raise SystemExit(3)")]
    ends = list(Pool(workers=1).run(jobs))
    assert [(end.status, end.kind) for end in ends] == [(-9, "oom"), (-9, None), (3, None)]


def test_who_shows_progress():
    assert Inline().in_process and not Pool().in_process


def test_pool_divides_the_processors(tmp_path):
    say = "print(os.environ['OMP_NUM_THREADS'])"
    list(Pool(workers=1, threads=3).run([job(tmp_path, 0, say)]))
    list(Pool(workers=1000).run([job(tmp_path, 1, say)]))
    assert [(tmp_path / name / LOG).read_text() for name in ("00", "01")] == ["3\n", "1\n"]


def test_pool_gives_each_process_a_gpu(tmp_path, monkeypatch):
    """The last one gets the GPU of the process that has ended; the first one ends when the last has begun."""
    say = "print(os.environ['CUDA_VISIBLE_DEVICES'], flush=True); open('began', 'w').close()"
    jobs = [job(tmp_path, at, say + "; " + wait, cost=9 - at) for at, wait in enumerate([until("../02/began"), "", ""])]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,GPU-7,5")
    list(Pool(workers=2, gpus=2).run(jobs))
    assert [(tmp_path / name / LOG).read_text() for name in ("00", "01", "02")] == ["2\n", "GPU-7\n", "GPU-7\n"]


def test_pool_wants_no_more_gpus_than_there_are(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    Pool(gpus=3).ready()
    with pytest.raises(BadInput, match="pool.gpus is 4, .*0 to 3"):
        Pool(gpus=4).ready()


def test_the_largest_begin_first(tmp_path):
    jobs = [job(tmp_path, at, cost=cost) for at, cost in enumerate([1.0, 5.0, 3.0])]
    assert [end.job.index for end in Pool(workers=1).run(jobs)] == [1, 2, 0]


def test_two_at_a_time(tmp_path):
    """Each waits for the other to begin, which one after the other would never do."""
    jobs = [job(tmp_path, at, f"open('began', 'w').close(); {until(f'../{1 - at:02}/began')}") for at in (0, 1)]
    assert [end.status for end in Pool(workers=2).run(jobs)] == [0, 0]


def test_memory_keeps_blocks_waiting_but_never_all(tmp_path, monkeypatch):
    monkeypatch.setattr(base, "free_bytes", lambda: 1_000)
    look = "import glob; raise SystemExit(len(glob.glob('../*/here')) and 7)"
    slow = "from pathlib import Path; import time; Path('here').touch(); time.sleep(0.5); Path('here').unlink()"
    jobs = [job(tmp_path, 0, slow, cost=2.0, memory_bytes=5_000), job(tmp_path, 1, look, memory_bytes=500)]
    assert {end.job.index: end.status for end in Pool(workers=2).run(jobs)} == {0: 0, 1: 0}


def test_leaving_stops_the_workers(tmp_path, monkeypatch):
    """As Ctrl-C does: they get SIGTERM, may save, and are waited for."""
    code = "import signal, sys, time\nfrom pathlib import Path\n"
    code += "def save(*_):\n    Path('saved').touch()\n    sys.exit(130)\n"
    code += "signal.signal(signal.SIGTERM, save)\nPath('began').touch()\ntime.sleep(3600)\n"
    running = Pool(workers=1).run([job(tmp_path, 0, f"exec({code!r})")])

    class Stop(Exception):
        pass

    def sleep(seconds):
        if (tmp_path / "00" / "began").exists():
            raise Stop
        time.sleep(seconds)

    monkeypatch.setattr(base, "time", SimpleNamespace(sleep=sleep))  # not that of all modules and threads
    with pytest.raises(Stop):
        next(running)
    assert (tmp_path / "00" / "saved").exists()


def test_a_state_is_read_as_it_was_written(tmp_path):
    assert read_state(tmp_path) == BlockState()
    write_state(tmp_path, read_state(tmp_path), status="running", step=3, steps=10, attempts=1)
    state = read_state(tmp_path)
    assert (state.status, state.step, state.steps, state.attempts, state.pid) == ("running", 3, 10, 1, os.getpid())


def test_who_is_still_at_work(tmp_path):
    """Here the lock tells, whatever pid is written down; elsewhere, when it was heard of."""
    write_state(tmp_path, read_state(tmp_path), status="running")
    assert not find_worker(tmp_path)
    with locked(tmp_path):
        assert find_worker(tmp_path)
    write_state(tmp_path, read_state(tmp_path), host="another")
    assert find_worker(tmp_path)
    write_state(tmp_path, read_state(tmp_path), host="another", heard=time.time() - STALE_S - 1)
    assert not find_worker(tmp_path)


@pytest.mark.parametrize("settings", [{"workers": 0}, {"threads": -1}, {"memory_share": 0.0}])
def test_bad_settings(settings):
    with pytest.raises(BadInput, match="pool"):
        Pool(**settings)
