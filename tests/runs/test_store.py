"""The store of finished stages: whole entries or none."""

import json

import pytest

from surfkit.runs import stage_cache as store_module
from surfkit.runs.stage_cache import ENTRY_RECORD, StageCache

NAMES = ["events.jsonl", "pretrain/checkpoint.safetensors"]


@pytest.fixture
def run(tmp_path):
    out = tmp_path / "run"
    (out / "pretrain").mkdir(parents=True)
    (out / "events.jsonl").write_text("{}\n")
    (out / "pretrain" / "checkpoint.safetensors").write_bytes(b"state")
    return out


def test_what_is_put_is_found_and_taken(run, tmp_path):
    store, other = StageCache(tmp_path / "stages"), tmp_path / "other"
    assert store.find("k1") is None
    store.put("k1", run, NAMES)
    store.find("k1").take(other)
    assert list(store.find("k1").files) == NAMES, "in the order in which they are taken"
    for name in NAMES:
        assert (other / name).read_bytes() == (run / name).read_bytes()
    assert not list(tmp_path.rglob(".*"))


def test_states_are_linked_and_journals_are_copied(run, tmp_path):
    store, other = StageCache(tmp_path / "stages"), tmp_path / "other"
    store.put("k1", run, NAMES)
    store.find("k1").take(other)
    assert (other / NAMES[1]).samefile(run / NAMES[1]) and not (other / NAMES[0]).samefile(run / NAMES[0])
    with (other / NAMES[0]).open("a") as file:
        file.write("more\n")
    assert store.find("k1") is not None and (run / NAMES[0]).read_text() == "{}\n"
    store.find("k1").take(other)  # once more, over links to the same files
    assert (other / NAMES[0]).read_text() == "{}\n" and not list(other.rglob(".*"))


def test_files_are_copied_where_there_are_no_links(run, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(store_module.os, "link", refuse)
    store, other = StageCache(tmp_path / "stages"), tmp_path / "other"
    store.put("k1", run, NAMES)
    store.find("k1").take(other)
    assert (other / NAMES[1]).read_bytes() == b"state" and not (other / NAMES[1]).samefile(run / NAMES[1])


@pytest.mark.parametrize("damage", ["byte", "file", "record"])
def test_a_damaged_entry_is_deleted_with_a_warning(run, tmp_path, warned, damage):
    store = StageCache(tmp_path / "stages")
    store.put("k1", run, NAMES)
    home = tmp_path / "stages" / "k1"
    if damage == "byte":
        (home / NAMES[1]).write_bytes(b"stale")
    else:
        (home / (NAMES[1] if damage == "file" else ENTRY_RECORD)).unlink()
    assert store.find("k1") is None and not home.exists()
    assert len(warned) == 1 and warned[0].startswith("a stored stage is damaged and is computed again: ")


def test_what_a_dead_process_left_is_never_an_entry(run, tmp_path):
    store = StageCache(tmp_path / "stages")
    left = tmp_path / "stages" / ".surfkit-k1.77.part"
    left.mkdir(parents=True)
    (left / ENTRY_RECORD).write_text(json.dumps({}))
    assert store.find("k1") is None
    store.sweep()
    assert not left.exists()


def test_the_first_of_two_processes_stays(run, tmp_path, monkeypatch):
    store, rename = StageCache(tmp_path / "stages"), store_module.os.rename

    def late(part, home):
        monkeypatch.setattr(store_module.os, "rename", rename)
        (run / NAMES[1]).unlink()
        (run / NAMES[1]).write_bytes(b"other")
        store.put("k1", run, NAMES)  # another process, which is faster
        rename(part, home)

    monkeypatch.setattr(store_module.os, "rename", late)
    store.put("k1", run, NAMES)
    assert (tmp_path / "stages" / "k1" / NAMES[1]).read_bytes() == b"other"
    assert [path.name for path in (tmp_path / "stages").iterdir()] == ["k1"]
