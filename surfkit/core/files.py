"""Files that are whole or not there, also when the process dies or the power fails."""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

FILE_PREFIX = ".surfkit-"
"""What names of files begin with that are surely ours, in folders that hold files of others too."""
UNFINISHED_PATTERN = f"{FILE_PREFIX}*.part"
"""Names of files and folders that are being written."""
DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""Errors of a disk that has no room."""


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A new file that takes the place of `path` when all went well, and vanishes when not.

    Processes and threads may write the same file at the same time: the last one stays.
    """
    path = Path(path)
    refuse_special(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = being_written(path)
    try:
        unfinished.unlink(missing_ok=True)  # of a dead process that had our number
        with unfinished.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
        sync_folder(path.parent)
    except OSError as error:
        if error.errno in DISK_FULL and error.filename is None:  # writing does not say to which file
            error.filename = str(path)
        raise
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """An empty folder that takes the place of `path` and its content when all went well, and vanishes when not."""
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise OSError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished, former = being_written(path), being_written(path.with_name(f"{path.name}.old"))
    try:
        unfinished.mkdir()
        yield unfinished
        if path.exists():
            os.replace(path, former)
        os.replace(unfinished, path)
        sync_folder(path.parent)
    finally:
        if former.exists() and not path.exists():  # the second renaming failed
            os.replace(former, path)
        for folder in (unfinished, former):
            remove(folder)


def being_written(path: Path) -> Path:
    """Where this thread writes what is to take the place of a file or folder; `sweep` deletes what is left of it."""
    return path.with_name(f"{FILE_PREFIX}{path.name}.{os.getpid()}-{threading.get_native_id()}.part")


def remove(path: Path) -> None:
    """Delete a file, or a folder with all in it, if it is there; of a link, only the link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def refuse_own(folder: Path) -> None:
    """OSError if a folder is the one that this process works in, or around it: another one cannot take its place."""
    if folder.is_dir() and Path.cwd().is_relative_to(folder.resolve()):
        raise OSError(errno.EBUSY, "the folder that you are in, which cannot be replaced; name another", str(folder))


def refuse_special(path: Path) -> None:
    """OSError if something else than a file has the name, such as a device: root would replace it for the machine."""
    if path.is_dir():
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if (path.exists() and not path.is_file()) or path.parent == Path("/dev"):
        raise OSError(errno.EINVAL, "a device or a pipe, not a file; name another", str(path))


def refuse_unwritable(folder: Path) -> None:
    """OSError if a folder cannot be made, or takes no files: asked before what is to lie in it is computed."""
    found = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not found.is_dir():
        raise OSError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(found))
    if not os.access(found, os.W_OK | os.X_OK):
        raise OSError(errno.EACCES, os.strerror(errno.EACCES), str(found))


def where_now(path: Path, folder: Path, now: Path) -> Path | None:
    """Where a path is that has moved together with a folder; None if it is still there, or has not.

    Args:
        path: That was, absolute.
        folder: As it was then, absolute.
        now: Where the folder is, absolute.
    """
    if folder == now or path.exists():
        return None
    found = Path(os.path.normpath(now / os.path.relpath(path, folder)))
    return found if found.exists() else None


def sync_folder(folder: Path) -> None:
    """Let the disk know the names in a folder, where the file system has a way to be asked."""
    with suppress(OSError):
        here = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(here)
        finally:
            os.close(here)


def sweep(folder: Path, but: Path | None = None, deep: bool = True) -> None:
    """Delete what dead processes left unfinished in a folder that no other process works in, `but` for one inside.

    `deep`: also in the folders inside, linked ones left out.
    """
    for path in list(folder.rglob(UNFINISHED_PATTERN) if deep else folder.glob(UNFINISHED_PATTERN)):
        if but is None or not path.is_relative_to(but):
            remove(path)


def delete_with_folders(path: Path, root: Path) -> None:
    """Delete a file, if it is there, and the folders around it inside of `root` that are empty then."""
    path.unlink(missing_ok=True)
    for folder in itertools.takewhile(lambda folder: folder != root, path.parents):
        try:
            folder.rmdir()
        except OSError:  # something else is in it, or it was never there
            return
