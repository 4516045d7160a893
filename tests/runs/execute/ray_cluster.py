"""Blocks on a Ray cluster: two nodes of it, all on this machine, with real agents that really die.

`test_ray.py` runs this file in a process of its own: Ray leaves threads in the process that used it, and takes its
handlers of signals, so that a later crash there would end without a word.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from needs import needs
from two_blocks import EVERY, same, stop_after

from surfkit.core.check import BadInput
from surfkit.runs.blocks import train_blocks as schedule
from surfkit.runs.blocks import worker
from surfkit.runs.blocks.train_blocks import Compute, Unfinished
from surfkit.runs.execute import Ray
from surfkit.runs.execute.base import LOG, Job
from surfkit.runs.execute.block_state import read_state
from surfkit.runs.pipeline import run
from surfkit.testing import check_executor

ray = needs("ray", "executor:ray")
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")
PATIENCE_S = 240
SMALL = {"object_store_memory": 80_000_000, "memory": 2_000_000_000, "include_dashboard": False}


@pytest.fixture(scope="module")
def cluster():
    """A head of one processor, and room for more nodes."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    Cluster = needs("ray.cluster_utils").Cluster

    before = signal.getsignal(signal.SIGTERM)
    for left in (2, 1, 0):  # Ray gives itself 30 s to start, which a busy machine may miss
        made = Cluster()
        try:
            made.add_node(num_cpus=1, **SMALL)
            break
        except Exception:
            made.shutdown()
            if not left:
                raise
    yield made
    made.shutdown()
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def workers(cluster):
    return Ray(address=cluster.address, cpus=1, memory_gb=0.1)


def job(folder: Path, index: int, code: str = "pass", **more) -> Job:
    place = folder / f"{index:03}"
    return Job(index, place, lambda: index, ("-c", f"import os; os.chdir({str(place)!r}); exec({code!r})"), **more)


def wait_for(what):
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end, f"not so after {PATIENCE_S} s"
        time.sleep(0.05)


def test_how_each_ended_the_largest_first(workers, tmp_path):
    told = "time.time(), os.environ['OMP_NUM_THREADS'], repr(os.environ['CUDA_VISIBLE_DEVICES'])"
    say = f"import time; print({told}, flush=True)"
    codes = [say, f"{say}\nraise SystemExit(1)", f"{say}\nos.kill(os.getpid(), 9)"]
    jobs = [job(tmp_path, at, code, cost=cost) for at, (code, cost) in enumerate(zip(codes, (1, 9, 5), strict=True))]
    jobs.append(job(tmp_path, 3, needs=(tmp_path / "elsewhere",)))
    ends = {end.job.index: end for end in workers.run(jobs)}
    assert {index: end.status for index, end in ends.items()} == {0: 0, 1: 1, 2: -9, 3: 2}
    assert f"{tmp_path / 'elsewhere'} is not there" in ends[3].why
    assert ends[3].why.startswith(f"machine {os.uname().nodename}: ")
    printed = [(tmp_path / f"{index:03}" / LOG).read_text().split() for index in range(3)]
    assert sorted(range(3), key=lambda at: float(printed[at][0])) == [1, 2, 0]
    assert [words[1:] for words in printed] == [["1", "''"]] * 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000", "001", "002", "003"]


SAVING = (
    "import signal, sys, time\nfrom pathlib import Path\n"
    "def save(*_):\n    time.sleep(1)\n    Path('saved').touch()\n    sys.exit(130)\n"
    "signal.signal(signal.SIGTERM, save)\nPath('new').write_text(str(os.getpid()))\n"
    "Path('new').rename('began')\n"
    "while os.getppid() == int(os.environ['SURFKIT_DRIVER']): time.sleep(0.05)\n"
    "save()"
)


def test_leaving_stops_what_runs_and_what_waits(workers, tmp_path):
    jobs = [job(tmp_path, at, SAVING) for at in (0, 1)]
    running = workers.run(jobs)

    class Stop(Exception):
        pass

    def began():
        if (tmp_path / "000" / "began").exists():
            raise Stop
        time.sleep(0.05)
        return [], []

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        real = ray.wait
        patch.setattr(ray, "wait", lambda refs, **more: real(refs, **more) if "num_returns" in more else began())
        next(running)
    assert (tmp_path / "000" / "saved").exists() and not (tmp_path / "001" / "began").exists()


def test_the_driver_is_killed(cluster, tmp_path):
    """Ray kills the agents of a driver that is gone; what works for them notices, and saves."""
    folder, places = str(tmp_path), [str(Path(__file__).parents[up]) for up in (1, 2)]
    code = (
        f"import sys; sys.path[:0] = {places}\nfrom pathlib import Path\n"
        "from execute.ray_cluster import SAVING, job\n"
        "from surfkit.runs.execute import Ray\n"
        f"list(Ray(address={cluster.address!r}, cpus=1, memory_gb=0.1).run([job(Path({folder!r}), 0, SAVING)]))"
    )
    driver = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for((tmp_path / "000" / "began").exists)
    driver.kill()
    driver.wait()
    wait_for((tmp_path / "000" / "saved").exists)
    wait_for(lambda: not psutil.pid_exists(int((tmp_path / "000" / "began").read_text())))


def test_begun_here_goes_on_there_and_one_that_always_fails(undisturbed, data, recipe, workers, tmp_path):
    """Begun by inline, which is interrupted in the first block; the second fails on the cluster; inline does that."""
    train_block, command = schedule.train_block, schedule.job_of

    def stopped(ctx, block):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(worker, "optimise", stop_after(worker.optimise, 6))
            return train_block(ctx, block)

    def failing(ctx, block, compute):
        made = command(ctx, block, compute)
        return replace(made, needs=(tmp_path / "elsewhere",)) if block.index == 1 else made

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(schedule, "train_block", stopped)
        run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    assert read_state(tmp_path / "blocks" / "000").step == 6
    with (
        pytest.MonkeyPatch.context() as patch,
        pytest.raises(Unfinished, match="1 failed: machine .*elsewhere") as told,
    ):
        patch.setattr(schedule, "job_of", failing)
        run(recipe, data, tmp_path, Compute("cpu", workers), EVERY)
    states = [read_state(tmp_path / "blocks" / f"00{at}") for at in (0, 1)]
    assert told.value.status == 3 and [state.status for state in states] == ["done", "failed"]
    assert "going on after step 6 of 12" in (tmp_path / "blocks" / "000" / LOG).read_text()
    run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    assert same(tmp_path, undisturbed)


def test_a_node_is_lost(undisturbed, data, recipe, cluster, workers, tmp_path, monkeypatch, capsys):
    """It is killed while a block is between two steps, which is saved there, and finished on the other node."""
    node = cluster.add_node(num_cpus=1, object_store_memory=SMALL["object_store_memory"], memory=SMALL["memory"])
    agent = node.all_processes["raylet"][0].process.pid
    reached, gone, command = tmp_path / "reached", tmp_path / "gone", schedule.job_of
    tests = str(Path(__file__).parents[2])
    code = (
        f"import psutil, sys, surfkit.runs.run_stage as o\nsys.path[:0] = {[tests]}\n"
        "from pathlib import Path\nfrom two_blocks import await_sigterm\nD = o.TrainingDisplay\n"
        f"there = {agent} in [parent.pid for parent in psutil.Process().parents()]\n"
        "class K(D):\n    def show(self, done):\n        super().show(done)\n        if there and done.index == 7:\n"
        f"            await_sigterm(Path({str(reached)!r}))\n"
        "o.TrainingDisplay = K\nfrom surfkit.cli import main\nsys.exit(main({words!r}))"
    )

    def lingering(ctx, block, compute):
        made = command(ctx, block, compute)
        return replace(made, command=("-c", code.replace("{words!r}", repr(list(made.command[2:])))))

    def lose():
        wait_for(reached.exists)
        cluster.remove_node(node, allow_graceful=False)
        gone.touch()

    thread = threading.Thread(target=lose)
    thread.start()
    monkeypatch.setattr(schedule, "job_of", lingering)
    run(recipe, data, tmp_path / "run", Compute("cpu", workers), EVERY)
    thread.join()
    assert gone.exists() and same(tmp_path / "run", undisturbed)
    assert "is tried again" not in capsys.readouterr().err, "Ray did that, and waits where no machine is free"
    logs = "".join((tmp_path / "run" / "blocks" / name / LOG).read_text() for name in ("000", "001"))
    assert "stopped after step 7 of 12" in logs and "going on after step 7 of 12" in logs


def test_no_cluster_there(tmp_path):
    with pytest.raises(BadInput, match="ray.address 127.0.0.1:1: "):
        list(Ray(address="127.0.0.1:1").run([job(tmp_path, 0)]))


def test_contract(workers, tmp_path):
    check_executor(workers, tmp_path)
