import fcntl
import json
import os
import re
import subprocess
import sys

import pytest

from surfkit.core import lock
from surfkit.core.check import BadInput
from surfkit.core.lock import FORMER_LOCK_FILE, LOCK_FILE, lock_holder, locked

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
    monkeypatch.setattr(lock, "LOCK_TIMEOUT_S", 0.05)
    with pytest.raises(BadInput, match=rf"run: process {other.pid} on"), locked(tmp_path / "run"):
        pass
    assert lock_holder(tmp_path / "run").startswith(f"process {other.pid} on ")
    other.kill()
    other.wait()
    assert lock_holder(tmp_path / "run") is None and (tmp_path / "run" / LOCK_FILE).exists(), (
        "killed, it leaves the file"
    )
    with locked(tmp_path / "run"):
        assert json.loads((tmp_path / "run" / LOCK_FILE).read_text())["pid"] == os.getpid()


def test_an_empty_folder_does_not_stay(tmp_path):
    with pytest.raises(ValueError, match="on the way"), locked(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b" / LOCK_FILE).exists()
        raise ValueError("on the way")
    assert not (tmp_path / "a").exists()
    with locked(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "result").touch()
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["result"]


def test_a_lock_that_was_deleted_meanwhile_is_none(tmp_path, monkeypatch):
    path, flock, calls = tmp_path / LOCK_FILE, fcntl.flock, []

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


@pytest.mark.parametrize("kind", ["link", "link to nothing", "text", "json", "nested", "folder", "pipe"])
def test_what_is_not_our_file_stays_as_it_is(tmp_path, kind):
    out, mine = tmp_path / "run", tmp_path / "mine.txt"
    out.mkdir()
    path, content = out / LOCK_FILE, {"json": '{"pid": 1}', "nested": "[" * 4000}.get(kind, "my own text")
    mine.write_text(content)
    if kind.startswith("link"):
        path.symlink_to(mine if kind == "link" else tmp_path / "new.txt")
    elif kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.write_text(content)
    with pytest.raises(BadInput, match=f"{re.escape(str(path))}: not a file"), locked(out):
        pass
    assert lock_holder(out) is None
    assert os.path.lexists(path) and mine.read_text() == content and not (tmp_path / "new.txt").exists()
    assert not path.is_file() or path.read_text() == content


def test_a_file_called_lock_may_be_the_users(tmp_path):
    (tmp_path / FORMER_LOCK_FILE).write_text("mine")
    with locked(tmp_path):
        assert lock_holder(tmp_path).startswith(f"process {os.getpid()} on ")
    assert [path.name for path in tmp_path.iterdir()] == [FORMER_LOCK_FILE] and (
        tmp_path / FORMER_LOCK_FILE
    ).read_text() == "mine"


def test_a_process_of_an_older_version_is_waited_for(tmp_path):
    (tmp_path / FORMER_LOCK_FILE).write_text('{"pid": 77, "host": "there"}')
    with (tmp_path / FORMER_LOCK_FILE).open("r+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert lock_holder(tmp_path) == "process 77 on there"
        with pytest.raises(BadInput, match="process 77 on there"), locked(tmp_path):
            pass
    with locked(tmp_path):
        pass
