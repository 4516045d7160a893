"""The check of executors, with jobs that take no time."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from surfkit.runs.execute.base import Executor, Job

QUIET_S = 0.5
"""For so long nothing may be heard of a job that was stopped."""
BEAT = "import pathlib, time\nwhile True:\n    pathlib.Path({!r}).touch()\n    time.sleep(0.05)"


def check_executor(executor: Executor, folder: Path | None = None) -> None:
    """An executor does every job once, tells how each ended, goes on after one that fails, and leaves nothing running
    when it is left early.

    Args:
        executor: To check.
        folder: For the files of the jobs; where all machines of the executor see it. A temporary one if None.

    Raises:
        BadInput: The executor cannot work on this machine.
    """
    name, count = type(executor).__name__, executor.at_once
    counted = count is None or (isinstance(count, int) and count >= 1)
    assert counted, f"{name}.at_once is {count!r}; it must be None or a whole number of 1 or more"
    executor.ready()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place:  # a job that was left may write there
        _check_all_done(name, executor, Path(folder or place) / "done")
        _check_leaving(name, executor, Path(folder or place) / "left")


def _check_all_done(name: str, executor: Executor, folder: Path) -> None:
    statuses, jobs = {0: 0, 1: 3, 2: 0}, []
    for index, status in statuses.items():
        jobs.append(_job(folder, index, f"raise SystemExit({status})", status))
    ended: list[int] = []
    for result in executor.run(jobs):
        index, told = result.job.index, result.status
        assert index in statuses and index not in ended, (
            f"{name} tells of job {index} twice, or of one that is not there"
        )
        ended.append(index)
        done = (jobs[index].folder / "began").exists()
        assert done, f"{name} says that job {index} has ended, which was not begun"
        assert told == statuses[index], f"{name}: job {index} ended with status {statuses[index]}; it tells {told}"
    lost = sorted(set(statuses) - set(ended))
    assert not lost, f"{name} does not tell of job {lost[0]}"


def _check_leaving(name: str, executor: Executor, folder: Path) -> None:
    """After the first of two jobs has ended, the other one is stopped, or never begun."""
    beat = folder / "01" / "beat"
    quick = _job(folder, 0, "pass", 0, cost=2.0)
    endless = _job(folder, 1, BEAT.format(str(beat)), 0)
    running = executor.run([quick, endless])
    first = next(iter(running))
    assert first.job.index == 0, f"{name} tells that an endless job has ended"
    close = getattr(running, "close", None)
    assert close is not None, f"{name}.run gives no generator, so it cannot be left early"
    close()
    beat.unlink(missing_ok=True)
    until = time.monotonic() + QUIET_S
    while (left := until - time.monotonic()) > 0 and not beat.exists():
        time.sleep(min(left, 0.05))
    assert not beat.exists(), f"{name} leaves a job running when it is left early; stop it in a `finally`"


def _job(folder: Path, index: int, code: str, status: int, cost: float = 1.0) -> Job:
    place = folder / f"{index:02}"
    place.mkdir(parents=True)
    began = f"import pathlib\npathlib.Path({str(place / 'began')!r}).touch()\n"

    def call() -> int:
        (place / "began").touch()
        return status

    return Job(index, place, call, ("-c", began + code), cost)
