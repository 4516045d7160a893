import errno
import os
import stat
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from surfkit.core.caches import cache_root
from surfkit.core.check import BadInput
from surfkit.core.files import (
    being_written,
    delete_with_folders,
    refuse_own,
    refuse_special,
    refuse_unwritable,
    replacing,
    replacing_folder,
    sweep,
)


def test_a_file_is_replaced_after_the_disk_has_it(tmp_path, monkeypatch):
    path, order = tmp_path / "a" / "b.txt", []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *args, name=name, real=real: (order.append(name), real(*args))[1])
    with replacing(path) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new" and order == ["fsync", "replace", "fsync"], "file, name, folder"


def test_two_threads_write_the_same_file(tmp_path):
    both = threading.Barrier(2)

    def write(text):
        with replacing(tmp_path / "a.txt") as file:
            file.write(text)
            both.wait()

    with ThreadPoolExecutor(2) as threads:
        list(threads.map(write, [b"one", b"two"]))
    assert (tmp_path / "a.txt").read_bytes() in (b"one", b"two")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_what_fails_leaves_the_old_and_nothing_else(tmp_path):
    path = tmp_path / "b.txt"
    path.write_text("old")
    with pytest.raises(ValueError), replacing(path) as file:  # noqa: PT011
        file.write(b"new")
        raise ValueError
    assert [p.name for p in tmp_path.iterdir()] == ["b.txt"] and path.read_text() == "old"


def test_a_full_disk_names_the_file(tmp_path):
    with pytest.raises(OSError) as error, replacing(tmp_path / "a.npy"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert error.value.filename == str(tmp_path / "a.npy") and not list(tmp_path.iterdir())


def test_what_the_dead_left_is_swept_away(tmp_path):
    for name in (
        "x/.surfkit-a.json.12.part",
        "x/a.json",
        ".surfkit-c.part",
        ".hidden",
        ".surfkit-t.9.part/.surfkit-u.9.part",
        ".surfkit-t.9.part/v",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "x" / "mine.part").mkdir()
    elsewhere = tmp_path.with_name(f"{tmp_path.name}-elsewhere")
    (elsewhere / "folder").mkdir(parents=True)
    (elsewhere / "folder" / ".surfkit-b.part").touch()
    (tmp_path / "linked").symlink_to(elsewhere)
    (tmp_path / ".surfkit-link.part").symlink_to(elsewhere / "folder")
    for name in (".c.part", "x/.a.json.12.part", "x/.tmpAb1cD2"):  # of other programs, and of users
        (tmp_path / name).touch()
    sweep(tmp_path)
    left = sorted(p.name for p in tmp_path.rglob("*"))
    assert left == [".a.json.12.part", ".c.part", ".hidden", ".tmpAb1cD2", "a.json", "linked", "mine.part", "x"]
    assert (elsewhere / "folder" / ".surfkit-b.part").exists(), "a link is not followed"


def test_folders_that_a_deleted_file_leaves_empty_go_with_it(tmp_path):
    for name in ("images/orbit.mp4/a/1.png", "images/flight/1.png", "images/flight/2.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    for name in ("images/orbit.mp4/a/1.png", "images/flight/1.png", "images/never/1.png"):
        delete_with_folders(tmp_path / name, tmp_path)
    assert sorted(map(str, (path.relative_to(tmp_path) for path in tmp_path.rglob("*")))) == [
        "images", "images/flight", "images/flight/2.png"
    ]  # fmt: skip
    delete_with_folders(tmp_path / "images/flight/2.png", tmp_path)
    assert tmp_path.is_dir() and not any(tmp_path.iterdir()), "the root stays"


def test_a_link_in_the_place_of_what_is_being_written_is_not_followed(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    being_written(tmp_path / "a.json").symlink_to(tmp_path / "mine.txt")
    with replacing(tmp_path / "a.json") as file:
        file.write(b"new")
    assert (tmp_path / "mine.txt").read_text() == "mine" and (tmp_path / "a.json").read_text() == "new"
    (tmp_path / "folder").mkdir()
    (tmp_path / "tiles").symlink_to(tmp_path / "folder")
    with replacing_folder(tmp_path / "tiles") as new:
        (new / "one").touch()
    assert not (tmp_path / "tiles").is_symlink() and not list((tmp_path / "folder").iterdir())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "folder", "mine.txt", "tiles"]


def test_a_folder_is_replaced_as_a_whole(tmp_path):
    path = tmp_path / "a" / "tiles"
    for content in ("old", "new"):
        with replacing_folder(path) as folder:
            assert not list(folder.iterdir()) and (content == "old") == (not path.exists())
            (folder / content).touch()
        assert [p.name for p in path.iterdir()] == [content]
    with pytest.raises(ValueError), replacing_folder(path) as folder:  # noqa: PT011
        (folder / "half").touch()
        raise ValueError
    assert [str(p.relative_to(tmp_path)) for p in sorted(tmp_path.rglob("*"))] == ["a", "a/tiles", "a/tiles/new"]
    with pytest.raises(NotADirectoryError), replacing_folder(path / "new"):
        pass


def test_the_old_folder_stays_if_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    (tmp_path / "tiles").mkdir()
    (tmp_path / "tiles" / "old").touch()
    real, calls = os.replace, []

    def fails_once(here, there):
        calls.append(there)
        if len(calls) == 2:
            raise OSError("no room")
        real(here, there)

    monkeypatch.setattr(os, "replace", fails_once)
    with pytest.raises(OSError, match="no room"), replacing_folder(tmp_path / "tiles"):
        pass
    assert [str(p.relative_to(tmp_path)) for p in sorted(tmp_path.rglob("*"))] == ["tiles", "tiles/old"]


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name, said in (("pipe", "a device or a pipe"), ("folder", "Is a directory")):
        with pytest.raises(OSError, match=said) as caught, replacing(tmp_path / name) as file:
            file.write(b"new")
        assert caught.value.filename == str(tmp_path / name)
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode) and len(list(tmp_path.iterdir())) == 2
    for name in ("null", "stdout", "new.png"):  # the check alone: were it wrong, writing would harm the machine
        with pytest.raises(OSError, match="a device or a pipe"):
            refuse_special(Path("/dev") / name)
    refuse_special(Path("/dev/shm/new.png"))
    refuse_special(tmp_path / "new.png")


def test_the_folder_one_is_in_is_refused(tmp_path, monkeypatch):
    (tmp_path / "out" / "here").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "out" / "here")
    for path in (Path("."), Path(".."), tmp_path / "out"):
        with pytest.raises(OSError, match="the folder that you are in"):
            refuse_own(path)
    for path in (Path("new"), Path("../there"), tmp_path / "out" / "here" / "in"):
        path.mkdir()
        refuse_own(path)
    refuse_own(Path("none"))


def test_without_a_home_folder_the_user_is_told_what_to_set(monkeypatch, tmp_path):
    for name in ("SURFKIT_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as it does for a user without a name
    with pytest.raises(BadInput, match="HOME .*SURFKIT_CACHE"):
        cache_root()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_root() == tmp_path / "surfkit"
    monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path / "own"))
    assert cache_root() == tmp_path / "own"


def test_what_cannot_be_written_is_told_before(tmp_path):
    refuse_unwritable(tmp_path / "new" / "folders")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError):
        refuse_unwritable(tmp_path / "file" / "inside")
