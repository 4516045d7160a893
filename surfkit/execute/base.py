"""Who works on the blocks: this process one after the other, or several processes at a time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.registry import Component
from surfkit.execute.remote import DRIVER, INTERRUPTED, POLL_S
from surfkit.scene.memory import free_bytes

LOG = "log.txt"
"""What a worker process prints, in the folder of its block."""


@dataclass(frozen=True)
class Job:
    """The work on one block.

    Attributes:
        index: Of the block.
        folder: Its own.
        call: Does it in this process and returns the exit status.
        command: Does it in a process of its own.
        cost: Expected work, in any unit.
        memory_bytes: Expected at its peak; 0 if unknown.
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
    """A job has come to an end.

    Attributes:
        job: Which.
        status: 0 when done; negative for the signal that ended it, as `subprocess` has it.
        why: What the job itself could not tell, such as that its machine is gone.
    """

    job: Job
    status: int
    why: str | None = None


class Executor(Component):
    """A way to get jobs done. What they leave on disk is the same whoever did them."""

    @property
    @abstractmethod
    def at_once(self) -> int | None:
        """How many jobs share this machine at a time; None if they run on others, and look there for what is free."""

    @abstractmethod
    def ready(self) -> None:
        """Look, before hours are spent, whether it can work.

        Raises:
            BadInput: Something is missing on this machine.
        """

    @abstractmethod
    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """Do the jobs and tell of each as it ends. On the way out, nothing is left running.

        Raises:
            KeyboardInterrupt: Someone asked to stop; the jobs under way have saved their states.
        """


@dataclass(frozen=True)
class Inline(Executor):
    """One block after the other, in this process."""

    @property
    def at_once(self) -> int:
        """See `Executor.at_once`."""
        return 1

    def ready(self) -> None:
        """See `Executor.ready`; it always can."""

    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """See `Executor.run`."""
        for job in jobs:
            status = job.call()
            if status == INTERRUPTED:
                raise KeyboardInterrupt
            yield JobResult(job, status)


@dataclass(frozen=True)
class Pool(Executor):
    """Several blocks at a time on this machine, each in a process of its own; the largest first."""

    workers: int = 2
    """Processes at a time."""

    threads: int = 0
    """Of each; 0 divides the processors among them."""

    memory_share: float = 0.9
    """No further block begins when the expected memory of those under way would exceed this share of what was free."""

    def __post_init__(self) -> None:
        if self.workers < 1 or self.threads < 0:
            raise BadInput(f"pool.workers {self.workers}, threads {self.threads}: give 1 or more, 0 or more")
        if not 0 < self.memory_share <= 1:
            raise BadInput(f"pool.memory_share is {self.memory_share}; it must lie in 0 to 1")

    @property
    def at_once(self) -> int:
        """See `Executor.at_once`."""
        return self.workers

    def ready(self) -> None:
        """See `Executor.ready`; it always can."""

    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """See `Executor.run`."""
        waiting = largest_first(jobs)
        crew = Crew(self.threads or max(1, len(os.sched_getaffinity(0)) // self.workers))
        room = self.memory_share * free_bytes()
        with terminable():
            try:
                while waiting or crew.busy:
                    while waiting and len(crew.busy) < self.workers:
                        fits = [job for job in waiting if not crew.busy or crew.memory_bytes + job.memory_bytes <= room]
                        if not fits:
                            break
                        waiting.remove(fits[0])
                        crew.begin(fits[0])
                    yield from crew.ended()
                    time.sleep(POLL_S)
            finally:
                crew.stop()


def largest_first(jobs: Sequence[Job]) -> list[Job]:
    """In the order to begin them, so that none of the long ones is left for the end."""
    return sorted(jobs, key=lambda job: (-job.cost, job.index))


@contextmanager
def terminable() -> Iterator[None]:
    """Within, SIGTERM acts as Ctrl-C, so that workers save their states."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@dataclass
class Crew:
    """Worker processes and what each works on."""

    threads: int
    busy: dict[subprocess.Popen[bytes], Job] = field(default_factory=dict)

    @property
    def memory_bytes(self) -> int:
        """Expected of the jobs under way."""
        return sum(job.memory_bytes for job in self.busy.values())

    def begin(self, job: Job) -> None:
        """Start a process; it gets no Ctrl-C of its own, but is told by `stop`."""
        job.folder.mkdir(parents=True, exist_ok=True)
        limits = {name: str(self.threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
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

    def ended(self) -> list[JobResult]:
        """The jobs that have ended since it was last asked."""
        over = [process for process in self.busy if process.poll() is not None]
        return [JobResult(self.busy.pop(process), process.returncode) for process in over]

    def stop(self) -> None:
        """Ask every process to save its state and end, and wait until they have.

        By SIGTERM: SIGINT is ignored by what a shell has started in the background.
        """
        for process in self.busy:
            with suppress(ProcessLookupError):
                process.terminate()
        for process in self.busy:
            process.wait()
        self.busy.clear()
