"""Folders of finished parts."""

import pytest

from surfkit.core.check import BadInput
from surfkit.core.stages import UNFINISHED_FILE, kept_parts


def test_parts_stay_until_the_work_is_done(tmp_path):
    folder = tmp_path / "work"
    with pytest.raises(KeyboardInterrupt), kept_parts(folder, "a"):
        (folder / "part").write_text("1")
        (folder / ".surfkit-part.7.part").write_text("half")
        raise KeyboardInterrupt
    with kept_parts(folder, "a"):
        assert sorted(path.name for path in folder.iterdir()) == ["part", UNFINISHED_FILE]
    assert not folder.exists()


@pytest.mark.parametrize("record", [None, "{"])
def test_parts_of_something_else_are_deleted_and_it_is_said(tmp_path, monkeypatch, record):
    said = []
    monkeypatch.setattr("surfkit.core.stages.emit", said.append)
    with pytest.raises(KeyboardInterrupt), kept_parts(tmp_path, "a"):
        (tmp_path / "folder").mkdir()
        (tmp_path / "folder" / "part").write_text("1")
        raise KeyboardInterrupt
    if record is not None:
        (tmp_path / UNFINISHED_FILE).write_text(record)
    with kept_parts(tmp_path, "b" if record is None else "a"):
        assert [path.name for path in tmp_path.iterdir()] == [UNFINISHED_FILE]
    assert len(said) == 1 and "begun anew" in said[0].text


def test_an_interruption_at_the_beginning_or_at_the_end_stops_nothing(tmp_path):
    (tmp_path / f".surfkit-{UNFINISHED_FILE}.1-2.part").write_text("{")
    with pytest.raises(BadInput, match="wrong"), kept_parts(tmp_path, "a"):
        raise BadInput("wrong")
    assert not tmp_path.exists(), "nothing to go on with"
    tmp_path.mkdir()
    (tmp_path / UNFINISHED_FILE).write_text("{}")
    with kept_parts(tmp_path, "a"):
        pass
    assert not tmp_path.exists()


def test_files_of_somebody_else_are_left_alone(tmp_path):
    (tmp_path / "novel.txt").write_text("chapter 1")
    with pytest.raises(BadInput, match="not surfkit's"), kept_parts(tmp_path, "a"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["novel.txt"]
