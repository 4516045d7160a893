"""Points divided over processes: who has which, what changes them together, and what does not work so.

Grendel-GS (Zhao et al. 2025, section 3). The points of process 0, then those of process 1, and so on, are those of the
model, in its order. Densification looks at the statistics of all points in every process, which are small beside the
points, and so comes to the same as in one process, with the same random draws; each process then changes its own. Where
one has 1.1 times its share after that, points move on to the next process until all have the same number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surfkit.core.check import BadInput, Fault
from surfkit.core.registry import Component, kebab
from surfkit.densify.base import Contribution, Policy, Step, Views
from surfkit.densify.point_cap import PointCap
from surfkit.primitives.base import Primitive
from surfkit.primitives.drawing import draws_itself
from surfkit.primitives.draws import SharedDraws, normals
from surfkit.primitives.edit import ROW_FIELDS, Edit, apply_in_place, merge, sound
from surfkit.primitives.points import Points
from surfkit.primitives.smoothing import INTERVAL
from surfkit.raster.api import STANDARD, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.train.processes import Processes
from surfkit.train.stage import Stage

MOST_IMBALANCE = 1.1
"""Points of the process with the most, as a multiple of the mean, beyond which they are divided anew (Grendel-GS)."""


def refuse_undivided(setting: str, stage: Stage, primitive: Primitive, rasterizer: Rasterizer) -> None:
    """BadInput for what does not say that it works where several processes train one model.

    Args:
        setting: Path of the stage in the recipe.
        stage: What is to be trained so.
        primitive: What its points are.
        rasterizer: What draws.
    """
    parts: list[tuple[str, Component | None]] = [("primitive", primitive)]
    parts += [(f"{setting}.optimizer", stage.optimizer), (f"{setting}.signal", stage.signal)]
    parts += [(f"{setting}.densify", stage.densify)]
    if isinstance(stage.densify, PointCap):
        parts += [(f"{setting}.densify.inner", stage.densify.inner)]
    parts += [(f"{setting}.prune.{at}", prune) for at, prune in enumerate(stage.prune)]
    for path, part in parts:
        if part is not None and not vars(type(part)).get("divides", False):
            raise BadInput(
                f"--processes: {path} {kebab(type(part).__name__)} does not work with several processes; choose "
                "another, or leave --processes out"
            )
    if stage.regularizers:
        path = f"{setting}.regularizers.{next(iter(stage.regularizers))}"
        raise BadInput(f"--processes: {path} looks at all points, which no process has; drop it with {path}:none")
    if INTERVAL in primitive.columns():
        raise BadInput("--processes: primitive.smoothing looks at all points, which no process has; set it to 0")
    if primitive.shared() or draws_itself(primitive):
        raise BadInput(f"--processes: primitive {kebab(type(primitive).__name__)} is drawn as a whole; choose another")
    if not isinstance(rasterizer, NativeRasterizer):
        raise BadInput("--processes: several processes draw with the compiled kernels of the CPU; add --device cpu")


def share(count: int, processes: Processes, rank: int | None = None) -> slice:
    """Which of `count` points in their order a process, or this one, has at first."""
    rank = processes.rank if rank is None else rank
    return slice(count * rank // processes.count, count * (rank + 1) // processes.count)


@dataclass(frozen=True)
class EveryPoint(Points):
    """The points of all processes, for policies: their number, and their statistics, which are sent when asked for."""

    own: Points | None = None
    processes: Processes | None = None
    counts: Sequence[int] = ()

    def __len__(self) -> int:
        return sum(self.counts)

    def stat(self, name: str, *shape: int) -> Tensor:
        """See `Points.stat`."""
        assert self.own is not None and self.processes is not None
        return self.processes.gathered(self.own.stat(name, *shape), self.counts)


@dataclass(frozen=True)
class EveryView:
    """What policies ask about all views, for the points of all processes (`densify.base.Views`)."""

    own: Views
    processes: Processes
    counts: Sequence[int]

    def __len__(self) -> int:
        return len(self.own)

    def contributions(self, alpha_power: float = 0.5, transmittance_power: float = 0.5) -> Contribution:
        """See `Views.contributions`."""
        found = self.own.contributions(alpha_power, transmittance_power)
        values = (found.mean, found.peak, found.hits, found.views)
        return Contribution(*(self.processes.gathered(value, self.counts) for value in values))

    def leading(self, at: Sequence[int] | None = None) -> Tensor:
        """See `Views.leading`."""
        return self.processes.gathered(self.own.leading(at), self.counts)

    def each(self, alpha_power: float, transmittance_power: float) -> Iterator[tuple[Tensor, Tensor]]:
        """See `Views.each`."""
        for amount, count in self.own.each(alpha_power, transmittance_power):
            yield self.processes.gathered(amount, self.counts), self.processes.gathered(count, self.counts)


def wanted_of_all(processes: Processes, policies: Sequence[Policy], points: Points, step: Step) -> Edit | None:
    """What the policies ask for of the points of all processes, the same in each process.

    Args:
        processes: Those that train.
        policies: Told of the points of this process in `watch`, of all in `edit`.
        points: Of this process.
        step: About these.
    """
    for policy in policies:
        policy.watch(points, step)
    counts = processes.of_each(len(points))
    every, whole = (
        EveryPoint({}, {}, {}, own=points, processes=processes, counts=counts),
        of_all(processes, counts, step),
    )
    return merge([sound(policy.edit(every, whole), len(every), policy, points.params) for policy in policies])


def of_all(processes: Processes, counts: Sequence[int], step: Step) -> Step:
    """What policies are told of the points of all processes, from what each knows of its own; sent when read."""

    def gathered(values: Tensor) -> Tensor:
        return processes.gathered(values, counts)

    def splats() -> Splats:
        own = step.splats.with_colors(step.splats.sh0)  # of colours, policies know those of degree 0
        return own.with_named({name: gathered(getattr(own, name)) for name in STANDARD})

    return Step(
        index=step.index,
        steps=step.steps,
        seen=lambda: gathered(step.seen),
        splats=splats,
        grad_norm=lambda: gathered(step.grad_norm),
        radii=lambda: gathered(step.radii),
        image_px=step.image_px,
        views=EveryView(step.views, processes, counts),
        since_reset=step.since_reset,
        rates=step.rates,
        seed=step.seed,
        signed_norm=lambda: None if step.signed_norm is None else gathered(step.signed_norm),
    )


def refuse_apart(processes: Processes, at: int, skipped: Sequence[int]) -> None:
    """Fault where processes are about to draw different views, as one could not read a photograph that others can.

    Args:
        processes: Those that train.
        at: Position of the view of this step.
        skipped: Positions of the views that this process has passed over.
    """
    if len(set(zip(processes.of_each(at), processes.of_each(len(skipped)), strict=True))) > 1:
        raise Fault("a photograph can be read by some of the processes and not by others; see that its disk is there")


def own_rows(processes: Processes, count: int) -> slice:
    """Which of the points of all processes the `count` of this one are."""
    counts = processes.of_each(count)
    before = sum(counts[: processes.rank])
    return slice(before, before + count)


def own_edit(edit: Edit, rows: slice) -> Edit:
    """The part of an edit of all points that is for those of some rows."""
    if edit.new is not None or edit.values is not None or edit.scatter is not None:
        raise BadInput("--processes: a policy adds points or gives values in a way that does not work with several")
    parts = {name: None if (value := getattr(edit, name)) is None else value[rows] for name in ROW_FIELDS}
    return replace(edit, **parts)


def edited(
    processes: Processes | None,
    primitive: Primitive,
    points: Points,
    edit: Edit,
    generator: torch.Generator,
    order: Callable[[Tensor], Tensor] | None,
) -> Points:
    """What `apply_in_place` makes of the points; with several processes the edit is for the points of all of them.

    Args:
        processes: Those that the points are divided over, if they are.
        primitive: What the points are.
        points: Of this process; changed in place.
        edit: What is asked for.
        generator: Of the splits; it ends in the same state in all processes.
        order: (N, 3) positions to the (N,) order in which points are to stand.
    """
    if processes is None:
        apply_in_place(primitive, points, edit, generator, order)
        return points
    rows = own_rows(processes, len(points))
    with shared_draws(edit, rows, generator) as draws:
        apply_in_place(primitive, points, own_edit(edit, rows), draws, order)
    return balanced(processes, points)


@contextmanager
def shared_draws(edit: Edit, rows: slice, generator: torch.Generator) -> Iterator[SharedDraws]:
    """Within, a generator for the splits of some rows of an edit of all points, which draws as for all of them."""
    draws, split = SharedDraws(), torch.zeros(0, dtype=torch.bool) if edit.split is None else edit.split
    draws.set_state(generator.get_state())
    draws.before, draws.total, draws.is_used = int(split[: rows.start].sum()), int(split.sum()), False
    yield draws
    if draws.total and not draws.is_used:
        draws.total, draws.before = draws.total, 0
        normals(2, 0, draws)
    generator.set_state(draws.get_state())


def balanced(processes: Processes, points: Points) -> Points:
    """The points of this process; where it or another has too many, in equal shares of the same order."""
    counts = processes.of_each(len(points))
    total = sum(counts)
    if max(counts) * processes.count <= MOST_IMBALANCE * total:
        return points
    begins = [sum(counts[:rank]) for rank in range(processes.count)]
    shares = [share(total, processes, rank) for rank in range(processes.count)]

    def common(rank: int, to: int) -> int:
        """Points of a process that are in the new share of another."""
        first, end = max(begins[rank], shares[to].start), min(begins[rank] + counts[rank], shares[to].stop)
        return max(0, end - first)

    everybody, me = range(processes.count), processes.rank
    sent, received = [common(me, to) for to in everybody], [common(rank, me) for rank in everybody]
    params, first, second, stats = [
        {name: exchanged_column(processes, value, sent, received) for name, value in sorted(group.items())}
        for group in (points.params, points.exp_avg, points.exp_avg_sq, points.stats)
    ]
    return Points(params, first, second, stats, points.shared, points.storage)


def exchanged_column(processes: Processes, values: Tensor, sent: Sequence[int], received: Sequence[int]) -> Tensor:
    """(R, ...) of (S, ...), see `Processes.exchanged`; also moments in 16 bits, of which gloo knows nothing."""
    if values.dtype == torch.bfloat16:
        # as a matrix: the bytes of one number a point would be rows of their own
        rows = values.reshape(len(values), math.prod(values.shape[1:]))
        found = processes.exchanged(rows.view(torch.uint8), sent, received).view(torch.bfloat16)
        return found.view(len(found), *values.shape[1:])
    return processes.exchanged(values, sent, received)
