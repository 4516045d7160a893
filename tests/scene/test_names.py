"""Photographs that a data set calls otherwise than their files."""

from pathlib import PurePath

from surfkit.scene.names import find_files


def test_names_without_endings_are_found_in_time_that_grows_with_their_number(tmp_path, monkeypatch):
    count, compared = 300, []
    names = [f"IMG {at}" for at in range(count)]
    for name in names:
        (tmp_path / f"{name}.JPG").touch()
    plain = PurePath.__eq__
    monkeypatch.setattr(PurePath, "__eq__", lambda self, other: compared.append(0) or plain(self, other))
    found = find_files(tmp_path, names)
    monkeypatch.undo()
    assert found == {name: tmp_path / f"{name}.JPG" for name in names}
    assert len(compared) < 20 * count
