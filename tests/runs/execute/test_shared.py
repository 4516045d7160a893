"""Jobs for other machines: what they look for before they begin, and what they leave to whoever sent them."""

import _thread
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from surfkit.runs.execute import remote
from surfkit.runs.execute.base import LOG, Job
from surfkit.runs.execute.remote import RemoteJob, RemoteResult, run_remote_job
from surfkit.runs.execute.shared_filesystem import MARK_PREFIX, mark_folder, remote_job

HOST = socket.gethostname()


def job(folder: Path, code: str, **more) -> Job:
    return Job(0, folder / "000", lambda: 0, ("-c", code), **more)


def test_an_errand_is_run(tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    seen = "import json, os\nnames = 'OMP_NUM_THREADS', 'CUDA_VISIBLE_DEVICES'\n"
    seen += "print(json.dumps([os.environ[name] for name in names]))"
    with mark_folder([job(tmp_path, "")]) as mark:
        assert remote_job(job(tmp_path, seen), mark, 2, gpu=False)() == RemoteResult(0, HOST)
        assert remote_job(job(tmp_path, f"{seen}\nraise SystemExit(3)"), mark, 1, gpu=True)() == RemoteResult(3, HOST)
    lines = (tmp_path / "000" / LOG).read_text().splitlines()
    assert list(map(json.loads, lines)) == [["2", ""], ["1", "3"]]


def test_another_disk(tmp_path):
    """The folders are there, but the mark is not: they are others of the same name."""
    (tmp_path / f"{MARK_PREFIX}of-a-driver-that-was-killed").touch()
    with mark_folder([job(tmp_path, "")]) as mark:
        assert [path.name for path in tmp_path.iterdir()] == [mark.name]
        made = remote_job(job(tmp_path, ""), mark, 1, gpu=False)
    found = made()
    assert found.status == 2
    assert found.why.startswith(f"machine {HOST}: {mark} is not there")
    assert not list(tmp_path.glob(f"{MARK_PREFIX}*")) and not (tmp_path / "000" / LOG).exists()


def test_killed_for_lack_of_memory(tmp_path, monkeypatch):
    """The kernel of the machine where it ran counts one more; a process that someone else kills is none of those."""
    kills = iter([3, 4, 7, 7])
    monkeypatch.setattr(remote, "oom_kills", lambda: next(kills))
    with mark_folder([job(tmp_path, "")]) as mark:
        made = remote_job(job(tmp_path, "import os; os.kill(os.getpid(), 9)"), mark, 1, gpu=False)
        assert made() == RemoteResult(-9, HOST, kind="oom")
        assert replace(made, process=None)() == RemoteResult(-9, HOST)


def test_another_version(tmp_path):
    with mark_folder([job(tmp_path, "")]) as mark:
        found = replace(remote_job(job(tmp_path, ""), mark, 1, gpu=False), version="0.0.7")()
    assert found.status == 2 and "the run is of 0.0.7;" in found.why


def test_told_to_end_by_someone_else(tmp_path):
    """A cluster tells every process of a job; the one that minds it then waits for its own end."""
    with mark_folder([job(tmp_path, "")]) as mark:
        made = remote_job(job(tmp_path, "raise SystemExit(130)"), mark, 1, gpu=False)
        began = time.monotonic()
        assert replace(made, hold_s=0.7)().status == 130 and time.monotonic() - began > 0.7


@pytest.mark.parametrize("module", ["torch", "numpy", "pycolmap"])
def test_agents_are_light(module):
    """What an agent of a cluster imports for an errand."""
    code = f"import sys, surfkit.runs.execute.remote; raise SystemExit({module!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_an_agent_hears_ctrl_c_also_where_the_shell_ignores_it(tmp_path):
    """As in all that a shell begins in the background: Ray's way to cancel would mean nothing to it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    remote_job = RemoteJob(("-c", "import time; time.sleep(3600)"), tmp_path / "log.txt")

    def ask():
        while remote_job.process is None:
            time.sleep(0.01)
        _thread.interrupt_main()

    asking = threading.Thread(target=ask)
    try:
        asking.start()
        with pytest.raises(KeyboardInterrupt):
            run_remote_job(remote_job)
    finally:
        asking.join()
        signal.signal(signal.SIGINT, before)
    assert remote_job.process.poll() is not None
