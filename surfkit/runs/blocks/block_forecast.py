"""A forecast of the time, disk and memory that training the blocks will take, from the coarse model."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.clock import clock
from surfkit.core.events import Warned, emit, say
from surfkit.core.memory import size
from surfkit.runs.blocks.block import BlockRun
from surfkit.runs.folder import read_record
from surfkit.scene.available_memory import free_bytes
from surfkit.train.streaming import StoredState

CHECKPOINTS_PER_BLOCK = 2
"""Checkpoints of a block that are kept."""
DENSIFIED_GROWTH = 3.0
"""Growth of the number of points of a block with densification, as a factor; a rule of thumb."""
TRAINED_POINT_BYTES, FROZEN_POINT_BYTES = 3_000, 1_500
"""Memory of a point: with parameters, moments, gradients and buffers of the rasterizer; and of a frozen one, without
moments and gradients. Measured at 1,640 and 770 for each additional point; about as much again is for tiles."""
FILED_POINT_BYTES = 300
"""Memory of a point that is kept in a file: what an edit takes, measured at 140, and as much for what views show."""
FROZEN_TIME_SHARE = 0.75
"""Time of a frozen point in a step, as a share of that of another (measured: 0.78 ms to 1.03 ms for 1,000 points)."""


@dataclass(frozen=True)
class Forecast:
    """What the unfinished blocks will take.

    Attributes:
        steps: Of all of them.
        seconds: At the mean speed of the coarse model, on this machine.
        least_bytes: Of disk, for the last checkpoint of each if no point is added.
        disk_bytes: Of disk, for all checkpoints if points are added.
        memory_bytes: Of the block that needs most; 0 where blocks are trained on other machines.
        gpu_bytes: Memory of a GPU, of the block that needs most; 0 where the coarse model was trained without one.
    """

    steps: int
    seconds: float
    least_bytes: int
    disk_bytes: int
    memory_bytes: int
    gpu_bytes: int = 0


@dataclass(frozen=True)
class BlockPoints:
    """Points that a block begins with.

    Attributes:
        growing: Those that may be densified.
        still: Those that may not.
        frozen: Whether the latter are frozen.
    """

    growing: int
    still: int
    frozen: bool

    def bytes(self, each: float, frozen: float, grown: float) -> int:
        """Bytes of all, from those of each and of a frozen one, when densification adds points by a factor."""
        return int(grown * each * self.growing + (frozen if self.frozen else each) * self.still)

    @property
    def pace(self) -> float:
        """The time of a step as a share of its time if no point were frozen."""
        return (self.growing + (FROZEN_TIME_SHARE if self.frozen else 1) * self.still) / max(
            1, self.growing + self.still
        )


def initial_points(block: BlockRun) -> BlockPoints:
    """The points that a block begins with, by its plan; by its state, if it has been started."""
    planned, context, known = block.planned, block.run.recipe.context, block.state.begun_points
    around = max(0, planned.begins - planned.points)
    if context == "frozen":
        return BlockPoints(known or planned.points, around, True)
    both = known or planned.points + around
    if context == "densified":
        return BlockPoints(both, 0, False)
    return BlockPoints(planned.points, max(0, both - planned.points), False)


def point_memory(block: BlockRun, filed: bool = False) -> int:
    """Bytes of memory that the points of a block may need; `filed`: as they are kept in files."""
    grown = DENSIFIED_GROWTH if block.run.recipe.tune.densify is not None else 1.0
    each = (FILED_POINT_BYTES, FILED_POINT_BYTES) if filed else (TRAINED_POINT_BYTES, FROZEN_POINT_BYTES)
    return initial_points(block).bytes(*each, grown)


def forecast(blocks: Sequence[BlockRun], coarse: StoredState, memory: Sequence[int]) -> Forecast:
    """What blocks will take.

    Args:
        blocks: One or more with steps to do.
        coarse: The coarse model.
        memory: Bytes that each of them is expected to need, where they are trained on this machine.
    """
    tune, model = blocks[0].run.recipe.tune, coarse.state
    steps = [max(0, tune.steps - block.state.step) for block in blocks]
    whole = coarse.path.stat().st_size
    each = whole / max(1, len(model.points))
    begins, there = [initial_points(block) for block in blocks], [checkpoint_bytes(block) for block in blocks]
    grown, on_gpu = (
        DENSIFIED_GROWTH if tune.densify is not None else 1.0,
        gpu_point_bytes(blocks[0].run.out, len(model.points)),
    )
    least, most = ([points.bytes(each, each / 3, times) for points in begins] for times in (1.0, grown))
    return Forecast(
        steps=sum(steps),
        seconds=sum(count * points.pace for count, points in zip(steps, begins, strict=True))
        * (model.seconds / max(1, model.index)),
        least_bytes=sum(max(0, size - found) for size, found in zip(least, there, strict=True)),
        disk_bytes=sum(max(0, CHECKPOINTS_PER_BLOCK * size - found) for size, found in zip(most, there, strict=True))
        + int(CHECKPOINTS_PER_BLOCK * grown * whole),  # of the blocks, and of all when they are merged
        memory_bytes=max(memory, default=0),
        gpu_bytes=max(points.bytes(on_gpu, on_gpu / 2, grown) for points in begins),
    )


def gpu_point_bytes(out: Path, points: int) -> float:
    """Bytes of a GPU that each of `points` points of the coarse model took, without photographs; 0 without a GPU."""
    held = read_record(out).get("gpu_memory_bytes") or {}
    return (held.get("peak", 0) - held.get("photographs", 0)) / max(1, points)


def checkpoint_bytes(block: BlockRun) -> int:
    """Bytes of the existing checkpoints of a block."""
    folder = block.stage.folder
    return sum(path.stat().st_size for path in folder.glob("*.safetensors")) if folder.exists() else 0


def report_forecast(out: Path, found: Forecast) -> None:
    """Print what blocks will take, and warn where that is more than there is; `out` is the run folder.

    Raises:
        BadInput: The disk is certainly too small.
    """
    disk, memory = shutil.disk_usage(out).free, free_bytes()
    text = (
        f"{found.steps:,} steps to tune, about {clock(found.seconds)} at the speed of the coarse model; "
        f"checkpoints take about {size(found.disk_bytes)} of disk, {size(disk)} are free"
    )
    if found.memory_bytes:
        text += f"; a block needs up to {size(found.memory_bytes)} of memory, {size(memory)} are free"
    if found.gpu_bytes:
        text += f"; a block needs up to {size(found.gpu_bytes)} of the memory of its GPU"
    say(f"{text}; merging the blocks and making the mesh come on top")
    if found.least_bytes > disk:
        raise BadInput(
            f"{out}: the blocks need at least {size(found.least_bytes)} of disk for their checkpoints, and "
            f"{size(disk)} are free; make room, and give the same command again"
        )
    if found.disk_bytes > disk:
        emit(
            Warned(
                f"the blocks may need about {size(found.disk_bytes)} of disk, and {size(disk)} are free; make room "
                "while they are trained, or they stop at their last checkpoints, and the same command continues them"
            )
        )
    if found.memory_bytes > memory:
        emit(
            Warned(
                f"a block may need about {size(found.memory_bytes)} of memory, and {size(memory)} are free; if it "
                "runs out, the block is tried again with less, with a warning; more blocks need less each"
            )
        )
