"""Jobs for machines that share a file system with this one."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from surfkit.runs.execute.base import LOG, Job
from surfkit.runs.execute.remote import RemoteJob

MARK_PREFIX = ".seen-from-all-"


@contextmanager
def mark_folder(jobs: Sequence[Job]) -> Iterator[Path]:
    """Within, a marker file beside the folders of the jobs shows other machines that they see the same disk.

    Without it, the same path on another machine's own disk, with an earlier copy of the run, would go unnoticed.
    """
    beside = jobs[0].folder.resolve().parent
    beside.mkdir(parents=True, exist_ok=True)
    for left in beside.glob(f"{MARK_PREFIX}*"):  # of a driver that was killed
        left.unlink(missing_ok=True)
    with tempfile.NamedTemporaryFile(dir=beside, prefix=MARK_PREFIX) as file:
        yield Path(file.name)


def remote_job(job: Job, mark: Path, threads: int, gpu: bool) -> RemoteJob:
    """A job to be run on another machine.

    Args:
        job: The job.
        mark: See `mark_folder`.
        threads: Number of CPU threads that it may use.
        gpu: Whether it may use the GPUs that the cluster has given it; without this, a job that was given none would
            use those of others.
    """
    folder = job.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    made = RemoteJob(job.command, folder / LOG, (mark, *(path.absolute() for path in job.needs)), threads)
    return made if gpu else replace(made, variables={**made.variables, "CUDA_VISIBLE_DEVICES": ""})
