"""Jobs for machines that see the same folders as this one."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from surfkit.execute.base import LOG, Job
from surfkit.execute.remote import RemoteJob

MARK = ".seen-from-all-"


@contextmanager
def marked(jobs: Sequence[Job]) -> Iterator[Path]:
    """Within, a file lies beside the folders of the jobs by which they know that they see the same disk.

    A folder of that path may well be on another machine's own disk, with an earlier copy of the run in it.
    """
    beside = jobs[0].folder.resolve().parent
    beside.mkdir(parents=True, exist_ok=True)
    for left in beside.glob(f"{MARK}*"):  # by a driver that was killed
        left.unlink(missing_ok=True)
    with tempfile.NamedTemporaryFile(dir=beside, prefix=MARK) as file:
        yield Path(file.name)


def remote_job(job: Job, mark: Path, threads: int, gpu: bool) -> RemoteJob:
    """A job as another machine does it.

    Args:
        job: What there is to do.
        mark: See `marked`.
        threads: That it may use.
        gpu: Whether it may see the graphics processors that the cluster gave it; whoever was given none would else take
            those of others.
    """
    folder = job.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    made = RemoteJob(job.command, folder / LOG, (mark, *(path.absolute() for path in job.needs)), threads)
    return made if gpu else replace(made, carried={**made.carried, "CUDA_VISIBLE_DEVICES": ""})
