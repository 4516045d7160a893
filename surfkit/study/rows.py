"""One row of an ablation table with one seed: run in this process, or by any executor in another one."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json, write_json, write_text
from surfkit.core.lock import lock_holder
from surfkit.core.signals import terminable
from surfkit.io.datasets.data import Data
from surfkit.raster.select import Device
from surfkit.runs import pipeline
from surfkit.runs.blocks.train_blocks import WORKER_EXIT_S, Compute
from surfkit.runs.execute.base import LOG, Executor, Job, JobResult
from surfkit.runs.execute.remote import CHILD_POLL_S, DRIVER, INTERRUPTED_STATUS
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_notes import collect_notes
from surfkit.runs.run_stage import CHECKPOINT_EVERY, Intervals
from surfkit.runs.stage_cache import StageCache
from surfkit.study.perceptual import measure_lpips
from surfkit.study.row_comparison import figures
from surfkit.study.truth import Truth
from surfkit.train.data_cache import CacheSettings
from surfkit.train.progress_bars import bars

TRACEBACK_FILE = "failed.txt"
"""Where a run that failed in an unforeseen way leaves its traceback."""
ROW_FILE, OUTCOME_FILE = "row.json", "outcome.json"
"""In the folder of a run that another process makes: what it is to do, and what came out."""


@dataclass(frozen=True)
class Trial:
    """One row with one seed on one data set, and the folder of its run, which rows with the same recipe share.

    Attributes:
        truth: What its mesh is compared with, if anything.
    """

    label: str
    seed: int
    recipe: Recipe
    folder: Path
    data: Data
    truth: Truth | None = None


@dataclass(frozen=True)
class TrialJob:
    """All that a process needs to know to run a trial.

    Attributes:
        trial: What to run.
        device: Where to compute.
        store: Folder of finished stages that the rows share; None shares none.
        cache: Memory for photographs, see `CacheSettings`.
        lpips: Whether LPIPS is measured.
        checkpoint_every: Steps between checkpoints.
    """

    trial: Trial
    device: Device = "auto"
    store: Path | None = None
    cache: str = "auto"
    lpips: bool = False
    checkpoint_every: int = CHECKPOINT_EVERY


@dataclass(frozen=True)
class TrialResult:
    """What a run came to: numbers, the reason in one line why it failed, or both where only its mesh did."""

    figures: dict[str, int | float] | None = None
    failed: str | None = None


def finished(trial: Trial) -> dict[str, int | float] | None:
    """The numbers of a run that is over: its metrics are written last, and deleted when it is trained further."""
    path, compressed = trial.folder / "metrics.json", trial.recipe.compress is not None
    if not path.exists():
        return None
    metrics = read_json(path, dict[str, Any])
    if trial.truth is None or not trial.truth.known(metrics, compressed):  # of another truth
        for known in (metrics, metrics.get("compressed") or {}):
            known.pop("geometry", None)
    try:
        return figures(metrics, compressed)
    except BadInput as error:
        raise BadInput(f"{path}: {error}; delete it, and the row is measured again") from error


def attempt(work: TrialJob) -> TrialResult:
    """Run one recipe, or go on with it; what goes wrong becomes its outcome."""
    trial = work.trial
    trace, found = trial.folder / TRACEBACK_FILE, finished(trial)
    try:
        if found is None:
            found = figures(train(work), trial.recipe.compress is not None)
        with collect_notes(), bars():
            found = measured(work, found)
    except (BadInput, Fault) as error:
        return TrialResult(found, " ".join(str(error).split()))
    except Exception as error:
        write_text(trace, traceback.format_exc())
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return TrialResult(found, f"{reason[:200]}; see {trace}")
    trace.unlink(missing_ok=True)
    return TrialResult(found)


def train(work: TrialJob) -> dict[str, Any]:
    """The metrics of a run, which is made or gone on with."""
    trial = work.trial
    await_worker(trial.folder)
    store = None if work.store is None else StageCache(work.store)
    gc.collect()  # else what the row before has left would count as memory of this one
    compute, caches = Compute(work.device), CacheSettings(work.cache)
    intervals = Intervals(work.checkpoint_every)
    return pipeline.run(
        trial.recipe, trial.data, trial.folder, compute, intervals=intervals, caches=caches, store=store
    )


def measured(work: TrialJob, found: dict[str, int | float]) -> dict[str, int | float]:
    """The numbers of a finished run, with those of its mesh and LPIPS where they are wanted."""
    trial, compressed = work.trial, work.trial.recipe.compress is not None
    if trial.truth is not None and trial.truth.figure not in found:
        found = figures(trial.truth.measure(trial.folder, work.device), compressed)
    if work.lpips and "lpips" not in found and "psnr" in found:
        again = figures(measure_lpips(trial.folder, work.device), compressed)
        found |= {name: again[name] for name in ("lpips",) if name in again}
    return found


def await_worker(folder: Path) -> None:
    """Wait for a worker of an earlier command, which ends when it notices that its driver is gone."""
    until = time.monotonic() + WORKER_EXIT_S
    while lock_holder(folder) and time.monotonic() < until:
        time.sleep(CHILD_POLL_S)


def run_elsewhere(works: Sequence[TrialJob], workers: Executor) -> Generator[tuple[TrialJob, TrialResult], None, None]:
    """Each of some rows with its outcome, in the order in which they end.

    Raises:
        KeyboardInterrupt: The user asked to stop; the runs have saved their states.
    """
    share = CacheSettings().bytes() // (workers.at_once or 1)
    works = [work if workers.at_once is None else replace(work, cache=str(share)) for work in works]
    jobs = [job_of(at, work) for at, work in enumerate(works)]
    with closing(cast(Generator[JobResult, None, None], workers.run(jobs))) as results:  # see `Executor.run`
        for result in results:
            work = works[result.job.index]
            yield work, outcome_of(work, result)


def job_of(at: int, work: TrialJob) -> Job:
    """The job that runs a row in a process of its own; what it is to do is written into the folder of its run."""
    folder, recipe = work.trial.folder.resolve(), work.trial.recipe
    folder.mkdir(parents=True, exist_ok=True)
    (folder / OUTCOME_FILE).unlink(missing_ok=True)
    own = replace(work, trial=replace(work.trial, folder=folder))
    write_json(folder / ROW_FILE, own if own.store is None else replace(own, store=own.store.resolve()))
    return Job(
        index=at,
        folder=folder,
        call=lambda: main([str(folder / ROW_FILE)]),
        command=("-m", "surfkit.study.rows", str(folder / ROW_FILE)),
        cost=sum(stage.steps for _, stage, _ in recipe.stages()) if recipe.has_stages else recipe.length or 1,
        needs=(work.trial.data.path.resolve(), *([work.trial.truth.path] if work.trial.truth else [])),
    )


def outcome_of(work: TrialJob, result: JobResult) -> TrialResult:
    """What the process of a row has written, or else how it ended."""
    path = work.trial.folder / OUTCOME_FILE
    if path.exists():
        return read_json(path, TrialResult)
    if result.why is not None:
        return TrialResult(failed=result.why)
    status = result.status
    ended = f"ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
    memory = " while memory ran out" * (result.kind == "oom")
    return TrialResult(failed=f"its process {ended}{memory}; see {work.trial.folder / LOG}")


def main(words: Sequence[str]) -> int:
    """Run the row that a file describes, write its outcome beside the file, and return the exit status."""
    path = Path(words[0])
    try:
        with stop_with_driver(int(os.environ.get(DRIVER, 0))):
            outcome = attempt(read_json(path, TrialJob))
    except KeyboardInterrupt:
        return INTERRUPTED_STATUS
    write_json(path.with_name(OUTCOME_FILE), outcome)
    return 0


@contextmanager
def stop_with_driver(driver: int) -> Iterator[None]:
    """Within, this process is asked to stop when the one that started it is gone, and SIGTERM acts like Ctrl-C.

    Args:
        driver: Number of that process; 0 for none.
    """
    over = threading.Event()

    def watch() -> None:
        while not over.wait(CHILD_POLL_S):
            if os.getppid() != driver:
                os.kill(os.getpid(), signal.SIGTERM)
                return

    thread = threading.Thread(target=watch, daemon=True)
    with terminable():
        if driver:
            thread.start()
        try:
            yield
        finally:
            over.set()
            if driver:
                thread.join()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
