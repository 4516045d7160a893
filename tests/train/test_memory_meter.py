"""What the memory of a run is taken by: parts that add up to the peak, of each stage on its own."""

import mmap

import pytest
from listening import listening

from surfkit.core import memory
from surfkit.core.events import MemoryTaken
from surfkit.core.memory import peak_memory_bytes, reset_peak_memory
from surfkit.runs.run_notes import RunNotes
from surfkit.train.memory_meter import MemoryMeter

LARGE = 300_000_000


def hold(count: int) -> None:
    """Hold as many bytes for a moment, new ones: memory that was freed before may still count as held."""
    with mmap.mmap(-1, count) as held:
        held[:: mmap.PAGESIZE] = b"1" * -(-count // mmap.PAGESIZE)


@pytest.fixture
def heard():
    """The memory that was told of."""
    with listening(MemoryTaken) as events:
        yield events


@pytest.fixture
def resettable():
    reset_peak_memory()
    if memory._passed:
        pytest.skip(f"{memory.CLEAR} cannot be written here, so the peak of a process never falls")


def test_each_stage_has_its_own_peak_and_the_run_the_highest(resettable, heard):
    whole = MemoryMeter()
    begun = peak_memory_bytes()
    whole.tell()
    hold(LARGE)
    part = MemoryMeter.of_stage()
    assert peak_memory_bytes() < begun + 0.2 * LARGE
    with part.adding("pictures"):
        hold(LARGE // 10)
    part.tell()
    whole.tell()
    before, between, *after = [event.parts for event in heard]
    assert between["peak"] > begun + 0.9 * LARGE > max(each["peak"] for each in (before, *after))
    for parts in (before, *after):
        assert sum(parts.values()) == 2 * parts["peak"] and min(parts.values()) >= 0
    assert 0.05 * LARGE < after[0]["pictures"] < 0.2 * LARGE
    notes = RunNotes()
    for event in heard:
        notes.surfkit_event(event)
    assert notes.memory == between
    notes.surfkit_event(MemoryTaken({"peak": between["peak"], "program": 1, "steps": between["peak"] - 1}))
    notes.surfkit_event(MemoryTaken(between))
    assert len(notes.memory) == 3, "of equal peaks, the one with more parts"


def test_parts_of_an_earlier_stage_leave_no_part_below_zero(resettable):
    meter = MemoryMeter()
    meter.parts["points"] = 10**12
    report = meter.report()
    assert sum(report.values()) == 2 * report["peak"] and min(report.values()) == 0 < report["points"]


def test_nothing_is_told_of_a_peak_that_is_not_known(monkeypatch, tmp_path, heard):
    monkeypatch.setattr(memory, "CLEAR", tmp_path / "none" / "clear_refs")
    monkeypatch.setattr(memory, "_passed", 0)
    hold(LARGE)
    meter = MemoryMeter()
    meter.tell()
    MemoryMeter.of_stage()
    assert meter.report() == {} and not heard
