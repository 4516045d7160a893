"""What `executor:ray` asks of a cluster and understands of it; with a real one, in a process of its own."""

import subprocess
import sys
from pathlib import Path

import pytest
from needs import needs

from surfkit.core.check import BadInput
from surfkit.runs.execute import Ray
from surfkit.runs.execute.base import Job
from surfkit.runs.execute.ray import _kind_of

ray = needs("ray", "executor:ray")


def job(folder: Path, index: int, **more) -> Job:
    return Job(index, folder / f"{index:03}", lambda: index, ("-c", "pass"), **more)


def test_on_a_cluster(tmp_path):
    """See `ray_cluster.py`."""
    file = Path(__file__).with_name("ray_cluster.py")
    options = [f"--basetemp={tmp_path / 'cluster'}", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", str(file), *options]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]


def test_the_kind_of_failure_that_an_error_means():
    known = ray.exceptions
    errors = [known.OutOfMemoryError("no memory"), known.NodeDiedError("away"), known.WorkerCrashedError()]
    assert [_kind_of(ray, error) for error in errors] == ["oom", "lost", "lost"]
    assert _kind_of(ray, known.RaySystemError(ValueError("an OutOfMemoryError in words"))) == "crash"


NODES = [{"CPU": 16, "memory": 64e9, "GPU": 2}, {"CPU": 8, "memory": 16e9}]


@pytest.mark.parametrize(
    "workers, jobs, wanted",
    [
        (Ray(), 3, {"num_cpus": 8, "num_gpus": 0, "memory": 10e9}),
        (Ray(), 100, {"num_cpus": 3, "num_gpus": 0, "memory": 10e9}),  # six and one at a time, by their memory
        (Ray(), 1, {"num_cpus": 16, "num_gpus": 0, "memory": 10e9}),
        (Ray(gpus=0.5), 100, {"num_cpus": 6, "num_gpus": 0.5, "memory": 10e9}),
        (Ray(cpus=2, memory_gb=1), 100, {"num_cpus": 2, "num_gpus": 0, "memory": 1e9}),
    ],
)
def test_what_each_block_reserves(workers, jobs, wanted, tmp_path):
    assert workers.share(NODES, [job(tmp_path, at, memory_bytes=10**10) for at in range(jobs)]) == wanted


def test_what_no_machine_has(tmp_path):
    for settings, said in (({"cpus": 17}, "has 16"), ({"memory_gb": 65}, "has 64")):
        with pytest.raises(BadInput, match=said):
            Ray(**settings).share(NODES, [job(tmp_path, 0)])
    assert Ray().share(NODES, [job(tmp_path, 0, memory_bytes=10**12)])["memory"] == 64e9  # as much as there is
    with pytest.raises(BadInput, match="has 0"):
        Ray(gpus=1).share(NODES[1:], [job(tmp_path, 0)])


@pytest.mark.parametrize(
    "settings", [{"cpus": -1}, {"gpus": 2.0}, {"memory_gb": -1}, {"retries": -1}, {"address": "ray://head:10001"}]
)
def test_bad_settings(settings):
    with pytest.raises(BadInput, match="ray"):
        Ray(**settings)


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(BadInput, match=r"pip install 'surfkit\[ray\]'"):
        Ray().ready()
