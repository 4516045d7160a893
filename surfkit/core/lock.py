"""One process at a time in a folder. The kernel releases the lock when its process ends, also after kill -9."""

from __future__ import annotations

import errno
import json
import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import from_json, read_json
from surfkit.core.events import Warned, emit
from surfkit.core.files import FILE_PREFIX

LOCK_FILE = f"{FILE_PREFIX}lock"
FORMER_LOCK_FILE = "lock"
"""So processes of older versions call it, which are waited for; a file of that name may also be the user's own."""
IN_USE_FILE = "in-use"
"""File of a folder that several processes may use at once; its time is when one last began to."""
DAY_S = 86_400
NO_FOLLOW_FLAGS = os.O_NOFOLLOW | os.O_NONBLOCK
"""How a file is opened that somebody else may have put there: no link is followed, no pipe waited for."""
LOCK_TIMEOUT_S = 0.5
"""How long to ask again: a process that only looks (`lock_holder`) has the lock for a moment."""
MAX_LOCK_BYTES = 4096
"""Bytes that the file of a lock may have."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Within, no other process can lock this folder. It is created if missing, and removed again if left empty.

    Raises:
        BadInput: Another process has it; names the process and its host. Or something else than our file has the name.
    """
    made = _make(folder)
    try:
        file = _lock(folder / LOCK_FILE, folder)
        try:
            yield
        finally:
            if file is not None:
                (folder / LOCK_FILE).unlink(missing_ok=True)
                os.close(file)
    finally:
        with suppress(OSError):  # what is not empty stays
            for path in made:
                path.rmdir()


def lock_holder(folder: Path) -> str | None:
    """The process that has locked a folder, as "process PID on HOST"; None if none has."""
    return next(
        (holder for name in (LOCK_FILE, FORMER_LOCK_FILE) if (holder := _holder(folder / name)) is not None), None
    )


def _holder(path: Path) -> str | None:
    import fcntl

    try:
        file = os.open(path, os.O_RDONLY | NO_FOLLOW_FLAGS)
    except OSError:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return _named(path) if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    finally:
        os.close(file)
    return None


@contextmanager
def mark_used(folder: Path) -> Iterator[None]:
    """Within, `is_used` is true for the folder, also in other processes."""
    import fcntl

    try:
        file = os.open(folder / IN_USE_FILE, os.O_RDWR | os.O_CREAT | NO_FOLLOW_FLAGS, 0o666)
    except OSError as error:
        if error.errno not in (errno.EROFS, errno.EACCES, errno.EPERM):
            raise
        yield  # what cannot be written to, nobody deletes either
        return
    try:
        os.utime(file)
        with suppress(OSError):  # where there are no locks, the time alone tells
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        yield
    finally:
        os.close(file)


def is_used(folder: Path) -> bool:
    """Whether a process uses a folder; where files cannot be locked, whether one began to within a day."""
    import fcntl

    try:
        file = os.open(folder / IN_USE_FILE, os.O_RDWR | NO_FOLLOW_FLAGS)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return True
        return time.time() - os.fstat(file).st_mtime < DAY_S
    finally:
        os.close(file)
    return False


def _make(folder: Path) -> list[Path]:
    """The folders that were missing, innermost first; now they are there."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing


def _lock(path: Path, folder: Path) -> int | None:
    """The open, locked file; None where the file system has no locks."""
    import fcntl

    if (holder := _holder(folder / FORMER_LOCK_FILE)) is not None:
        raise _in_use(folder, holder)
    until = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        file = _opened(path)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(file, path):
                os.ftruncate(file, 0)
                os.write(file, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())
                return file
        except OSError as error:
            os.close(file)
            if error.errno in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                emit(Warned(f"{folder} lies where files cannot be locked; see to it that only one process works there"))
                return None
            if error.errno not in (errno.EWOULDBLOCK, errno.EACCES):
                raise
            if time.monotonic() > until:
                raise _in_use(folder, _named(path)) from error
            time.sleep(LOCK_TIMEOUT_S / 10)
        else:
            os.close(file)  # the one before had deleted it by the time we had it


def _opened(path: Path) -> int:
    """The file, made if it is not there.

    Raises:
        BadInput: There is something that surfkit has not made: a link, a folder, a file with anything else in it.
    """
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | NO_FOLLOW_FLAGS, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise _foreign(path) from error
        raise
    if not stat.S_ISREG(os.fstat(file).st_mode) or not _is_ours(os.pread(file, MAX_LOCK_BYTES + 1, 0)):
        os.close(file)
        raise _foreign(path)
    return file


def _is_ours(content: bytes) -> bool:
    """Whether a file holds what `_lock` writes, or nothing: a process died before it had written."""
    if not content:
        return True
    try:
        said = from_json(content.decode())
    except ValueError:  # BadInput, bytes that are no UTF-8
        return False
    return isinstance(said, dict) and said.keys() == {"pid", "host"}


def _foreign(path: Path) -> BadInput:
    return BadInput(f"{path}: not a file that surfkit made, where it keeps its lock; move it away")


def _in_use(folder: Path, holder: str) -> BadInput:
    return BadInput(f"{folder}: {holder} works in it; wait for its end or stop it, or name another folder")


def _is_at(file: int, path: Path) -> bool:
    """Whether an open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(file), os.lstat(path))
    except FileNotFoundError:
        return False


def _named(path: Path) -> str:
    try:
        said = read_json(path, dict[str, Any])
        return f"process {int(said['pid'])} on {said['host']}"
    except (ValueError, KeyError, TypeError, OverflowError):
        return "another process"
