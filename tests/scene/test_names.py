"""Photographs that a data set calls otherwise than their files."""

from pathlib import PurePath

from surfkit.run.notes import collect_notes
from surfkit.scene.names import find_files


def test_names_without_endings_are_found_in_time_that_grows_with_their_number(tmp_path, monkeypatch):
    count, compared = 300, []
    names = [f"IMG {at}" for at in range(count)]
    for name in names:
        (tmp_path / f"{name}.JPG").touch()
    plain = PurePath.__eq__
    monkeypatch.setattr(PurePath, "__eq__", lambda self, other: compared.append(0) or plain(self, other))
    with collect_notes() as kept:
        found = find_files(tmp_path, names)
    monkeypatch.undo()
    assert not kept.texts, "a name without its ending is not spelt otherwise"
    assert found == {name: tmp_path / f"{name}.JPG" for name in names}
    assert len(compared) < 20 * count


def test_other_spellings_are_told_once(tmp_path):
    for name in ("a.JPG", "b.jpg", "sub/c.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with collect_notes() as kept:
        found = find_files(tmp_path, ["A.jpg", "b.jpg", "c"])
    assert found == {"A.jpg": tmp_path / "a.JPG", "b.jpg": tmp_path / "b.jpg", "c": tmp_path / "sub/c.png"}
    assert len(kept.texts) == 1 and "2 photographs in" in kept.texts[0] and "spelt otherwise" in kept.texts[0]
