"""Signs of life of a block, and who keeps away from it because of them."""

import os
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from two_blocks import EVERY, same

from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.runs.blocks import train_blocks as schedule
from surfkit.runs.blocks import worker
from surfkit.runs.blocks.block import BlockRun, read_plan
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.blocks.worker import heartbeats
from surfkit.runs.execute.base import Job, JobResult
from surfkit.runs.execute.block_state import STALE_S, read_state, write_state
from surfkit.runs.execute.remote import DRIVER
from surfkit.runs.pipeline import opened, run

LATER_S = 3600.0
"""From now, when a worker elsewhere is heard of: however long a test takes, that is not long ago."""


@pytest.fixture
def block(undisturbed, tmp_path) -> BlockRun:
    """A block of a run, in a folder of its own."""
    loaded = opened(undisturbed)
    return BlockRun(replace(loaded, out=tmp_path), read_plan(loaded).plan, 0)


def test_heartbeats_while_no_step_is_made(block, monkeypatch):
    monkeypatch.setattr(worker, "HEARTBEAT_S", 0.0)
    block.write(status="running", step=3, heard=0.0)
    began = time.time()
    with heartbeats(block):
        while not read_state(block.folder).heard:
            time.sleep(0.02)
        state = read_state(block.folder)
    assert state.heard >= began and (state.status, state.step) == ("running", 3)


def test_a_driver_that_goes_while_no_step_is_made(block, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setenv(DRIVER, str(os.getppid()))
    with pytest.raises(KeyboardInterrupt), heartbeats(block):
        monkeypatch.setattr(os, "getppid", lambda: -1)
        while True:
            time.sleep(3600)
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.fixture
def elsewhere(undisturbed, tmp_path):
    """A run whose first block was heard of on another machine, and how to say when."""
    shutil.copytree(undisturbed, tmp_path / "run")

    def heard(seconds_ago: float) -> Path:
        write_state(
            tmp_path / "run" / "blocks" / "000",
            read_state(tmp_path / "run" / "blocks" / "000"),
            status="running",
            host="far",
            pid=7,
            heard=time.time() - seconds_ago,
        )
        return tmp_path / "run"

    return heard


def test_a_block_that_is_worked_on_elsewhere_is_left_alone(elsewhere, capsys):
    folder = elsewhere(-LATER_S)
    assert main(["train-block", str(folder), "0"]) == worker.BUSY_STATUS
    assert (
        "process 7 on far sent a heartbeat" in capsys.readouterr().err
        and read_state(folder / "blocks/000").host == "far"
    )
    elsewhere(STALE_S - 3)
    assert main(["train-block", str(folder), "0", "--patience", "60"]) == 0
    assert read_state(folder / "blocks" / "000").host != "far"


def test_a_worker_that_is_cut_off_is_not_declared_dead(elsewhere):
    """Its heartbeats would otherwise be those of a block that no process trains."""
    lost = JobResult(Job(0, Path(), lambda: 0, ()), 70, "its machine is gone")
    for seconds, status in ((-LATER_S, "running"), (STALE_S, "failed")):
        folder = elsewhere(seconds)
        loaded = opened(folder)
        assert (
            schedule.record_failure(BlockRun(loaded, read_plan(loaded).plan, 0), lost) == "failed: its machine is gone"
        )
        assert read_state(folder / "blocks" / "000").status == status


def test_a_worker_elsewhere_that_falls_silent_is_waited_for_no_more(elsewhere, monkeypatch):
    """Also where that shows between two looks at it, after longer than a process of this machine is waited for."""
    loaded, find, looks, now = opened(elsewhere(-LATER_S)), schedule.find_remote_worker, [], [0.0]

    def heard_until_now(place):
        looks.append(place)
        if len(looks) == 2:
            elsewhere(STALE_S + 1)
            now[0] += 2 * schedule.WORKER_EXIT_S
        return find(place)

    monkeypatch.setattr(schedule, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=lambda seconds: None))
    monkeypatch.setattr(schedule, "find_remote_worker", heard_until_now)
    schedule.await_workers(loaded)
    assert len(looks) == 2


def test_a_driver_waits_until_it_is_sure(elsewhere, undisturbed, data, recipe, monkeypatch):
    monkeypatch.setattr(schedule, "WORKER_EXIT_S", 0.2)
    folder = elsewhere(STALE_S - 3)
    run(recipe, data, folder, Compute("cpu"), EVERY)
    assert same(folder, undisturbed)
    elsewhere(-LATER_S)
    monkeypatch.setattr(schedule, "STALE_S", 0.2)
    (folder / "tune" / "checkpoint.safetensors").unlink()
    with pytest.raises(BadInput, match="000: process 7 on far"):
        run(recipe, data, folder, Compute("cpu"), EVERY)
