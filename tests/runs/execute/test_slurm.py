"""Blocks as jobs of submitit, which needs no Slurm for its executors local and debug; and what Slurm would be told."""

import os
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from needs import needs
from two_blocks import EVERY, same

from surfkit.core.check import BadInput
from surfkit.runs.blocks import train_blocks as schedule
from surfkit.runs.blocks.train_blocks import Compute, Unfinished
from surfkit.runs.execute import Slurm, slurm
from surfkit.runs.execute.base import LOG, Job
from surfkit.runs.execute.block_state import read_state
from surfkit.runs.execute.remote import RemoteJob
from surfkit.runs.pipeline import run

submitit = needs("submitit", "executor:slurm")


def job(folder: Path, index: int, code: str = "pass", **more) -> Job:
    place = folder / f"{index:03}"
    return Job(index, place, lambda: index, ("-c", f"import os; os.chdir({str(place)!r}); exec({code!r})"), **more)


def wait_for(what):
    while not what():
        time.sleep(0.05)


@pytest.mark.parametrize("cluster", ["local", "debug"])
def test_how_each_ended_the_largest_first(cluster, tmp_path):
    say = "import time; print(time.time(), os.environ['OMP_NUM_THREADS'], flush=True)"
    codes = [say, f"{say}\nraise SystemExit(1)", f"{say}\nos.kill(os.getpid(), 9)"]
    jobs = [job(tmp_path, at, code, cost=cost) for at, (code, cost) in enumerate(zip(codes, (1, 9, 5), strict=True))]
    jobs.append(job(tmp_path, 3, cost=0.0, needs=(tmp_path / "elsewhere",)))
    ends = list(Slurm(cluster, cpus=3).run(jobs))
    assert [(end.job.index, end.status) for end in ends] == [(1, 1), (2, -9), (0, 0), (3, 2)]
    assert f"{tmp_path / 'elsewhere'} is not there" in ends[3].why
    printed = [(tmp_path / f"{index:03}" / LOG).read_text().split() for index in range(3)]
    assert [words[1] for words in printed] == [str(min(3, len(os.sched_getaffinity(0))))] * 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000", "001", "002", "003", "jobs"]


SAVING = (
    "import signal, sys, time\nfrom pathlib import Path\n"
    "def save(*_):\n    time.sleep(0.3)\n    Path('saved').touch()\n    sys.exit(130)\n"
    "signal.signal(signal.SIGTERM, save)\n"
    "Path('new').write_text(str(os.getppid()) + ' ' + str(os.getpid()))\nPath('new').rename('began')\ntime.sleep(3600)"
)


def processes(folder: Path) -> list[psutil.Process]:
    """That work on a job, outermost first: submitit's, ours that minds the command, and the command."""
    minder, command = map(int, (folder / "began").read_text().split())
    return [psutil.Process(minder).parent(), psutil.Process(minder), psutil.Process(command)]


@pytest.mark.parametrize("ctrl_c", [signal.default_int_handler, signal.SIG_IGN])
def test_leaving_stops_the_jobs(tmp_path, monkeypatch, ctrl_c):
    """Also in the background, where a shell lets Ctrl-C be ignored, by which submitit cancels."""
    before = signal.signal(signal.SIGINT, ctrl_c)
    try:
        leave(tmp_path, monkeypatch)
    finally:
        signal.signal(signal.SIGINT, before)


def leave(tmp_path, monkeypatch):
    class Stop(Exception):
        pass

    found: list[psutil.Process] = []

    def ended(queue):
        if len(list(tmp_path.glob("*/began"))) == 2:
            found.extend(process for at in (0, 1) for process in processes(tmp_path / f"00{at}"))
            raise Stop
        return iter(())

    monkeypatch.setattr(slurm.Queue, "ended", ended)
    with pytest.raises(Stop):
        next(Slurm("local", parallel=2).run([job(tmp_path, at, SAVING) for at in (0, 1, 2)]))
    assert not psutil.wait_procs(found)[1]
    assert all((tmp_path / f"00{at}" / "saved").exists() for at in (0, 1)) and not (tmp_path / "002" / LOG).exists()


def test_it_is_saved_before_it_is_queued_again(tmp_path):
    """What Slurm is asked to queue again, it ends at once."""
    (tmp_path / "000").mkdir()
    given = RemoteJob(job(tmp_path, 0, SAVING).command, tmp_path / "000" / LOG)
    given.begin()
    wait_for(lambda: (tmp_path / "000" / "began").exists())
    again = given.checkpoint().function
    assert (tmp_path / "000" / "saved").exists() and again.process is None and again.words == given.words


def test_a_job_whose_agent_is_killed(tmp_path, monkeypatch):
    """Its command notices, and saves."""
    monkeypatch.setattr(submitit.Job, "_results_timeout_s", 1)
    folder = tmp_path / "000"

    def kill():
        wait_for((folder / "began").exists)
        processes(folder)[0].kill()

    thread = threading.Thread(target=kill)
    thread.start()
    (end,) = Slurm("local").run([job(tmp_path, 0, SAVING)])
    thread.join()
    assert end.status == slurm.CRASHED_STATUS and "came to no result" in end.why
    wait_for((folder / "saved").exists)


def test_preempted_and_queued_again(undisturbed, data, recipe, tmp_path, monkeypatch):
    """At the signal of Slurm the block saves its state, and the job that is queued again goes on; then as ever."""
    reached, command, tests = tmp_path / "reached", schedule.job_of, str(Path(__file__).parents[2])
    code = (
        f"import sys, surfkit.runs.run_stage as o\nsys.path[:0] = {[tests]}\n"
        "from pathlib import Path\nfrom two_blocks import await_sigterm\nD = o.TrainingDisplay\n"
        "class K(D):\n    def show(self, done):\n        super().show(done)\n        if done.index == 7:\n"
        f"            await_sigterm(Path({str(reached)!r}))\n"
        "o.TrainingDisplay = K\nfrom surfkit.cli import main\nsys.exit(main({words!r}))"
    )

    def lingering(ctx, block, compute):
        made = command(ctx, block, compute)
        if block.index == 0 and not reached.exists():
            made = replace(made, command=("-c", code.replace("{words!r}", repr(list(made.command[2:])))))
        return replace(made, needs=(tmp_path / "elsewhere",)) if block.index == 1 else made

    def preempt():
        wait_for(reached.exists)
        psutil.Process(int(reached.read_text())).parent().send_signal(signal.SIGUSR2)

    thread = threading.Thread(target=preempt)
    thread.start()
    with monkeypatch.context() as patch, pytest.raises(Unfinished, match="block 1 failed: machine .*not there"):
        patch.setattr(schedule, "job_of", lingering)
        run(recipe, data, tmp_path / "run", Compute("cpu", Slurm("local", cpus=1, parallel=2)), EVERY)
    thread.join()
    log = (tmp_path / "run" / "blocks" / "000" / LOG).read_text()
    assert "stopped after step 7 of 12" in log and "going on after step 7 of 12" in log
    assert read_state(tmp_path / "run" / "blocks" / "000").attempts == 2
    run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)
    assert same(tmp_path / "run", undisturbed)


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Programs that answer like those of Slurm; what they were asked is in `asked`, what squeue says in `queue`."""
    programs = {
        "sbatch": 'cp "$1" "$HERE/script"; [ -e "$HERE/full" ] && { echo "no such partition" >&2; exit 1; }\n'
        "echo Submitted batch job 17",
        "squeue": 'cat "$HERE/queue"',
        "scancel": "",
        "srun": "",
    }
    folder = tmp_path / "bin"
    folder.mkdir()
    for name, lines in programs.items():
        (folder / name).write_text(f'#!/bin/sh\nHERE={tmp_path}\necho {name} "$@" >> "$HERE/asked"\n{lines}\n')
        (folder / name).chmod(0o755)
    (tmp_path / "queue").write_text("17_0 PENDING Priority\n17_1 PENDING PartitionTimeLimit\n")
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setattr(slurm, "SLURM_POLL_S", 0.01)
    monkeypatch.setattr(slurm, "QUERY_INTERVAL_S", 0.05)
    return tmp_path


def test_what_slurm_is_told(cluster, capsys):
    workers = Slurm(
        partition="gpu", account="maps", hours=1.5, cpus=4, gpus=1, parallel=3, extra=("qos=long", "exclusive")
    )
    jobs = [job(cluster / "my run" / "blocks", at, cost=at, memory_bytes=2_500_000_000) for at in range(2)]
    running = workers.run(jobs)

    def later():
        wait_for(lambda: (cluster / "asked").exists() and (cluster / "asked").read_text().count("squeue") > 1)
        (cluster / "new").write_text("17_0 RUNNING None\n17_1 OUT_OF_MEMORY OutOfMemory\n3_0 FAILED None\n")
        (cluster / "new").replace(cluster / "queue")

    thread = threading.Thread(target=later)
    thread.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slurm, "RESULT_ARRIVAL_S", 0.3)
        lost = next(running)
    thread.join()
    running.close()
    script = (cluster / "script").read_text()
    wanted = ["array=0-1%2", "time=90", "cpus-per-task=4", "gpus-per-node=1", "mem=3GB", "partition=gpu", "qos=long"]
    for option in [*wanted, "account=maps", "signal=USR2@90", "job-name='surfkit-my run'"]:
        assert f"#SBATCH --{option}\n" in script, option
    assert "#SBATCH --exclusive\n" in script and "#SBATCH --requeue\n" in script
    assert (lost.job.index, lost.status, lost.kind) == (0, slurm.CRASHED_STATUS, "oom")
    assert "job 17_1 is OUT_OF_MEMORY (OutOfMemory) in Slurm" in lost.why
    asked = (cluster / "asked").read_text().splitlines()
    assert asked[-1] == "scancel 17_0" and "scancel 17_1" not in asked
    said = capsys.readouterr().err
    assert "block 1: job 17_0 is PENDING\n" in said and "block 1: job 17_0 is RUNNING\n" in said
    assert "block 0: job 17_1 is PENDING (PartitionTimeLimit)\n" in said


@pytest.mark.parametrize(
    ("state", "kind"),
    [
        ("OUT_OF_MEMORY (OutOfMemory)", "oom"),
        ("NODE_FAIL", "lost"),
        ("gone", "lost"),
        ("CANCELLED by 7", "interrupted"),
        ("FAILED (OUT_OF_MEMORY)", "crash"),
    ],
)
def test_the_kind_of_failure_that_a_state_means(state, kind):
    assert slurm._kind_of(state) == kind


def test_what_slurm_does_not_take(cluster):
    (cluster / "full").touch()
    with pytest.raises(BadInput, match="jobs: no such partition"):
        next(Slurm().run([job(cluster / "blocks", 0)]))


def test_what_a_person_cancels_stays_so(cluster, monkeypatch):
    (cluster / "queue").write_text("17 CANCELLED None\n")
    monkeypatch.setattr(slurm, "RESULT_ARRIVAL_S", 0.3)
    (end,) = Slurm().run([job(cluster / "blocks", 0)])
    assert end.status == 1


@pytest.mark.parametrize(
    "settings",
    [{"hours": 0}, {"cpus": 0}, {"gpus": 2}, {"memory_gb": -1}, {"requeues": -1}, {"parallel": -1}]
    + [{"extra": (option,)} for option in ("--a", "a=", "A=b", "a\nb=c")],
)
def test_bad_settings(settings):
    with pytest.raises(BadInput, match="slurm"):
        Slurm(**settings)


def test_without_slurm_or_the_package(monkeypatch, tmp_path):
    with monkeypatch.context() as patch, pytest.raises(BadInput, match="sbatch is not on this machine"):
        patch.setenv("PATH", str(tmp_path))
        Slurm().ready()
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(BadInput, match=r"pip install 'surfkit\[slurm\]'"):
        Slurm("local").ready()


def test_a_run_that_cannot_have_its_executor_says_so_first(data, recipe, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BadInput, match="sbatch is not on this machine"):
        run(recipe, data, tmp_path / "run", Compute("cpu", Slurm()), EVERY)
    assert not (tmp_path / "run").exists()
