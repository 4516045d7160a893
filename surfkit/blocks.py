"""The blocks of a large scene: planned, tuned apart by whoever has hands free, and merged (CityGaussianV2, sec. 3.3).

The folder of the run is the contract: `blocks/plan.json` says what is cut how, `blocks/NN/` holds what one block has
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

import torch

from surfkit.board import Board, Standing, state_since
from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import FileWritten, Warned, emit
from surfkit.core.files import sweep
from surfkit.folder import Run, discard, naming, relay, say
from surfkit.foresight import need, tell
from surfkit.ladder import following, lesser
from surfkit.partition import executor
from surfkit.partition.executor import Ended, Executor, Inline
from surfkit.partition.merge import Share, merge
from surfkit.partition.picture import plan_picture
from surfkit.partition.plan import Fewest, Plan, plan
from surfkit.partition.state import read_state, worked_on, write_state
from surfkit.primitives.points import Points
from surfkit.raster.select import Device
from surfkit.scene.memory import oom_kills
from surfkit.train import checkpoint
from surfkit.train.faults import DiskFull
from surfkit.train.look import fresh_looks
from surfkit.train.stage import StageState
from surfkit.train.views import Order
from surfkit.tuning import BUSY, FULL, Site, aligned, guarded, sight_of

ATTEMPTS = 3
"""How often a block is begun in one command before it counts as failed."""
PROGRAM_BYTES, POINT_BYTES, COARSE_BYTES, PIXEL_BYTES = 400 << 20, 3_000, 700, 150
"""What a process takes, as far as it can be told before: for itself, for each point that it may come to have (values,
moments, gradients, records of the rasterizer), for each of the coarse model, and for each pixel of a photograph."""
LEAVE_S = 20.0
"""How long workers of a driver that is gone may take to notice."""


@dataclass(frozen=True)
class Hands:
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
    sweep(site.folder, deep=False)  # a block's own folder is its worker's
    record = planned(site, coarse)
    state = merged(site, record)
    if state is not None:
        return final, state
    discard(final.metrics, final.cloud, final.mesh_record)
    while state is None:
        await_workers(site)
        foresee(site, record.plan, coarse, hands)
        with naming("blocks: "):  # what the coarse stage has said already is not said again
            aligned(site)
        work(site, record.plan, hands)
        for folder in site.folders():  # also of blocks that were tuned by hand
            relay(site.this.out, folder, f"block {int(folder.name)}: ")
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
        aside = put_aside(site)
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


def put_aside(site: Site) -> Path:
    """Rename the folder of the blocks, and leave alone what was put aside before; its new name."""
    names = itertools.chain(["blocks-before"], (f"blocks-before-{number}" for number in itertools.count(2)))
    aside = next(path for path in (site.this.out / name for name in names) if not path.exists())
    os.replace(site.folder, aside)
    return aside


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
    """Wait for workers of an earlier driver, which stop when they notice that it is gone."""
    until = time.monotonic() + LEAVE_S
    while busy := [folder for folder in site.folders() if worked_on(folder)]:
        if time.monotonic() > until:
            raise BadInput(f"{busy[0]}: the block is being worked on; wait for its end, or stop it")
        time.sleep(0.2)


def foresee(site: Site, blocks: Plan, coarse: StageState, hands: Hands) -> None:
    """Say what the blocks that are left will take; BadInput if there is certainly no room for them."""
    indices = left(site, blocks)
    memory = [job_of(site, blocks, index, hands).memory_bytes for index in indices]
    if indices:
        tell(site, need(site, [blocks.blocks[index] for index in indices], coarse, memory))


def work(site: Site, blocks: Plan, hands: Hands) -> None:
    """Have all blocks tuned that are not.

    One that crashes is tried again, and one whose memory gave out too, with less and with the machine for itself.
    """
    waiting = left(site, blocks)
    attempts, kills = dict.fromkeys(waiting, 0), oom_kills()
    look = looking(site, hands, waiting)
    failed: dict[int, str] = {}
    while waiting:
        batch = [index for index in waiting if not short(site, index)]
        batch = batch or (waiting[:1] if hands.workers.at_once > 1 else list(waiting))
        waiting = [index for index in waiting if index not in batch]
        say(f"{len(batch)} of {len(blocks.blocks)} blocks to tune")
        for ended in done_by(hands, [job_of(site, blocks, index, hands) for index in batch], look):
            index = ended.job.index
            attempts[index] += 1
            relay(site.this.out, site.place(index), f"block {index}: ")
            if ended.status == 0:
                say(f"block {index} is done; {look().heading()}")
                continue
            starved = ended.status == -signal.SIGKILL and oom_kills() > kills
            kills += starved
            reason = told(site, index, ended.status, starved)
            if ended.status == FULL:
                raise DiskFull(site.place(index), f"block {index} {reason}")
            again = another_way(site, index, ended.status, attempts[index])
            emit(Warned(f"block {index} {reason}" + (f"; {again}" if again else "")))
            if again:
                waiting.append(index)
            else:
                failed[index] = reason
    if failed:
        what = "; ".join(f"block {index} {reason}" for index, reason in sorted(failed.items()))
        if any(short(site, index) for index in failed):
            what += "; more blocks or smaller photographs need less memory, in a folder of their own"
        raise Unfinished(f"{site.this.out}: {what}; the others are done, and the same command tries these again")


def done_by(hands: Hands, jobs: Sequence[executor.Job], look: Callable[[], Standing]) -> Iterator[Ended]:
    """The jobs as they end; where others do them, it is shown how far they are."""
    shown = nullcontext() if isinstance(hands.workers, Inline) else Board(look)
    with shown, closing(hands.workers.run(jobs)) as ended:
        yield from ended


def looking(site: Site, hands: Hands, indices: Iterable[int]) -> Callable[[], Standing]:
    """What tells where blocks stand that are tuned from now on."""
    since, indices = time.time(), tuple(indices)

    def look() -> Standing:
        states = {index: state_since(site.place(index), since) for index in indices}
        return Standing(states, site.this.recipe.tune.steps, hands.workers.at_once)

    return look


def short(site: Site, index: int) -> bool:
    """Whether memory gave out when a block was last worked on."""
    return read_state(site.place(index)).kind == "oom"


def another_way(site: Site, index: int, status: int, attempts: int) -> str | None:
    """How a block that failed is tried again, in a few words; None if it is not."""
    if short(site, index):
        rung = following(read_state(site.place(index)), site.this.recipe.tune.densify)
        return f"it is tried again: {rung.text}" if rung else None
    return "it is tried again" if status not in (1, 2) and attempts < ATTEMPTS else None


def told(site: Site, index: int, status: int, starved: bool = False) -> str:
    """What became of a block, in a few words; also noted in its state.

    `starved`: the system has ended processes for want of memory meanwhile.
    """
    state = read_state(site.place(index))
    if status < 0:
        error = f"ended by {signal.Signals(-status).name}" + " while memory ran out on this machine" * starved
        write_state(site.place(index), status="failed", kind="oom" if starved else "crash", error=error)
        return f"was {error}"
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
    share = site.store.bytes() // hands.workers.at_once
    command = ["-m", "surfkit.cli", "tune", str(site.this.out.resolve()), str(index), "--device", hands.device]
    command += ["--cache", f"{share}", "--checkpoint-every", f"{site.every.checkpoint}"]
    command += ["--resized-copies"] * site.store.copies + ["--tensorboard"] * hands.tensorboard
    pixels = max(view.camera.width * view.camera.height for view in site.scene.train)
    photos = 3 * sum(view.camera.width * view.camera.height for view in site.scene.train if view.name in block.views)
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
        + min(share, photos),
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
    for share in shares:
        less = lesser(read_state(site.place(share.index)))
        if less and not share.filled:
            emit(Warned(f"block {share.index} was tuned with less than the recipe says, for want of memory: {less}"))
    if filled := [str(share.index) for share in shares if share.filled]:
        emit(Warned(f"blocks {', '.join(filled)} have no views, and are as they were in the coarse model"))
