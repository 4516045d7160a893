"""Blocks on the machines of a Ray cluster."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.optional import needed
from surfkit.core.signals import terminable
from surfkit.runs.execute.base import Executor, Job, JobResult, sort_by_cost
from surfkit.runs.execute.block_state import Kind
from surfkit.runs.execute.remote import CHILD_POLL_S, CRASHED_STATUS, run_remote_job
from surfkit.runs.execute.shared_filesystem import mark_folder, remote_job

REACH_S = 10.0
AGAIN_S = 2.0
STORE_BYTES = 100 << 20
"""Size of Ray's object store on this machine, which is hardly used."""


@dataclass(frozen=True)
class Ray(Executor):
    """Blocks on the machines of a Ray cluster, each in a process of its own; the largest first.

    Every machine must see run folder and data set at the same paths. A block whose machine is lost continues from its
    checkpoint on another one. Needs `pip install 'surfkit[ray]'`.
    """

    address: str = ""
    """Address of the cluster, as HOST:PORT, or auto for the one that this machine belongs to; if left out, Ray is
    started on this machine alone."""

    cpus: int = 0
    """CPU cores of each block; 0 divides those of the cluster among the running blocks."""

    gpus: float = 0.0
    """GPUs of each block; with 0.5, two blocks share one. With 0 a block sees none."""

    memory_gb: float = 0.0
    """Memory to reserve for each block; 0 takes what the largest should need, or a whole machine if it has less."""

    retries: int = 3
    """How often a block is started again because its machine was lost."""

    def __post_init__(self) -> None:
        if self.cpus < 0 or self.memory_gb < 0 or self.retries < 0:
            given = f"cpus {self.cpus}, memory_gb {self.memory_gb:g}, retries {self.retries}"
            raise BadInput(f"ray: {given}: each must be 0 or more")
        if not 0 <= self.gpus <= 1:
            raise BadInput(f"ray.gpus is {self.gpus:g}; a block uses one at most, so give 0 to 1")
        if self.address.startswith("ray://"):
            raise BadInput(
                f"ray.address {self.address}: give HOST:PORT of the head (port 6379 by default), and start "
                "surfkit on a machine of the cluster, which sees the run folder"
            )

    @property
    def at_once(self) -> None:
        """See `Executor.at_once`."""
        return None

    def ready(self) -> None:
        """See `Executor.ready`."""
        _imported()

    def run(self, jobs: Sequence[Job]) -> Iterator[JobResult]:
        """See `Executor.run`."""
        with _connected(self.address) as ray, mark_folder(jobs) as mark:
            share = self.share([node["Resources"] for node in ray.nodes() if node["Alive"]], jobs)
            task = ray.remote(max_retries=self.retries, **share)(run_remote_job)
            what = {job.index: remote_job(job, mark, int(share["num_cpus"]), self.gpus > 0) for job in jobs}
            under_way = {task.remote(what[job.index]): job for job in sort_by_cost(jobs)}
            try:
                while under_way:
                    for ref in ray.wait(list(under_way), timeout=CHILD_POLL_S)[0]:
                        yield _ended(ray, ref, under_way.pop(ref))
            finally:
                _cancel(ray, list(under_way))

    def share(self, nodes: Sequence[dict[str, float]], jobs: Sequence[Job]) -> dict[str, float]:
        """Resources of each block, as Ray names them: the same for all, so that Ray keeps their order.

        Args:
            nodes: Resources of each machine of the cluster.
            jobs: The jobs.

        Raises:
            BadInput: No machine has as much.
        """
        most = {name: max((node.get(name, 0) for node in nodes), default=0) for name in ("CPU", "GPU", "memory")}
        memory = self.memory_gb * 1e9 or min(max(job.memory_bytes for job in jobs), most["memory"])
        for name, wanted, flag in (
            ("CPU", self.cpus, "cpus"),
            ("GPU", self.gpus, "gpus"),
            ("memory", memory, "memory_gb"),
        ):
            if wanted > most[name]:
                unit = 1e9 if name == "memory" else 1
                raise BadInput(
                    f"executor: ray.{flag} is {wanted / unit:g}, and the machine of the cluster with most has "
                    f"{most[name] / unit:g}; lower it, or add a machine"
                )
        cpus = self.cpus or max(1, min(most["CPU"], self._fair(nodes, len(jobs), memory)))
        return {"num_cpus": int(cpus), "num_gpus": self.gpus, "memory": int(memory)}

    def _fair(self, nodes: Sequence[dict[str, float]], jobs: int, memory: float) -> int:
        """CPU cores for each block when as many blocks run as have room."""
        room = 0
        for node in nodes:
            most = [node.get("CPU", 0)]
            most += [node.get("GPU", 0) // self.gpus] if self.gpus else []
            most += [node.get("memory", 0) // memory] if memory else []
            room += int(min(most))
        return int(sum(node.get("CPU", 0) for node in nodes) // max(1, min(jobs, room)))


def _cancel(ray: ModuleType, left: list[Any]) -> None:
    """Stop tasks and wait until they have saved their states.

    Asked again and again: a task that is asked in the moment it begins may not notice.
    """
    while left:
        for ref in left:
            ray.cancel(ref)
        left = ray.wait(left, num_returns=len(left), timeout=AGAIN_S)[1]


def _imported() -> ModuleType:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    with needed("ray", "executor:ray"):
        import ray
    return ray


@contextmanager
def _connected(address: str) -> Iterator[ModuleType]:
    """Ray, connected; within, SIGTERM acts like Ctrl-C, instead of as Ray defines it."""
    ray = _imported()
    own = not ray.is_initialized()
    with terminable():
        if own:
            _connect(ray, address)
        try:
            with terminable():
                yield ray
        finally:
            if own:
                ray.shutdown()


def _connect(ray: ModuleType, address: str) -> None:
    if ":" in address:
        _reach(address)
    given: dict[str, Any] = {"address": address or "local", "log_to_driver": False, "logging_level": "ERROR"}
    if not address:
        count = len(os.sched_getaffinity(0))
        given |= {"num_cpus": count, "include_dashboard": False, "object_store_memory": STORE_BYTES}
    try:
        ray.init(**given)
    except (ConnectionError, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise BadInput(f"executor: ray.address {address or 'left out'}: no connection: {reason}") from error


def _reach(address: str) -> None:
    """BadInput if nothing listens there; Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=REACH_S).close()
    except (OSError, ValueError, OverflowError) as error:
        raise BadInput(
            f"executor: ray.address {address}: no connection ({error}); give HOST:PORT of the head, where "
            "`ray start --head` was given"
        ) from error


def _ended(ray: ModuleType, ref: Any, job: Job) -> JobResult:
    """The result of a job whose task has ended."""
    try:
        found = ray.get(ref)
    except ray.exceptions.RayError as error:
        lines = str(error).strip().splitlines()
        why = f"{type(error).__name__}: {lines[0] if lines else 'no message'}"
        return JobResult(job, CRASHED_STATUS, f"Ray could not run it: {why}", _kind_of(ray, error))
    return JobResult(job, found.status, found.why, found.kind)


def _kind_of(ray: ModuleType, error: Exception) -> Kind:
    """The kind of failure that an error of Ray means."""
    if isinstance(error, ray.exceptions.OutOfMemoryError):
        return "oom"
    lost = (ray.exceptions.NodeDiedError, ray.exceptions.WorkerCrashedError, ray.exceptions.LocalRayletDiedError)
    return "lost" if isinstance(error, lost) else "crash"
