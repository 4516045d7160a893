"""How jobs (blocks of a run, rows of a table) are run: one after the other in this process, or several at a time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.registry import Component
from surfkit.core.signals import terminable
from surfkit.runs.execute.block_state import Kind
from surfkit.runs.execute.remote import CHILD_POLL_S, DRIVER, INTERRUPTED_STATUS
from surfkit.scene.available_memory import free_bytes, oom_kills

LOG = "log.txt"
"""Output of a worker process, in the folder of its job."""


@dataclass(frozen=True)
class Job:
    """The work on one block of a run, or on one row of a table.

    Attributes:
        index: Its number.
        folder: Of the block, or of the run of the row.
        call: Runs the job in this process and returns the exit status.
        command: Arguments of `python` that run the job in a process of its own.
        cost: Expected work, in any unit.
        memory_bytes: Expected peak memory; 0 if unknown.
        needs: Paths that it reads, beside its folder.
    """

    index: int
    folder: Path
    call: Callable[[], int]
    command: tuple[str, ...]
    cost: float = 1.0
    memory_bytes: int = 0
    needs: tuple[Path, ...] = ()


@dataclass(frozen=True)
class JobResult:
    """The end of a job.

    Attributes:
        job: Which one.
        status: Exit status; 0 for success, negative for the signal that ended it, as in `subprocess`.
        why: A reason that the job itself could not write into its state, such as that its machine was lost.
        kind: Of a failure that the job itself could not write into its state; None if only its state tells.
    """

    job: Job
    status: int
    why: str | None = None
    kind: Kind | None = None


class Executor(Component):
    """A way to run jobs. What they leave on disk does not depend on the executor."""

    @property
    def in_process(self) -> bool:
        """Whether jobs run in this process, and show their own progress."""
        return False

    @property
    @abstractmethod
    def at_once(self) -> int | None:
        """How many jobs run on this machine at a time; None if they run on other machines."""

    @property
    def threads_each(self) -> int:
        """Threads of each job on this machine; 0 for as many as torch uses in this process."""
        return 0

    @abstractmethod
    def ready(self) -> None:
        """Check that it can run jobs, before the run begins.

        Raises:
            BadInput: Something is missing on this machine.
        """

    @abstractmethod
    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """Run the jobs and yield the result of each when it ends. When the iterator is closed, no job runs any more.

        Raises:
            KeyboardInterrupt: The user asked to stop; running jobs have saved their states.
        """


@dataclass(frozen=True)
class Inline(Executor):
    """One block or row after the other, in this process."""

    @property
    def in_process(self) -> bool:
        """See `Executor.in_process`."""
        return True

    @property
    def at_once(self) -> int:
        """See `Executor.at_once`."""
        return 1

    def ready(self) -> None:
        """See `Executor.ready`; nothing to check."""

    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """See `Executor.run`."""
        for job in jobs:
            status = job.call()
            if status == INTERRUPTED_STATUS:
                raise KeyboardInterrupt
            yield JobResult(job, status)


@dataclass(frozen=True)
class Pool(Executor):
    """Several blocks or rows at a time on this machine, each in a process of its own; the largest first."""

    workers: int = 2
    """Processes at a time."""

    threads: int = 0
    """Threads of each; 0 divides the CPU cores among them."""

    memory_share: float = 0.9
    """No further block is started if the expected memory of all running blocks would exceed this share of the memory
    that was free."""

    gpus: int = 0
    """GPUs, from the first on, of which each process gets the one that the fewest use; 0 leaves them to --device."""

    def __post_init__(self) -> None:
        if self.workers < 1 or self.threads < 0 or self.gpus < 0:
            given = f"pool.workers {self.workers}, threads {self.threads}, gpus {self.gpus}"
            raise BadInput(f"{given}: give workers 1 or more, the others 0 or more")
        if not 0 < self.memory_share <= 1:
            raise BadInput(f"pool.memory_share is {self.memory_share}; it must lie in 0 to 1")

    @property
    def at_once(self) -> int:
        """See `Executor.at_once`."""
        return self.workers

    @property
    def threads_each(self) -> int:
        """See `Executor.threads_each`."""
        return self.threads or max(1, len(os.sched_getaffinity(0)) // self.workers)

    def ready(self) -> None:
        """See `Executor.ready`."""
        if not self.gpus:
            return
        import torch

        if (count := torch.cuda.device_count()) < self.gpus:
            raise BadInput(f"pool.gpus is {self.gpus}, and torch finds {count} GPUs here; give 0 to {count}")

    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """See `Executor.run`."""
        waiting = sort_by_cost(jobs)
        workers = Workers(self.threads_each, self.gpus)
        room = self.memory_share * free_bytes()
        with terminable():
            try:
                while waiting or workers.busy:
                    while waiting and len(workers.busy) < self.workers:
                        left = room - workers.memory_bytes
                        fits = [job for job in waiting if not workers.busy or job.memory_bytes <= left]
                        if not fits:
                            break
                        waiting.remove(fits[0])
                        workers.begin(fits[0])
                    yield from workers.ended()
                    time.sleep(CHILD_POLL_S)
            finally:
                workers.stop()


def _seen_gpus(count: int) -> list[str]:
    """Names of the first GPUs that this process may use, as CUDA_VISIBLE_DEVICES has them."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    return [str(at) for at in range(count)] if given is None else given.split(",")[:count]


def sort_by_cost(jobs: Sequence[Job]) -> list[Job]:
    """The jobs in the order to start them: the longest first, so that none of these is the last to end."""
    return sorted(jobs, key=lambda job: (-job.cost, job.index))


@dataclass
class Workers:
    """Worker processes and the job of each."""

    threads: int
    gpus: int = 0
    uses: dict[subprocess.Popen[bytes], int] = field(default_factory=dict)
    busy: dict[subprocess.Popen[bytes], Job] = field(default_factory=dict)
    kills: int = field(default_factory=lambda: oom_kills())

    @property
    def memory_bytes(self) -> int:
        """Expected memory of the running jobs."""
        return sum(job.memory_bytes for job in self.busy.values())

    def begin(self, job: Job) -> None:
        """Start a process; it does not receive Ctrl-C, but SIGTERM from `stop`."""
        job.folder.mkdir(parents=True, exist_ok=True)
        limits = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        used = [self.uses[process] for process in self.busy if process in self.uses]
        gpu = min(range(self.gpus), key=used.count, default=None)
        if gpu is not None:
            limits["CUDA_VISIBLE_DEVICES"] = _seen_gpus(self.gpus)[gpu]
        with open(job.folder / LOG, "ab") as log:
            process = subprocess.Popen(
                [sys.executable, *job.command],
                env=os.environ | limits | {DRIVER: str(os.getpid())},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self.busy[process] = job
        if gpu is not None:
            self.uses[process] = gpu

    def ended(self) -> list[JobResult]:
        """The results of the jobs that have ended since the last call."""
        return [self._result(process) for process in list(self.busy) if process.poll() is not None]

    def _result(self, process: subprocess.Popen[bytes]) -> JobResult:
        """The result of a process that has ended; the kernel tells whether one was killed for lack of memory."""
        killed = process.returncode == -signal.SIGKILL and oom_kills() > self.kills
        self.kills += killed
        return JobResult(self.busy.pop(process), process.returncode, kind="oom" if killed else None)

    def stop(self) -> None:
        """Ask every process to save its state and end, and wait for it.

        With SIGTERM, because processes that a shell has started in the background ignore SIGINT.
        """
        for process in self.busy:
            with suppress(ProcessLookupError):
                process.terminate()
        for process in self.busy:
            process.wait()
        self.busy.clear()
