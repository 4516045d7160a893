"""The state of a stage that several processes have together, in the one file that a single process writes.

So a run goes on with any number of processes. Nobody holds the whole: process 0 writes the columns of one process after
the other, and each process reads its own rows.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.primitives.points import Points
from surfkit.train import checkpoint, streaming
from surfkit.train.checkpoint import TENSOR_GROUPS
from surfkit.train.divide import share
from surfkit.train.processes import Processes
from surfkit.train.state import StageState


def load_share(path: Path, processes: Processes) -> StageState:
    """The state in the last whole file, with the points of this process.

    Raises:
        BadInput: There is none, or it has points that nothing changes.
    """
    found = streaming.open_last(path)
    if found is None:
        raise BadInput(f"{path}: no checkpoint is there for the processes to begin with")
    state, points = found[0].state, found[0].state.points
    if state.frozen:
        raise BadInput(f"{path}: frozen points are not trained by several processes; use --processes 1")
    rows = share(len(points), processes)
    groups: dict[str, dict[str, Tensor]] = {}
    with checkpoint.reading(found[0].path) as (file, _):
        for group, attribute in TENSOR_GROUPS.items():
            names = sorted(getattr(points, attribute))
            groups[attribute] = {n: file.get_slice(f"{group}.{n}")[rows].clone() for n in names}
    params, first, second, stats = (groups[name] for name in ("params", "exp_avg", "exp_avg_sq", "stats"))
    alone = processes.rank == 0
    own = replace(state, points=Points(params, first, second, stats, points.shared))
    return own if alone else replace(own, cpu_seconds=0.0)  # which are added up when it is written


def save_shares(path: Path, state: StageState, processes: Processes) -> None:
    """Write the state of all processes, each with its points, as `checkpoint.save` does; all of them call it."""
    counts = processes.of_each(len(state.points))
    cpu = torch.tensor([state.cpu_seconds], dtype=torch.float64)
    dist.all_reduce(cpu)
    columns = {
        f"{group}.{name}": value
        for group, attribute in TENSOR_GROUPS.items()
        for name, value in sorted(getattr(state.points, attribute).items())
    }
    if processes.rank:
        for value in columns.values():
            dist.send(_plain(value), 0)
        dist.barrier()
        return
    small, facts = checkpoint.beside_points(replace(state, cpu_seconds=float(cpu)))
    tensors = small | {n: v.new_empty(sum(counts), *v.shape[1:], device="meta") for n, v in columns.items()}
    with checkpoint.taking_the_place(path) as part:
        with open(part, "wb") as file:
            starts = streaming.begin(file, tensors, facts, "0" * 64)
            for name, value in small.items():
                file.seek(starts[name])
                file.write(streaming.bytes_of(value))
            for name, value in columns.items():
                file.seek(starts[name])
                for rank, count in enumerate(counts):
                    file.write(streaming.bytes_of(value if rank == 0 else _received(value, count, rank)))
        streaming.finish(part, tensors, facts)
    dist.barrier()


def _received(like: Tensor, count: int, rank: int) -> Tensor:
    """(count, ...) of another process."""
    found = like.new_empty(count, *like.shape[1:])
    dist.recv(_plain(found), rank)
    return found


def _plain(values: Tensor) -> Tensor:
    """Numbers of 16 bits as bytes; gloo knows nothing of them."""
    return values.contiguous().view(torch.uint8) if values.dtype == torch.bfloat16 else values.contiguous()
