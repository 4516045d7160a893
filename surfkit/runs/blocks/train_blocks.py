"""The blocks of a large scene: planned, trained by an executor, and merged (CityGaussianV2, sec. 3.3).

The files in the run folder are all that connects the processes: `blocks/plan.json` has the plan, and `blocks/NNN/` the
state and the checkpoints of one block, from which any process continues.
"""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import write_json
from surfkit.core.events import FileWritten, Warned, emit, say
from surfkit.core.files import sweep
from surfkit.io.datasets import extract
from surfkit.io.datasets.depth_prior import alignment
from surfkit.io.datasets.read import observations
from surfkit.partition.partition_picture import plan_picture
from surfkit.partition.plan import BlockMinimums, plan
from surfkit.raster.select import Device
from surfkit.runs.blocks.block import (
    BlockRun,
    BlocksRecord,
    load_blocks,
    plan_file,
    read_plan,
    started_folders,
    unfinished,
)
from surfkit.runs.blocks.block_display import BlockDisplay, BlockProgress, read_state_since
from surfkit.runs.blocks.block_forecast import forecast, point_memory, report_forecast
from surfkit.runs.blocks.merge_blocks import merge_blocks, open_result
from surfkit.runs.blocks.oom_retry import next_fallback
from surfkit.runs.blocks.rounds import end_round
from surfkit.runs.blocks.worker import (
    BUSY_STATUS,
    DISK_FULL_STATUS,
    activate_coarse_model,
    open_coarse_model,
    train_block,
)
from surfkit.runs.context import RunContext
from surfkit.runs.execute.base import LOG, Executor, Inline, Job, JobResult
from surfkit.runs.execute.block_state import STALE_S, find_remote_worker, find_worker
from surfkit.runs.execute.remote import CHILD_POLL_S
from surfkit.runs.folder import Run, discard_results
from surfkit.runs.run_notes import prefix_notes, repeat_warnings
from surfkit.train import checkpoint
from surfkit.train.data_cache import needs_normals, needs_priors, scale_band
from surfkit.train.faults import DiskFull
from surfkit.train.state import StageState
from surfkit.train.streaming import StoredState

MAX_ATTEMPTS = 3
"""How often a block is started in one command before it counts as failed."""
PROGRAM_BYTES, TRAINING_PIXEL_BYTES = 400 << 20, 150
"""Memory of a process beside its points: of the program, and for each pixel of a photograph."""
WORKER_EXIT_S = 20.0
"""Seconds in which the workers of a driver that is gone notice that and end."""
WORKER_PATIENCE_S = STALE_S + WORKER_EXIT_S
"""Seconds that a worker on another machine waits for an earlier one, whose machine may be lost."""
FILE_ARRIVAL_S = 90.0
"""Seconds until files written on another machine are visible here."""


@dataclass(frozen=True)
class Compute:
    """What computes a run.

    Attributes:
        device: The device.
        workers: The executor of the blocks, where the recipe has a partition.
        tensorboard: Whether workers in processes of their own write scalars for TensorBoard.
        processes: How many train the whole scene together (`runs.divided`); 1 is this one alone.
    """

    device: Device = "auto"
    workers: Executor = Inline()
    tensorboard: bool = False
    processes: int = 1


class Unfinished(Fault):
    """Some blocks have failed; the others are done and are kept."""

    status = 3


def tune_blocks(ctx: RunContext, compute: Compute, optimise_partition: Callable[[Run], None]) -> StageState:
    """The state of all blocks together; what is done already is not done again.

    Args:
        ctx: The run; the coarse model is in its folder.
        compute: What trains the blocks.
        optimise_partition: Optimises the model that decides the partition, given its run, where the recipe has one.

    Raises:
        Unfinished: Blocks failed, also when they were tried again.
        KeyboardInterrupt: The user asked to stop; every block has saved its state.
    """
    run = ctx.run
    if not run.blocks.exists() and (state := load_merged(run)):  # the blocks were deleted to free disk space
        return state
    coarse = open_coarse_model(run)
    sweep(run.blocks, deep=False)  # in the folder of a block, only its worker may delete files
    record = load_or_make_plan(ctx, coarse, optimise_partition)
    ctx.keep("plan")
    if not unfinished(load_blocks(run, record.plan)) and (state := load_merged(run)):
        return state
    discard_results(run, run.merged)
    while True:
        await_workers(run)
        blocks = load_blocks(run, record.plan)
        train_all(ctx, blocks, coarse, compute)
        for folder in started_folders(run):  # also of blocks that were trained by hand
            repeat_warnings(run.out, folder, f"block {int(folder.name)}: ")
        if merge_blocks(ctx, blocks, coarse):
            ctx.keep("tune")
            return checkpoint.load(run.merged.checkpoint)


def load_or_make_plan(ctx: RunContext, coarse: StoredState, optimise_partition: Callable[[Run], None]) -> BlocksRecord:
    """The plan in the folder, or a new one; blocks of another coarse model are renamed."""
    run, path = ctx.run, plan_file(ctx.run)
    if path.exists():
        record = read_plan(run)
        known = {view.name for view in ctx.scene.train}
        if unknown := {name for block in record.plan.blocks for name in block.views} - known:
            raise BadInput(f"{path}: names a view that is not there, {min(unknown)}; delete {run.blocks} to plan again")
        if record.coarse_steps == coarse.state.index:
            return record
    if started_folders(run):  # of another coarse model, or of a plan that is gone
        await_workers(run)
        aside = rename_blocks(run)
        checkpoint.discard(run.merged.checkpoint)
        emit(Warned(f"the coarse model or the plan has changed: blocks are tuned anew; the ones before are in {aside}"))
    if ctx.run.partition is not None:
        optimise_partition(ctx.run.partition)
    return make_plan(ctx, coarse)


def make_plan(ctx: RunContext, coarse: StoredState) -> BlocksRecord:
    """Plan the blocks, and write the plan and its picture."""
    recipe, path = ctx.run.recipe, plan_file(ctx.run)
    assert recipe.partition is not None, "only a recipe with a partition has blocks"
    model = sight = activate_coarse_model(ctx, checkpoint.load(coarse.path))
    if (other := ctx.run.partition) is not None:
        sight = activate_coarse_model(replace(ctx, run=other), checkpoint.load(open_coarse_model(other).path))
    if recipe.assign.needs_observations:
        sight = replace(sight, observations=observations(ctx.run.data, ctx.scene))
    made = plan(sight, recipe.partition, recipe.assign, BlockMinimums(recipe.min_views), model)
    record = BlocksRecord(coarse.state.index, made)
    picture = ctx.run.blocks / "plan.png"
    plan_picture(picture, model, record.plan)
    emit(FileWritten(picture, "picture of the blocks"))
    write_json(path, record)
    emit(FileWritten(path, "plan of the blocks"))
    for block in record.plan.blocks:
        say(
            f"block {block.index}: {len(block.views)} views, {block.cameras} of them inside; {block.points:,} points; "
            f"{block.work:.0%} of the work" + ("" if block.views else "; stays as it is")
        )
    return record


def rename_blocks(run: Run) -> Path:
    """Rename the folder of the blocks to a free name, and return it."""
    names = itertools.chain(["blocks-before"], (f"blocks-before-{number}" for number in itertools.count(2)))
    aside = next(path for path in (run.out / name for name in names) if not path.exists())
    os.replace(run.blocks, aside)
    return aside


def load_merged(run: Run) -> StageState | None:
    """The state of all blocks together, if it is in the folder; further steps of the coarse model delete it."""
    found = checkpoint.load_last(run.merged.checkpoint)
    return None if found is None or found[0].index < run.merged.stage.steps else found[0]


def await_workers(run: Run) -> None:
    """Wait for workers of an earlier driver, which end when they notice that it is gone.

    Those of another machine may have been lost with it, which shows when they send no heartbeat for long enough.

    Raises:
        BadInput: One does not end.
    """
    began, patience = time.monotonic(), WORKER_EXIT_S
    while busy := {folder: worker for folder in started_folders(run) if (worker := find_worker(folder))}:
        if any(map(find_remote_worker, busy)):
            patience = WORKER_EXIT_S + STALE_S
        if time.monotonic() - began > patience:
            folder, worker = next(iter(busy.items()))
            raise BadInput(f"{folder}: {worker} works on the block; wait for its end, or stop it")
        time.sleep(CHILD_POLL_S)


def train_all(ctx: RunContext, blocks: Sequence[BlockRun], coarse: StoredState, compute: Compute) -> None:
    """Train all blocks that are not done, after a forecast of what that takes.

    Raises:
        BadInput: There is certainly no room for them.
        Unfinished: Blocks failed, also when they were tried again.
    """
    waiting = unfinished(blocks)
    if waiting:
        here = compute.workers.at_once is not None
        memory = [job_of(ctx, block, compute).memory_bytes for block in waiting] if here else []
        report_forecast(ctx.run.out, forecast(waiting, coarse, memory))
    extract_views(ctx, blocks)
    train_waiting(ctx, waiting, compute, len(blocks))
    while (goal := blocks[0].goal) < ctx.run.recipe.tune.steps:
        results = {block: open_result(block, goal) for block in blocks if block.planned.views}
        ready = [stored for stored in results.values() if stored is not None]
        if len(ready) == len(results):
            end_round(blocks, ready)
        train_waiting(ctx, unfinished(blocks), compute, len(blocks))


def extract_views(ctx: RunContext, blocks: Sequence[BlockRun]) -> None:
    """Write the views of each block into its folder, with the alignment of their depth priors if a loss needs any.

    The priors are aligned as those of the whole scene: with the views of a block alone, their scale would differ, and
    so would the choice of those whose alignment has failed.
    """
    missing = [block for block in blocks if block.planned.views and not extract.is_whole(block.views_file)]
    priors = None
    if missing and needs_priors(losses := ctx.run.recipe.tune.losses):
        with prefix_notes("blocks: "):  # warnings of the coarse stage are not repeated
            priors = alignment(ctx.run.data, ctx.scene, needs_normals(losses), scale_band(losses))
    for block in missing:
        extract.save(block.views_file, extract.of(ctx.scene, block.planned.views, priors))


def train_waiting(ctx: RunContext, waiting: list[BlockRun], compute: Compute, total: int) -> None:
    """Train the blocks of a list, of a `total` number; those that fail are tried again.

    A block that ran out of memory is tried again when the others have ended, with less, and with no other beside it.
    """
    attempts = {block.index: 0 for block in waiting}
    look = watch_progress(ctx, compute, waiting)
    failed: dict[BlockRun, str] = {}
    while waiting:
        batch = [block for block in waiting if not block.is_out_of_memory]
        batch = batch or (waiting[:1] if (compute.workers.at_once or 1) > 1 else list(waiting))
        waiting = [block for block in waiting if block not in batch]
        say(f"{len(batch)} of {total} blocks to tune")
        with closing(run_jobs(ctx, batch, compute, look)) as ended:
            for block, result in ended:
                attempts[block.index] += 1
                repeat_warnings(ctx.run.out, block.folder, f"block {block.index}: ")
                if result.status == 0 and has_arrived(block):
                    what = "is done" if block.state.status == "done" else f"is at step {block.state.step:,}"
                    say(f"block {block.index} {what}; {look().summary()}")
                    continue
                reason = record_failure(block, result)
                if result.status == DISK_FULL_STATUS:
                    raise DiskFull(block.folder, f"block {block.index} {reason}")
                remedy = choose_remedy(block, result.status, attempts[block.index])
                emit(Warned(f"block {block.index} {reason}" + (f"; {remedy}" if remedy else "")))
                if remedy:
                    waiting.append(block)
                else:
                    failed[block] = reason
    if failed:
        raise Unfinished(
            f"{ctx.run.out}: {describe(failed)}; the others are done, and the same command tries these again"
        )


def describe(failed: Mapping[BlockRun, str]) -> str:
    """The blocks that have failed and why, and what helps those that ran out of memory."""
    parts = [f"block {block.index} {failed[block]}" for block in sorted(failed, key=lambda block: block.index)]
    if any(block.is_out_of_memory for block in failed):
        parts.append("more blocks or smaller photographs need less memory, in a folder of their own")
    return "; ".join(parts)


def run_jobs(
    ctx: RunContext, batch: Sequence[BlockRun], compute: Compute, look: Callable[[], BlockProgress]
) -> Generator[tuple[BlockRun, JobResult], None, None]:
    """The blocks of a batch as their jobs end, with their states read again; other processes' progress is shown."""
    by_index = {block.index: block for block in batch}
    jobs = [job_of(ctx, block, compute) for block in batch]
    with (
        nullcontext() if compute.workers.in_process else BlockDisplay(look),
        closing(cast(Generator[JobResult, None, None], compute.workers.run(jobs))) as results,  # see `Executor.run`
    ):
        for result in results:
            block = by_index[result.job.index]
            block.read()
            yield block, result


def has_arrived(block: BlockRun) -> bool:
    """Whether a block that is done on some machine is done here, too; a network file system may take a while."""
    until = time.monotonic() + FILE_ARRIVAL_S
    while not block.is_done:
        if time.monotonic() > until:
            return False
        time.sleep(CHILD_POLL_S)
        block.read()
    return True


def watch_progress(ctx: RunContext, compute: Compute, blocks: Sequence[BlockRun]) -> Callable[[], BlockProgress]:
    """A function that reads the progress which blocks make from now on."""
    since, folders = time.time(), {block.index: block.folder for block in blocks}

    def look() -> BlockProgress:
        states = {index: read_state_since(folder, since) for index, folder in folders.items()}
        return BlockProgress(states, blocks[0].goal, compute.workers.at_once or len(folders))

    return look


def choose_remedy(block: BlockRun, status: int, attempts: int) -> str | None:
    """How a block that failed is tried again, in a few words; None if it is not."""
    if block.is_out_of_memory:
        fallback = next_fallback(block.state, block.run.recipe.tune.densify)
        return f"it is tried again: {fallback.text}" if fallback else None
    return "it is tried again" if status not in (1, 2) and attempts < MAX_ATTEMPTS else None


def record_failure(block: BlockRun, result: JobResult) -> str:
    """The failure of a block in a few words; written into the state of the block, unless its worker has done so."""
    status, kind = result.status, result.kind or "crash"
    if result.why is not None or status == 0:
        why = result.why or f"nothing of its work has come to {block.folder}"
        if not find_remote_worker(block.folder):  # it may only be cut off, and the next worker must wait for its end
            block.write(status="failed", kind=kind, error=why)
        return f"failed: {why}"
    if status < 0:
        error = f"ended by {signal.Signals(-status).name}" + " while memory ran out" * (kind == "oom")
        block.write(status="failed", kind=kind, error=error)
        return f"was {error}"
    if status == BUSY_STATUS:
        return "is worked on by another process"
    if block.state.status != "failed":
        block.write(status="failed", kind=kind, error=f"exit status {status}")
        return f"ended with status {status}; see {block.folder / LOG}"
    return f"failed: {block.state.error}"


def job_of(ctx: RunContext, block: BlockRun, compute: Compute) -> Job:
    """The job that trains one block."""
    elsewhere = compute.workers.at_once is None
    share = ctx.caches.bytes() // (compute.workers.at_once or 1)
    command = [
        "-m",
        "surfkit.cli",
        "train-block",
        str(ctx.run.out.resolve()),
        str(block.index),
        "--device",
        compute.device,
    ]
    command += ["--cache", ctx.caches.cache if elsewhere else f"{share}"]
    command += ["--gpu-cache", ctx.caches.gpu, "--points-on", ctx.caches.points.place]
    if ctx.caches.points.scratch is not None:
        command += ["--scratch", str(ctx.caches.points.scratch.resolve())]
    command += ["--checkpoint-every", f"{ctx.intervals.checkpoint}"]
    command += ["--resized-copies"] * ctx.caches.copies + ["--tensorboard"] * compute.tensorboard
    command += ["--patience", f"{WORKER_PATIENCE_S}"] * elsewhere
    pixels = max(view.camera.width * view.camera.height for view in ctx.scene.train)
    names = set(block.planned.views)
    views = [view for view in ctx.scene.train if view.name in names]
    photos = 3 * sum(view.camera.width * view.camera.height for view in views)
    cached = photos if elsewhere and ctx.caches.cache == "auto" else min(share, photos)
    points = point_memory(block, filed=ctx.caches.points.place == "disk")
    return Job(
        index=block.index,
        folder=block.folder,
        call=lambda: train_block(ctx, block),
        command=tuple(command),
        cost=block.planned.work,
        memory_bytes=PROGRAM_BYTES + points + TRAINING_PIXEL_BYTES * pixels + cached,
        needs=(ctx.run.data.path, views[0].path),
    )
