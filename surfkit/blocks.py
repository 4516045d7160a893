"""The blocks of a large scene: planned, tuned apart by whoever has hands free, and merged (CityGaussianV2, sec. 3.3).

The folder of the run is the contract: `blocks/plan.json` says what is cut how, `blocks/NN/` holds what one block has
come to, and whoever comes back to it goes on from there.
"""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json, write_json
from surfkit.core.errand import POLL_S
from surfkit.core.events import FileWritten, Warned, emit, say
from surfkit.folder import Run, discard
from surfkit.partition import executor
from surfkit.partition.executor import Executor, Inline
from surfkit.partition.merge import Share, merge
from surfkit.partition.picture import plan_picture
from surfkit.partition.plan import Fewest, Plan, plan
from surfkit.partition.state import STALE_S, heard_elsewhere, read_state, worked_on, write_state
from surfkit.primitives.points import Points
from surfkit.raster.select import Device
from surfkit.train import checkpoint
from surfkit.train.look import fresh_looks
from surfkit.train.stage import StageState
from surfkit.train.views import Order
from surfkit.tuning import BUSY, Site, guarded, sight_of

ATTEMPTS = 3
"""How often a block is begun in one command before it counts as failed."""
PROGRAM_BYTES, POINT_BYTES, COARSE_BYTES, PIXEL_BYTES = 400 << 20, 3_000, 700, 150
"""What a process takes, as far as it can be told before: for itself, for each point that it may come to have (values,
moments, gradients, records of the rasterizer), for each of the coarse model, and for each pixel of a photograph."""
LEAVE_S = 20.0
"""How long workers of a driver that is gone may take to notice."""
PATIENCE_S = STALE_S + LEAVE_S
"""How long a worker on another machine waits for one before it, whose machine may be gone."""
ARRIVE_S = 90.0
"""How long what was written on another machine may take until it is seen here."""


@dataclass(frozen=True)
class Hands:
    """Who computes.

    Attributes:
        device: Where.
        workers: Who tunes the blocks, where the recipe cuts the scene into some.
    """

    device: Device = "auto"
    workers: Executor = Inline()


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


def tuned(site: Site, coarse: StageState, hands: Hands) -> tuple[Run, StageState]:
    """The run with the state of all blocks together; what is done already is not done again.

    Args:
        site: Run, data and means.
        coarse: The state after pretraining.
        hands: Who tunes the blocks.

    Raises:
        Unfinished: Blocks failed, also when they were tried again.
        KeyboardInterrupt: Someone asked to stop; every block has saved its state.
    """
    final = replace(site.this, part="tune")
    record = planned(site, coarse)
    state = merged(site, record)
    if state is not None:
        return final, state
    discard(final.metrics, final.cloud, final.mesh_record)
    while state is None:
        await_workers(site)
        work(site, record.plan, hands)
        state = put_together(site, record.plan, coarse)
    checkpoint.save(final.checkpoint, state)
    emit(FileWritten(final.checkpoint, "merged blocks"))
    return final, state


def planned(site: Site, coarse: StageState) -> Record:
    """The plan in the folder, or a new one; blocks of another coarse model are put aside."""
    path = site.folder / "plan.json"
    if path.exists():
        record = read_json(path, Record)
        known = {view.name for view in site.scene.train}
        if unknown := {name for block in record.plan.blocks for name in block.views} - known:
            raise BadInput(
                f"{path}: names a view that is not there, {min(unknown)}; delete {site.folder} to plan again"
            )
        if record.coarse_steps == coarse.index:
            return record
    if site.folders():  # of another coarse model, or of a plan that is gone
        await_workers(site)
        aside = site.this.out / "blocks-before"
        shutil.rmtree(aside, ignore_errors=True)
        os.replace(site.folder, aside)
        checkpoint.discard(replace(site.this, part="tune").checkpoint)
        emit(Warned(f"the coarse model or the plan has changed: blocks are tuned anew; the ones before are in {aside}"))
    recipe = site.this.recipe
    sight = sight_of(site, coarse)
    made = Record(coarse.index, plan(sight, recipe.partition, recipe.assign, Fewest(recipe.min_views)))
    picture = site.folder / "plan.png"
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


def merged(site: Site, record: Record) -> StageState | None:
    """The state of all blocks together, if it was made and none has been tuned for longer since."""
    found = checkpoint.load_last(replace(site.this, part="tune").checkpoint)
    if found is None or found[0].index < site.this.recipe.tune.steps or not done(site, record.plan):
        return None
    return found[0]


def done(site: Site, blocks: Plan) -> bool:
    """Whether every block has all its steps."""
    return not left(site, blocks)


def left(site: Site, blocks: Plan) -> list[int]:
    """Blocks that still have steps to make."""
    steps = site.this.recipe.tune.steps
    found = []
    for block in blocks.blocks:
        state = read_state(site.place(block.index))
        if block.views and not (state.status == "done" and state.step >= steps):
            found.append(block.index)
    return found


def await_workers(site: Site) -> None:
    """Wait for workers of an earlier driver, which stop when they notice that it is gone.

    Those of another machine may have died with it; this shows when they have not been heard of for long enough.
    """
    began = time.monotonic()
    while busy := [folder for folder in site.folders() if worked_on(folder)]:
        patience = LEAVE_S + (STALE_S if any(map(heard_elsewhere, busy)) else 0)
        if time.monotonic() - began > patience:
            raise BadInput(f"{busy[0]}: {worked_on(busy[0])} works on the block; wait for its end, or stop it")
        time.sleep(POLL_S)


def work(site: Site, blocks: Plan, hands: Hands) -> None:
    """Have all blocks tuned that are not; one that crashes is tried again."""
    attempts = dict.fromkeys(left(site, blocks), 0)
    waiting = list(attempts)
    failed: dict[int, str] = {}
    while waiting:
        jobs = [job_of(site, blocks, index, hands) for index in waiting]
        say(f"{len(jobs)} of {len(blocks.blocks)} blocks to tune")
        waiting = []
        for ended in hands.workers.run(jobs):
            index = ended.job.index
            attempts[index] += 1
            if ended.status == 0 and arrived(site, blocks, index):
                say(f"block {index} is done")
                continue
            reason = told(site, ended)
            again = ended.status not in (1, 2) and attempts[index] < ATTEMPTS
            emit(Warned(f"block {index} {reason}" + ("; it is tried again" if again else "")))
            if again:
                waiting.append(index)
            else:
                failed[index] = reason
    if failed:
        what = "; ".join(f"block {index} {reason}" for index, reason in sorted(failed.items()))
        raise Unfinished(f"{site.this.out}: {what}; the others are done, and the same command tries these again")


def arrived(site: Site, blocks: Plan, index: int) -> bool:
    """Whether a block that is done somewhere is so here; a network's file system may take a while."""
    until = time.monotonic() + ARRIVE_S
    while index in left(site, blocks):
        if time.monotonic() > until:
            return False
        time.sleep(POLL_S)
    return True


def told(site: Site, ended: executor.Ended) -> str:
    """What became of a block, in a few words; also noted in its state."""
    index, status = ended.job.index, ended.status
    state = read_state(site.place(index))
    if ended.why is not None or status == 0:
        why = ended.why or f"nothing of its work has come to {site.place(index)}"
        if not heard_elsewhere(site.place(index)):  # it may only be cut off, and the next one must wait for its end
            write_state(site.place(index), status="failed", kind="data" if status == 2 else "crash", error=why)
        return f"failed: {why}"
    if status < 0:
        name = signal.Signals(-status).name
        write_state(site.place(index), status="failed", kind="crash", error=f"ended by {name}")
        return f"was ended by {name}"
    if status == BUSY:
        return "is worked on by another process"
    if state.status != "failed":
        log = site.place(index) / executor.LOG
        write_state(site.place(index), status="failed", kind="crash", error=f"exit status {status}")
        return f"ended with status {status}; see {log}"
    return f"failed: {state.error}"


def job_of(site: Site, blocks: Plan, index: int, hands: Hands) -> executor.Job:
    """The work on one block."""
    block = blocks.blocks[index]
    elsewhere = hands.workers.at_once is None
    share = site.store.bytes() // (hands.workers.at_once or 1)
    command = ["-m", "surfkit.cli", "tune", str(site.this.out.resolve()), str(index), "--device", hands.device]
    command += ["--cache", site.store.cache if elsewhere else f"{share}"]
    command += ["--checkpoint-every", f"{site.every.checkpoint}"]
    command += ["--resized-copies"] * site.store.copies
    command += ["--patience", f"{PATIENCE_S}"] * elsewhere
    pixels = max(view.camera.width * view.camera.height for view in site.scene.train)
    mine = [view for view in site.scene.train if view.name in block.views]
    photos = 3 * sum(view.camera.width * view.camera.height for view in mine)
    growth = 1 if site.this.recipe.tune.densify is None else 3
    return executor.Job(
        index=index,
        folder=site.place(index),
        call=lambda: guarded(site, blocks, index),
        command=tuple(command),
        cost=block.work,
        memory_bytes=PROGRAM_BYTES
        + growth * POINT_BYTES * block.points
        + COARSE_BYTES * sum(other.points for other in blocks.blocks)
        + PIXEL_BYTES * pixels
        + (photos if elsewhere and site.store.cache == "auto" else min(share, photos)),
        needs=(site.this.data.path, mine[0].path),
    )


def put_together(site: Site, blocks: Plan, coarse: StageState) -> StageState | None:
    """All blocks as one state, each point from its owner; where nothing was tuned, from the coarse model.

    None if a result is not what its state says; that block is planned again.
    """
    recipe = site.this.recipe
    tune_stage, params = recipe.tune, recipe.pretrain.finished(coarse)
    skipped = frozenset(block.index for block in blocks.blocks if not block.views)
    states: dict[int, StageState] = {}
    for index in range(len(blocks.blocks)):
        if index not in skipped and (state := sound(site, index)) is not None:
            states[index] = state
    if len(states) + len(skipped) < len(blocks.blocks):
        return None
    results = {index: tune_stage.finished(state) for index, state in states.items()}
    whole, shares = merge(blocks.cells, params, results, skipped)
    note(site, shares)
    state = StageState(Points.fresh(whole), Order(len(site.scene.train)), torch.Generator().manual_seed(recipe.seed))
    state.index = tune_stage.steps
    state.seconds = coarse.seconds + sum(part.seconds for part in states.values())
    state.cpu_seconds = coarse.cpu_seconds + sum(part.cpu_seconds for part in states.values())
    state.peak_memory_bytes = max(part.peak_memory_bytes for part in (coarse, *states.values()))
    state.sh_degree = max(part.sh_degree for part in (coarse, *states.values()))
    if tune_stage.appearance is not None:  # the blocks' own are folded into their colours
        state.looks = fresh_looks(tune_stage.appearance, len(site.scene.train))
    return state


def sound(site: Site, index: int) -> StageState | None:
    """The result of a block; None, and the block planned again, if it is damaged or has not all its steps."""
    path, steps = site.block(index).checkpoint, site.this.recipe.tune.steps
    try:
        found = checkpoint.load_last(path)
    except BadInput as error:
        emit(Warned(f"block {index} is tuned from its beginning again: {error}"))
        checkpoint.discard(path)
        found = None
    if found is not None and found[0].index >= steps:
        return found[0]
    emit(Warned(f"block {index} has lost steps: its checkpoint is of {found[0].index if found else 0}, not of {steps}"))
    write_state(site.place(index), status="planned", step=found[0].index if found else 0)
    return None


def note(site: Site, shares: Sequence[Share]) -> None:
    """Write down what each block gave, and say where the coarse model had to fill in."""
    write_json(site.folder / "merge.json", {"blocks": shares, "points": sum(share.kept for share in shares)})
    if filled := [str(share.index) for share in shares if share.filled]:
        emit(Warned(f"blocks {', '.join(filled)} have no views, and are as they were in the coarse model"))
