"""An order in which blocks are trained."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from surfkit.plugin import Executor, Job, JobResult


@dataclass(frozen=True)
class NewPart(Executor):
    """One block after the other in this process, the one that needs the most memory first: too little shows early."""

    @property
    def in_process(self) -> bool:
        """See `Executor.in_process`."""
        return True

    @property
    def at_once(self) -> int:
        """See `Executor.at_once`."""
        return 1

    def ready(self) -> None:
        """See `Executor.ready`; there is nothing to check."""

    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """See `Executor.run`."""
        for job in sorted(jobs, key=lambda job: (-job.memory_bytes, -job.cost, job.index)):
            status = job.call()
            if status == 130:  # the user asked to stop, and the job has saved its state
                raise KeyboardInterrupt
            yield JobResult(job, status)
