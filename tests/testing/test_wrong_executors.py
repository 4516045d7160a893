"""Executors that break their contract are named, with what is wrong."""

import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace

import pytest

from surfkit.runs.execute.base import Executor, Inline, JobResult
from surfkit.testing import check_executor, executors


@dataclass(frozen=True)
class Plain(Executor):
    """One after the other."""

    places: int | None = 1

    @property
    def at_once(self):
        return self.places

    def ready(self):
        pass

    def run(self, jobs):
        yield from Inline().run(jobs)


class Cheers(Plain):
    def run(self, jobs):
        yield from (JobResult(end.job, 0) for end in Inline().run(jobs))


class GivesUp(Plain):
    def run(self, jobs):
        for end in Inline().run(jobs):
            yield end
            if end.status:
                return


class Repeats(Plain):
    def run(self, jobs):
        for end in Inline().run(jobs):
            yield from (end, end)


class Promises(Plain):
    def run(self, jobs):
        yield from (JobResult(job, 0) for job in jobs)


class Collects(Plain):
    def run(self, jobs):
        return iter(list(Inline().run(jobs)))


class Abandons(Plain):
    """Begins all at once, and does not care when nobody asks any more."""

    left = []

    def run(self, jobs):
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        began = [subprocess.Popen([sys.executable, *job.command], **quiet) for job in jobs]
        self.left.extend(began)
        for job, process in zip(jobs, began, strict=True):
            yield JobResult(job, process.wait())


@pytest.mark.parametrize(
    ("executor", "message"),
    [
        (Cheers(), "Cheers: job 1 ended with status 3; it tells 0"),
        (GivesUp(), "GivesUp does not tell of job 2"),
        (Repeats(), "Repeats tells of job 0 twice"),
        (Promises(), "Promises .*job 0 .*not begun"),
        (Collects(), "Collects.run gives no generator"),
        (Abandons(), "Abandons leaves a job running"),
        (Plain(places=0), "Plain.at_once is 0; .*None .*1 or more"),
    ],
)
def test_executors_that_are_wrong(executor, message, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(executors, "QUIET_S", 60.0)  # it ends as soon as something is heard
    with pytest.raises(AssertionError, match=message):
        check_executor(executor)
    for process in Abandons.left:
        process.kill()
        process.wait()
    Abandons.left.clear()


def test_an_executor_that_is_right():
    check_executor(Plain())
    check_executor(replace(Plain(), places=None))
