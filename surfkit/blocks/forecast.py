"""What the tuning of the blocks will take, told before it begins: time, disk and memory, from the coarse model."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace

from surfkit.core.check import BadInput
from surfkit.core.clock import clock
from surfkit.core.events import Warned, emit, say
from surfkit.core.memory import size
from surfkit.execute.state import read_state
from surfkit.partition.plan import Block
from surfkit.run.context import RunContext
from surfkit.run.folder import Run
from surfkit.scene.memory import free_bytes
from surfkit.train.stage import StageState

KEPT = 2
"""Checkpoints of a block that stay."""
GROWN = 3.0
"""Times as many points as in the coarse model that a block may come to, where points multiply; a rule of thumb."""
POINT_BYTES, FROZEN_BYTES = 3_000, 1_500
"""What a point takes of memory, as far as it can be told before: with values, moments, gradients and records of the
rasterizer; and without moments and gradients. Measured at 1,640 and 770 more for each, and as much again for tiles."""
FROZEN_PACE = 0.75
"""Of the time that a point takes in a step, what a frozen one does (measured: 0.78 ms to 1.03 ms for 1,000 points)."""


@dataclass(frozen=True)
class Need:
    """What the blocks that are left will take.

    Attributes:
        steps: Of all of them.
        seconds: At the mean pace of the coarse model, on this machine.
        least_bytes: Of disk, for the last checkpoint of each if no point were added.
        disk_bytes: Of disk, for all checkpoints if points multiply.
        memory_bytes: Of the block that needs most; 0 where blocks are tuned on other machines.
    """

    steps: int
    seconds: float
    least_bytes: int
    disk_bytes: int
    memory_bytes: int


@dataclass(frozen=True)
class BlockPoints:
    """Points that a block begins with.

    Attributes:
        growing: Those that may multiply.
        still: Those that may not; they are as many at the end, but for what is dropped.
        frozen: Whether the latter are frozen.
    """

    growing: int
    still: int
    frozen: bool

    def bytes(self, each: float, frozen: float, grown: float) -> int:
        """What they come to, where each takes so much, a frozen one so much, and those that multiply so many times."""
        return int(grown * each * self.growing + (frozen if self.frozen else each) * self.still)

    @property
    def pace(self) -> float:
        """The time of a step as a share of what it takes where none is frozen."""
        return (self.growing + (FROZEN_PACE if self.frozen else 1) * self.still) / max(1, self.growing + self.still)


def begun(ctx: RunContext, block: Block) -> BlockPoints:
    """The points that a block begins with, from its plan; from its state, if it has been begun."""
    around_is, known = ctx.run.recipe.context, read_state(ctx.place(block.index)).begun_points
    around = max(0, block.begins - block.points)
    if around_is == "frozen":
        return BlockPoints(known or block.points, around, True)
    both = known or block.points + around
    return (
        BlockPoints(both, 0, False)
        if around_is == "densified"
        else BlockPoints(block.points, max(0, both - block.points), False)
    )


def memory_of(ctx: RunContext, block: Block) -> int:
    """Bytes of memory that the points of a block may come to."""
    grown = GROWN if ctx.run.recipe.tune.densify is not None else 1.0
    return begun(ctx, block).bytes(POINT_BYTES, FROZEN_BYTES, grown)


def need(ctx: RunContext, left: Sequence[Block], coarse: StageState, memory: Sequence[int]) -> Need:
    """What blocks will take.

    Args:
        ctx: Run and data.
        left: Blocks with steps to make.
        coarse: The coarse model.
        memory: Bytes that each of them is expected to need, where they are tuned on this machine.
    """
    tune = ctx.run.recipe.tune
    steps = [max(0, tune.steps - read_state(ctx.place(block.index)).step) for block in left]
    whole = replace(ctx.run, part="pretrain").checkpoint.stat().st_size
    each = whole / max(1, len(coarse.points))
    begins, there = [begun(ctx, block) for block in left], [size_of(ctx.block(block.index)) for block in left]
    grown = GROWN if tune.densify is not None else 1.0
    least, most = ([points.bytes(each, each / 3, times) for points in begins] for times in (1.0, grown))
    return Need(
        steps=sum(steps),
        seconds=sum(count * points.pace for count, points in zip(steps, begins, strict=True))
        * (coarse.seconds / max(1, coarse.index)),
        least_bytes=sum(max(0, size - found) for size, found in zip(least, there, strict=True)),
        disk_bytes=sum(max(0, KEPT * size - found) for size, found in zip(most, there, strict=True))
        + int(KEPT * grown * whole),  # of the blocks, and of all when they are merged
        memory_bytes=max(memory, default=0),
    )


def size_of(block: Run) -> int:
    """Bytes of the checkpoints of a block that are there."""
    folder = block.checkpoint.parent
    return sum(path.stat().st_size for path in folder.glob("*.safetensors")) if folder.exists() else 0


def tell(ctx: RunContext, found: Need) -> None:
    """Say what blocks will take, and warn where that is more than there is.

    Raises:
        BadInput: The disk is certainly too small.
    """
    disk, memory = shutil.disk_usage(ctx.run.out).free, free_bytes()
    text = (
        f"{found.steps:,} steps to tune, about {clock(found.seconds)} at the pace of the coarse model; "
        f"checkpoints take about {size(found.disk_bytes)} of disk, {size(disk)} are free"
    )
    if found.memory_bytes:
        text += f"; a block needs up to {size(found.memory_bytes)} of memory, {size(memory)} are free"
    say(text)
    if found.least_bytes > disk:
        raise BadInput(
            f"{ctx.run.out}: the blocks need at least {size(found.least_bytes)} of disk for their checkpoints, and "
            f"{size(disk)} are free; make room, and give the same command again"
        )
    if found.disk_bytes > disk:
        emit(
            Warned(
                f"the blocks may need about {size(found.disk_bytes)} of disk, and {size(disk)} are free; make room "
                "while they are tuned, or they stop at their last checkpoints and the same command goes on from there"
            )
        )
    if found.memory_bytes > memory:
        emit(
            Warned(
                f"a block may need about {size(found.memory_bytes)} of memory, and {size(memory)} are free; where it "
                "gives out, the block is tried again with less, which will be told; more blocks need less each"
            )
        )
