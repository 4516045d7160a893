"""Blocks as jobs of Slurm, by submitit."""

from __future__ import annotations

import math
import os
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.core.optional import needed
from surfkit.core.signals import terminable
from surfkit.runs.execute.base import Executor, Job, JobResult, sort_by_cost
from surfkit.runs.execute.block_state import Kind, find_worker
from surfkit.runs.execute.remote import CHILD_POLL_S, CRASHED_STATUS, RemoteJob
from surfkit.runs.execute.shared_filesystem import mark_folder, remote_job

SLURM_POLL_S = 1.0
SQUEUE = ("squeue", "--noheader", "--array", "--states=all", "--format=%i %T %r")
"""States and reasons of jobs, also of those that are over."""
QUIET_REASONS = ("None", "Priority", "Resources", "BeginTime")
"""Reasons to wait that are not printed."""
JOBS = "jobs"
"""Folder of what submitit writes, beside the folders of the blocks."""
QUERY_INTERVAL_S = 30.0
"""Seconds between two queries of Slurm."""
JOB_HOLD_S, CANCEL_TIMEOUT_S = 120.0, 60.0
"""How long a job that was asked to end waits until Slurm ends it, and how long we wait for those that we cancelled."""
RESULT_ARRIVAL_S = 90.0
"""How long after its end the result of a job may take to be seen here."""
ALIVE_STATES: tuple[str, ...] = (
    "PENDING",
    "CONFIGURING",
    "RUNNING",
    "SUSPENDED",
    "COMPLETING",
    "REQUEUED",
    "REQUEUE_HOLD",
    "REQUEUE_FED",
)
ALIVE_STATES += ("RESIZING", "SIGNALING", "STAGE_OUT", "STOPPED", "SPECIAL_EXIT", "PREEMPTED")
"""States of jobs that may still come to a result."""

FAILURE_KINDS: dict[tuple[str, ...], Kind] = {
    ("OUT_OF_MEMORY",): "oom",
    ("NODE_FAIL", "BOOT_FAIL", "gone"): "lost",
    ("CANCELLED",): "interrupted",
}
"""States of jobs that have left no result, and the kinds of failure that they mean."""


@dataclass(frozen=True)
class Slurm(Executor):
    """Blocks as jobs of Slurm, the largest first; or, without Slurm, as processes that submitit starts here.

    All nodes must see run folder and data set at the same paths. A job that nears its time limit or is preempted saves
    the state of its block and is queued again. On Ctrl-C, jobs are cancelled and the running ones save their states; if
    the driver is killed, they go on to their end. Needs `pip install 'surfkit[slurm]'`.
    """

    cluster: Literal["slurm", "local", "debug"] = "slurm"
    """Where jobs run: slurm; local starts processes on this machine; debug runs one block after the other."""

    partition: str = ""
    """Slurm partition to submit to; its default if left out."""

    account: str = ""
    """Slurm account to charge; your default if left out."""

    hours: float = 24.0
    """Time limit of each job. One that has not finished by then is queued again."""

    requeues: int = 10
    """How often a job may reach its time limit and be queued again."""

    cpus: int = 8
    """CPU cores of each job."""

    gpus: int = 0
    """GPUs of each job, 0 or 1. With 0 a job sees none."""

    memory_gb: float = 0.0
    """Memory of each job; 0 takes what the largest block is expected to need."""

    parallel: int = 0
    """Jobs at a time; 0 leaves it to Slurm, and is 1 for local."""

    extra: tuple[str, ...] = ()
    """More options of sbatch, as NAME=VALUE or NAME: `qos=long constraint=a100 exclusive`."""

    def __post_init__(self) -> None:
        if self.hours <= 0 or self.cpus < 1:
            raise BadInput(f"slurm.hours {self.hours:g}, cpus {self.cpus}: give more than 0, 1 or more")
        if min(self.requeues, self.memory_gb, self.parallel) < 0:
            given = f"requeues {self.requeues}, memory_gb {self.memory_gb:g}, parallel {self.parallel}"
            raise BadInput(f"slurm: {given}: each must be 0 or more")
        if self.gpus not in (0, 1):
            raise BadInput(f"slurm.gpus is {self.gpus}; a block uses one at most, so give 0 or 1")
        for option in self.extra:
            if not re.fullmatch(r"[a-z][a-z-]*(=[^\n]+)?", option):
                raise BadInput(f"slurm.extra {option!r}: give NAME=VALUE or NAME, without dashes before it")

    @property
    def at_once(self) -> int | None:
        """See `Executor.at_once`."""
        return None if self.cluster == "slurm" else self._limit

    @property
    def _limit(self) -> int:
        """Jobs submitted at a time, where Slurm does not limit them."""
        return 1 if self.cluster == "debug" else max(1, self.parallel)

    def ready(self) -> None:
        """See `Executor.ready`."""
        _imported()
        if self.cluster == "slurm" and not (shutil.which("sbatch") and shutil.which("srun")):
            raise BadInput(
                "executor:slurm: sbatch is not on this machine; start surfkit on a login node of the cluster, or give "
                "--executor.cluster local"
            )

    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """See `Executor.run`."""
        self.ready()
        waiting, queue = sort_by_cost(jobs), Queue(self.cluster)
        with terminable(), mark_folder(jobs) as mark:
            executor = self._submitter(mark.parent / JOBS, jobs)
            try:
                while waiting or queue.jobs:
                    room = len(waiting) if self.cluster == "slurm" else self._limit - len(queue.jobs)
                    if batch := waiting[:room]:
                        del waiting[:room]
                        queue.submit(executor, batch, [self._remote_job(job, mark) for job in batch])
                    yield from queue.ended()
                    time.sleep(CHILD_POLL_S if self.cluster != "slurm" else SLURM_POLL_S)
            finally:
                queue.cancel()

    def _remote_job(self, job: Job, mark: Path) -> RemoteJob:
        if self.cluster == "slurm":
            return replace(remote_job(job, mark, self.cpus, self.gpus > 0), hold_s=JOB_HOLD_S)
        return remote_job(job, mark, min(self.cpus, max(1, len(os.sched_getaffinity(0)) // self._limit)), self.gpus > 0)

    def _submitter(self, folder: Path, jobs: Sequence[Job]) -> Any:
        """What submits the jobs."""
        submitit = _imported()
        memory = self.memory_gb or math.ceil(max(job.memory_bytes for job in jobs) / 1e9)
        options = (option.partition("=") for option in self.extra)
        more = {name: value if equals else True for name, equals, value in options}
        given = submitit.AutoExecutor(folder, self.cluster, slurm_max_num_timeout=self.requeues)
        given.update_parameters(
            name=f"surfkit-{folder.parent.parent.name}",
            timeout_min=math.ceil(60 * self.hours),
            cpus_per_task=self.cpus,
            gpus_per_node=self.gpus,
            mem_gb=memory or None,
            slurm_partition=self.partition or None,
            slurm_account=self.account or None,
            slurm_array_parallelism=self.parallel or len(jobs),
            slurm_additional_parameters={"requeue": True, **more},
        )
        return given


@contextmanager
def _interruptible() -> Iterator[None]:
    """Within, started processes receive Ctrl-C, by which submitit cancels them on this machine.

    A process that a shell has started in the background ignores Ctrl-C, and so would the processes that it starts.
    """
    before = signal.getsignal(signal.SIGINT)
    ignored = before is signal.SIG_IGN and threading.current_thread() is threading.main_thread()
    if ignored:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        if ignored:
            signal.signal(signal.SIGINT, before)


@dataclass
class Queue:
    """Jobs that were submitted, and the block of each.

    Attributes:
        cluster: Whose.
        jobs: By submitit's handles.
        states: What each was last heard to be and why, and since when, in seconds of the monotonic clock.
        asked: When Slurm was last asked.
    """

    cluster: str
    jobs: dict[Any, Job] = field(default_factory=dict)
    states: dict[Any, tuple[str, float]] = field(default_factory=dict)
    asked: float = -math.inf

    def submit(self, executor: Any, batch: Sequence[Job], remote_jobs: Sequence[RemoteJob]) -> None:
        """Submit some jobs; to Slurm, as one array."""
        submitit = _imported()
        try:
            with _interruptible(), executor.batch():
                handles = [executor.submit(what) for what in remote_jobs]
        except (submitit.core.utils.FailedJobError, submitit.core.utils.FailedSubmissionError) as error:
            reason = " ".join(str(error).split())
            raise BadInput(f"executor:slurm: Slurm does not take the jobs: {reason}") from error
        self.jobs |= dict(zip(handles, batch, strict=True))
        for handle, job in zip(handles, batch, strict=True):
            say(f"block {job.index}: job {handle.job_id}")

    def ended(self) -> Iterator[JobResult]:
        """The results of the jobs that have ended since the last call."""
        if self.cluster == "slurm":
            self.ask()
        for handle, job in list(self.jobs.items()):
            state, since = self.states.get(handle, ("", math.inf))
            if handle.paths.result_pickle.exists() if self.cluster == "slurm" else handle.done():
                del self.jobs[handle]
                yield _ended(handle, job)
            elif state and state.split()[0] not in ALIVE_STATES and time.monotonic() - since > RESULT_ARRIVAL_S:
                del self.jobs[handle]
                why = f"job {handle.job_id} is {state} in Slurm and has left no result; see {handle.paths.stderr}"
                cancelled = state.startswith("CANCELLED")  # by a person, so it is not tried again
                yield JobResult(job, 1 if cancelled else CRASHED_STATUS, why, _kind_of(state))

    def ask(self) -> None:
        """Ask Slurm for the states of the jobs; with squeue, as not every cluster keeps accounts of past jobs."""
        if time.monotonic() - self.asked < QUERY_INTERVAL_S:
            return
        self.asked = time.monotonic()
        answer = subprocess.run([*SQUEUE, "--me"], capture_output=True, text=True)
        if answer.returncode:  # the controller does not answer now
            return
        found = dict(line.split(maxsplit=1) for line in answer.stdout.splitlines())
        for handle, job in self.jobs.items():
            state, _, reason = found.get(handle.job_id, "gone").partition(" ")
            state += f" ({reason})" if reason and reason not in QUIET_REASONS else ""
            if state != self.states.get(handle, ("", 0.0))[0]:
                self.states[handle] = state, self.asked
                say(f"block {job.index}: job {handle.job_id} is {state}")

    def cancel(self) -> None:
        """Cancel every job, and wait until none trains a block any more."""
        if self.jobs:
            say(f"{len(self.jobs)} jobs are cancelled; the same command goes on with their blocks")
        for handle in self.jobs:
            handle.cancel(check=False)
        until = time.monotonic() + CANCEL_TIMEOUT_S
        while time.monotonic() < until and any(find_worker(job.folder) for job in self.jobs.values()):
            time.sleep(CHILD_POLL_S)
        self.jobs.clear()


def _imported() -> ModuleType:
    with needed("submitit", "executor:slurm"):
        import submitit
    return submitit


def _ended(handle: Any, job: Job) -> JobResult:
    """The result of a job that has ended."""
    error = handle.exception()
    if error is None:
        found = handle.result()
        return JobResult(job, found.status, found.why, found.kind)
    lines = [line for line in str(error).splitlines() if line.strip(" -")]
    last = next((line for line in reversed(lines) if "Error" in line), lines[0] if lines else "no log")
    why = f"job {handle.job_id} came to no result: {last.strip()}; see {handle.paths.stderr}"
    return JobResult(job, CRASHED_STATUS, why, _kind_of(handle.state))


def _kind_of(state: str) -> Kind:
    """The kind of failure that a state of a Slurm job without a result means."""
    for words, kind in FAILURE_KINDS.items():
        if state.startswith(words):
            return kind
    return "crash"
