import fcntl
import json
import os
import subprocess
import sys

import pytest

from surfkit.core import lock
from surfkit.core.check import BadInput
from surfkit.core.lock import lock_holder, locked

WAITS = """
import sys
from pathlib import Path
from surfkit.core.lock import locked
with locked(Path(sys.argv[1])):
    print("has it", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path):
    """Another process that works in tmp_path / "run"."""
    words = [sys.executable, "-c", WAITS, str(tmp_path / "run")]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "has it\n"
        yield process
        process.kill()


def test_a_second_process_is_refused_until_the_first_is_dead(other, tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "PATIENCE_S", 0.05)
    with pytest.raises(BadInput, match=rf"run: process {other.pid} on \S+ works in it; wait"), locked(tmp_path / "run"):
        pass
    assert lock_holder(tmp_path / "run").startswith(f"process {other.pid} on ")
    other.kill()
    other.wait()
    assert lock_holder(tmp_path / "run") is None and (tmp_path / "run" / "lock").exists(), "killed, it leaves the file"
    with locked(tmp_path / "run"):
        assert json.loads((tmp_path / "run" / "lock").read_text())["pid"] == os.getpid()


def test_an_empty_folder_does_not_stay(tmp_path):
    with pytest.raises(ValueError, match="on the way"), locked(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b" / "lock").exists()
        raise ValueError("on the way")
    assert not (tmp_path / "a").exists()
    with locked(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "result").touch()
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["result"]


def test_a_lock_that_was_deleted_meanwhile_is_none(tmp_path, monkeypatch):
    path, flock, calls = tmp_path / "lock", fcntl.flock, []

    def slow(file, how):  # between our opening and our locking, the one before deletes its file
        calls.append(how)
        if len(calls) == 1:
            path.unlink()
        flock(file, how)

    monkeypatch.setattr(fcntl, "flock", slow)
    with locked(tmp_path):
        assert len(calls) == 2 and path.exists()


def test_without_locks_there_is_a_note(tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(lock, "emit", lambda event: said.append(event.text))

    def refuse(file, how):
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with locked(tmp_path / "run"):
        assert len(said) == 1 and "cannot be locked" in said[0]
