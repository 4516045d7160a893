"""The blocks of a large scene: planned, tuned apart by whoever has hands free, and merged (CityGaussianV2, sec. 3.3).

The folder of the run is the contract: `blocks/plan.json` says what is cut how, `blocks/NNN/` holds what one block has
come to, and whoever comes back to it goes on from there.
"""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from surfkit.blocks.display import BlockDisplay, BlockProgress, state_since
from surfkit.blocks.forecast import memory_of, need, tell
from surfkit.blocks.merge import put_together
from surfkit.blocks.oom_retry import next_fallback
from surfkit.blocks.worker import BUSY, FULL, coarse_model, coarse_model_of, guarded
from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import FileWritten, Warned, emit, say
from surfkit.core.files import sweep
from surfkit.execute import base as executor
from surfkit.execute.base import Executor, Inline, JobResult
from surfkit.execute.remote import POLL_S
from surfkit.execute.state import STALE_S, heard_elsewhere, read_state, worked_on, write_state
from surfkit.partition.picture import plan_picture
from surfkit.partition.plan import Fewest, Plan, plan
from surfkit.raster.select import Device
from surfkit.readers import extract
from surfkit.readers.depth_prior import alignment
from surfkit.run.context import RunContext
from surfkit.run.folder import Run, discard_results, relay
from surfkit.run.notes import naming
from surfkit.scene.memory import oom_kills
from surfkit.train import checkpoint
from surfkit.train.faults import DiskFull
from surfkit.train.material import needs_normals, needs_priors
from surfkit.train.stage import StageState
from surfkit.train.streaming import Stored

ATTEMPTS = 3
"""How often a block is begun in one command before it counts as failed."""
PROGRAM_BYTES, PIXEL_BYTES = 400 << 20, 150
"""What a process takes beside its points, as far as it can be told before: for itself, and for each pixel of a
photograph."""
STARVED = ("OUT_OF_MEMORY", "OutOfMemoryError")
"""How Slurm and Ray say that memory gave out."""
LEAVE_S = 20.0
"""How long workers of a driver that is gone may take to notice."""
PATIENCE_S = STALE_S + LEAVE_S
"""How long a worker on another machine waits for one before it, whose machine may be gone."""
ARRIVE_S = 90.0
"""How long what was written on another machine may take until it is seen here."""


@dataclass(frozen=True)
class Compute:
    """Who computes.

    Attributes:
        device: Where.
        workers: Who tunes the blocks, where the recipe cuts the scene into some.
        tensorboard: Whether workers in processes of their own write scalars for TensorBoard.
    """

    device: Device = "auto"
    workers: Executor = Inline()
    tensorboard: bool = False


class Unfinished(Fault):
    """Some blocks are not tuned; the others are, and stay so."""

    status = 3


@dataclass(frozen=True)
class Record:
    """The plan on disk.

    Attributes:
        coarse_steps: Of the coarse model that it was made for.
        plan: Cells and blocks.
    """

    coarse_steps: int
    plan: Plan


def tune_blocks(ctx: RunContext, compute: Compute) -> tuple[Run, StageState]:
    """The run with the state of all blocks together; what is done already is not done again.

    Args:
        ctx: Run, data and means; the coarse model is in its folder.
        compute: Who tunes the blocks.

    Raises:
        Unfinished: Blocks failed, also when they were tried again.
        KeyboardInterrupt: Someone asked to stop; every block has saved its state.
    """
    final = replace(ctx.run, part="tune")
    if not ctx.folder.exists() and (state := whole(final)):  # deleted to make room
        return final, state
    coarse = coarse_model(ctx.run)
    sweep(ctx.folder, deep=False)  # a block's own folder is its worker's
    record = planned(ctx, coarse)
    state = merged(ctx, record)
    if state is not None:
        return final, state
    discard_results(final)
    while state is None:
        await_workers(ctx)
        foresee(ctx, record.plan, coarse, compute)
        extract_views(ctx, record.plan)
        work(ctx, record.plan, compute)
        for folder in ctx.folders():  # also of blocks that were tuned by hand
            relay(ctx.run.out, folder, f"block {int(folder.name)}: ")
        if put_together(ctx, record.plan, coarse):
            state = checkpoint.load(final.checkpoint)
    return final, state


def planned(ctx: RunContext, coarse: Stored) -> Record:
    """The plan in the folder, or a new one; blocks of another coarse model are put aside."""
    path = ctx.folder / "plan.json"
    if path.exists():
        record = read_json(path, Record)
        known = {view.name for view in ctx.scene.train}
        if unknown := {name for block in record.plan.blocks for name in block.views} - known:
            raise BadInput(f"{path}: names a view that is not there, {min(unknown)}; delete {ctx.folder} to plan again")
        if record.coarse_steps == coarse.state.index:
            return record
    if ctx.folders():  # of another coarse model, or of a plan that is gone
        await_workers(ctx)
        aside = put_aside(ctx)
        checkpoint.discard(replace(ctx.run, part="tune").checkpoint)
        emit(Warned(f"the coarse model or the plan has changed: blocks are tuned anew; the ones before are in {aside}"))
    recipe = ctx.run.recipe
    sight = coarse_model_of(ctx, checkpoint.load(coarse.path))
    made = Record(coarse.state.index, plan(sight, recipe.partition, recipe.assign, Fewest(recipe.min_views)))
    picture = ctx.folder / "plan.png"
    plan_picture(picture, sight, made.plan)
    emit(FileWritten(picture, "picture of the blocks"))
    write_json(path, made)
    emit(FileWritten(path, "plan of the blocks"))
    for block in made.plan.blocks:
        say(
            f"block {block.index}: {len(block.views)} views, {block.cameras} of them inside; {block.points:,} points; "
            f"{block.work:.0%} of the work" + ("" if block.views else "; stays as it is")
        )
    return made


def extract_views(ctx: RunContext, blocks: Plan) -> None:
    """Write the views of each block into its folder, with the alignment of their depth priors if a loss asks for any.

    The priors are aligned as those of the whole scene: a block's own views would give another scale to its loss, and
    another judgement of failed alignments.
    """
    missing = [block for block in blocks.blocks if block.views and not extract.is_whole(ctx.views(block.index))]
    priors = None
    if missing and needs_priors(losses := ctx.run.recipe.tune.losses):
        with naming("blocks: "):  # what the coarse stage has said already is not said again
            priors = alignment(ctx.run.data, ctx.scene, needs_normals(losses))
    for block in missing:
        extract.save(ctx.views(block.index), extract.of(ctx.scene, block.views, priors))


def put_aside(ctx: RunContext) -> Path:
    """Rename the folder of the blocks, and leave alone what was put aside before; its new name."""
    names = itertools.chain(["blocks-before"], (f"blocks-before-{number}" for number in itertools.count(2)))
    aside = next(path for path in (ctx.run.out / name for name in names) if not path.exists())
    os.replace(ctx.folder, aside)
    return aside


def merged(ctx: RunContext, record: Record) -> StageState | None:
    """The state of all blocks together, if it was made and none has been tuned for longer since."""
    return whole(replace(ctx.run, part="tune")) if done(ctx, record.plan) else None


def whole(final: Run) -> StageState | None:
    """The state of all blocks together that is in the folder, if any; further steps of the coarse model delete it."""
    found = checkpoint.load_last(final.checkpoint)
    return None if found is None or found[0].index < final.stage.steps else found[0]


def done(ctx: RunContext, blocks: Plan) -> bool:
    """Whether every block has all its steps."""
    return not left(ctx, blocks)


def left(ctx: RunContext, blocks: Plan) -> list[int]:
    """Blocks that still have steps to make."""
    steps = ctx.run.recipe.tune.steps
    found = []
    for block in blocks.blocks:
        state = read_state(ctx.place(block.index))
        if block.views and not (state.status == "done" and state.step >= steps):
            found.append(block.index)
    return found


def await_workers(ctx: RunContext) -> None:
    """Wait for workers of an earlier driver, which stop when they notice that it is gone.

    Those of another machine may have died with it; this shows when they have not been heard of for long enough.
    """
    began = time.monotonic()
    while busy := [folder for folder in ctx.folders() if worked_on(folder)]:
        patience = LEAVE_S + (STALE_S if any(map(heard_elsewhere, busy)) else 0)
        if time.monotonic() - began > patience:
            raise BadInput(f"{busy[0]}: {worked_on(busy[0])} works on the block; wait for its end, or stop it")
        time.sleep(POLL_S)


def foresee(ctx: RunContext, blocks: Plan, coarse: Stored, compute: Compute) -> None:
    """Say what the blocks that are left will take; BadInput if there is certainly no room for them."""
    indices, here = left(ctx, blocks), compute.workers.at_once is not None
    memory = [job_of(ctx, blocks, index, compute).memory_bytes for index in indices] if here else []
    if indices:
        tell(ctx, need(ctx, [blocks.blocks[index] for index in indices], coarse.state, memory))


def work(ctx: RunContext, blocks: Plan, compute: Compute) -> None:
    """Have all blocks tuned that are not.

    One that crashes is tried again, and one whose memory gave out too, with less and with the machine for itself.
    """
    waiting = left(ctx, blocks)
    attempts, kills = dict.fromkeys(waiting, 0), oom_kills()
    look = looking(ctx, compute, waiting)
    failed: dict[int, str] = {}
    while waiting:
        batch = [index for index in waiting if not short(ctx, index)]
        batch = batch or (waiting[:1] if (compute.workers.at_once or 1) > 1 else list(waiting))
        waiting = [index for index in waiting if index not in batch]
        say(f"{len(batch)} of {len(blocks.blocks)} blocks to tune")
        for ended in done_by(compute, [job_of(ctx, blocks, index, compute) for index in batch], look):
            index = ended.job.index
            attempts[index] += 1
            relay(ctx.run.out, ctx.place(index), f"block {index}: ")
            if ended.status == 0 and arrived(ctx, blocks, index):
                say(f"block {index} is done; {look().heading()}")
                continue
            starved = ended.status == -signal.SIGKILL and oom_kills() > kills
            kills += starved
            reason = told(ctx, ended, starved)
            if ended.status == FULL:
                raise DiskFull(ctx.place(index), f"block {index} {reason}")
            again = another_way(ctx, index, ended.status, attempts[index])
            emit(Warned(f"block {index} {reason}" + (f"; {again}" if again else "")))
            if again:
                waiting.append(index)
            else:
                failed[index] = reason
    if failed:
        what = "; ".join(f"block {index} {reason}" for index, reason in sorted(failed.items()))
        if any(short(ctx, index) for index in failed):
            what += "; more blocks or smaller photographs need less memory, in a folder of their own"
        raise Unfinished(f"{ctx.run.out}: {what}; the others are done, and the same command tries these again")


def arrived(ctx: RunContext, blocks: Plan, index: int) -> bool:
    """Whether a block that is done somewhere is so here; a network's file system may take a while."""
    until = time.monotonic() + ARRIVE_S
    while index in left(ctx, blocks):
        if time.monotonic() > until:
            return False
        time.sleep(POLL_S)
    return True


def done_by(compute: Compute, jobs: Sequence[executor.Job], look: Callable[[], BlockProgress]) -> Iterator[JobResult]:
    """The jobs as they end; where others do them, it is shown how far they are."""
    shown = nullcontext() if isinstance(compute.workers, Inline) else BlockDisplay(look)
    with shown, closing(compute.workers.run(jobs)) as ended:
        yield from ended


def looking(ctx: RunContext, compute: Compute, indices: Iterable[int]) -> Callable[[], BlockProgress]:
    """What tells where blocks stand that are tuned from now on."""
    since, indices = time.time(), tuple(indices)

    def look() -> BlockProgress:
        states = {index: state_since(ctx.place(index), since) for index in indices}
        return BlockProgress(states, ctx.run.recipe.tune.steps, compute.workers.at_once or len(indices))

    return look


def short(ctx: RunContext, index: int) -> bool:
    """Whether memory gave out when a block was last worked on."""
    return read_state(ctx.place(index)).kind == "oom"


def another_way(ctx: RunContext, index: int, status: int, attempts: int) -> str | None:
    """How a block that failed is tried again, in a few words; None if it is not."""
    if short(ctx, index):
        fallback = next_fallback(read_state(ctx.place(index)), ctx.run.recipe.tune.densify)
        return f"it is tried again: {fallback.text}" if fallback else None
    return "it is tried again" if status not in (1, 2) and attempts < ATTEMPTS else None


def told(ctx: RunContext, ended: JobResult, starved: bool = False) -> str:
    """What became of a block, in a few words; also noted in its state.

    `starved`: the system has ended processes for want of memory meanwhile.
    """
    index, status = ended.job.index, ended.status
    state = read_state(ctx.place(index))
    if ended.why is not None or status == 0:
        why = ended.why or f"nothing of its work has come to {ctx.place(index)}"
        kind = "oom" if any(word in why for word in STARVED) else "data" if status == 2 else "crash"
        if not heard_elsewhere(ctx.place(index)):  # it may only be cut off, and the next one must wait for its end
            write_state(ctx.place(index), status="failed", kind=kind, error=why)
        return f"failed: {why}"
    if status < 0:
        error = f"ended by {signal.Signals(-status).name}" + " while memory ran out on this machine" * starved
        write_state(ctx.place(index), status="failed", kind="oom" if starved else "crash", error=error)
        return f"was {error}"
    if status == BUSY:
        return "is worked on by another process"
    if state.status != "failed":
        log = ctx.place(index) / executor.LOG
        write_state(ctx.place(index), status="failed", kind="crash", error=f"exit status {status}")
        return f"ended with status {status}; see {log}"
    return f"failed: {state.error}"


def job_of(ctx: RunContext, blocks: Plan, index: int, compute: Compute) -> executor.Job:
    """The work on one block."""
    block = blocks.blocks[index]
    elsewhere = compute.workers.at_once is None
    share = ctx.caches.bytes() // (compute.workers.at_once or 1)
    command = ["-m", "surfkit.cli", "tune", str(ctx.run.out.resolve()), str(index), "--device", compute.device]
    command += ["--cache", ctx.caches.cache if elsewhere else f"{share}"]
    command += ["--checkpoint-every", f"{ctx.intervals.checkpoint}"]
    command += ["--resized-copies"] * ctx.caches.copies + ["--tensorboard"] * compute.tensorboard
    command += ["--patience", f"{PATIENCE_S}"] * elsewhere
    pixels = max(view.camera.width * view.camera.height for view in ctx.scene.train)
    mine = [view for view in ctx.scene.train if view.name in block.views]
    photos = 3 * sum(view.camera.width * view.camera.height for view in mine)
    return executor.Job(
        index=index,
        folder=ctx.place(index),
        call=lambda: guarded(ctx, blocks, index),
        command=tuple(command),
        cost=block.work,
        memory_bytes=PROGRAM_BYTES
        + memory_of(ctx, block)
        + PIXEL_BYTES * pixels
        + (photos if elsewhere and ctx.caches.cache == "auto" else min(share, photos)),
        needs=(ctx.run.data.path, mine[0].path),
    )
