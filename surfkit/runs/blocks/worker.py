"""One block of a large scene, trained in this process."""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput, Fault
from surfkit.core.events import StageBegan, StepDone, say
from surfkit.core.files import sweep
from surfkit.core.hooks import hookimpl
from surfkit.core.lock import locked
from surfkit.core.registry import plugins
from surfkit.core.signals import terminable
from surfkit.io.datasets import extract
from surfkit.partition.base import CoarseModel
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.points import Columns
from surfkit.runs.blocks.block import BlockRun, consensus_of
from surfkit.runs.blocks.oom_retry import apply_fallback, take_fallback
from surfkit.runs.blocks.rounds import ID, stops, take_in
from surfkit.runs.command import train_command
from surfkit.runs.context import RunContext
from surfkit.runs.execute.block_state import STALE_S, find_remote_worker, find_worker
from surfkit.runs.execute.remote import CHILD_POLL_S, CRASHED_STATUS, DRIVER, INTERRUPTED_STATUS
from surfkit.runs.folder import Run, refuse_file
from surfkit.runs.journal import record_events
from surfkit.runs.run_notes import prefix_notes
from surfkit.runs.run_stage import StageJob, load_state, optimise
from surfkit.scene.scene import View
from surfkit.start.base import InitialModel
from surfkit.train.data_cache import read_ahead
from surfkit.train.faults import DiskFull, OutOfMemory, in_one_line
from surfkit.train.memory_meter import MemoryMeter
from surfkit.train.state import StageState
from surfkit.train.streaming import StoredState, open_last

HEARTBEAT_S = 5.0
"""Seconds between heartbeats of a block."""
DISK_FULL_STATUS, BUSY_STATUS = 74, 75
"""Exit statuses beside those of `surfkit train` and of remote jobs: disk full; the block is trained by another."""


def train_block(ctx: RunContext, block: BlockRun, patience_s: float = 0.0) -> int:
    """Train a block and return an exit status; the reason of a failure is printed and saved in the state of the block.

    Args:
        ctx: What to train it with.
        block: The block.
        patience_s: How long to wait for another process that trains it.
    """
    folder, until = block.folder, time.monotonic() + patience_s
    refuse_file(folder)
    block.read()  # or BadInput: a damaged state cannot be changed
    while time.monotonic() < until and find_worker(folder):
        time.sleep(CHILD_POLL_S)
    try:
        with locked(folder):
            if other := find_remote_worker(folder):
                raise BadInput(f"{folder}: {other} sent a heartbeat in the last {STALE_S:.0f} s; wait for its end")
            block.read()
            return _train_locked(ctx, block)
    except BadInput as error:  # another process trains it, and only that may change the state
        say(f"surfkit: block {block.index}: {error}")
        return BUSY_STATUS


def _train_locked(ctx: RunContext, block: BlockRun) -> int:
    sweep(block.folder)
    name, folder = block.stage.title, block.folder
    try:
        with prefix_notes(f"{name}: "), record_events(folder), heartbeats(block), in_one_line(folder):
            take_steps(ctx, block)
    except (BadInput, Fault) as error:
        brief = error.what if isinstance(error, (OutOfMemory, DiskFull)) else str(error)
        reason, kind = " ".join(brief.split()), "data" if isinstance(error, BadInput) else error.kind
        say(f"surfkit: {name}: {reason}")
        with suppress(OSError):  # the disk may be full
            block.write(status="failed", kind=kind, error=reason)
        return 2 if isinstance(error, BadInput) else DISK_FULL_STATUS if isinstance(error, DiskFull) else 1
    except KeyboardInterrupt:
        block.write(status="failed", kind="interrupted", error="interrupted")
        return INTERRUPTED_STATUS
    except Exception as error:
        traceback.print_exc()
        block.write(status="failed", kind="crash", error=f"{type(error).__name__}: {error}")
        return CRASHED_STATUS
    return 0


def take_steps(ctx: RunContext, block: BlockRun) -> None:
    """Train a block from its last checkpoint to its end."""
    take_fallback(block)
    stage, caches = apply_fallback(block, ctx.caches)
    part, steps, context = extract.load(block.views_file), stage.stage.steps, ctx.run.recipe.context
    scene, state = part.scene, load_state(ctx.run, stage, part.scene, repair=True)
    if state is not None and bool(state.frozen) != (context == "frozen"):
        there = "frozen points" if state.frozen else "no frozen points"
        raise BadInput(
            f"{stage.checkpoint} has {there}, and the recipe --context {context}; delete {block.folder} to tune it anew"
        )
    done, goal = state.index if state else 0, block.goal
    if goal < done:
        raise BadInput(
            f"{stage.checkpoint} is of step {done}, and what blocks agreed on after step {goal} is gone; delete "
            f"{block.run.blocks} to tune all blocks anew"
        )
    begun = {"attempts": block.state.attempts + 1, "first": done, "began": 0.0}
    block.write(status="running", step=done, steps=steps, error=None, kind=None, **begun)
    if done < goal:
        given = read_ahead(ctx.run.data, scene, stage.stage.losses, caches, part.priors)
        start, frozen = BlockStart(ctx, block, scene.train), None
        if context == "frozen":
            start, frozen = replace(start, part="own"), replace(start, part="around")
        owns = None if context == "densified" else start.owns
        intervals, meter, points_on = replace(ctx.intervals, pictures=0), MemoryMeter.of_stage(), caches.points
        what = ctx.run, stage, scene, ctx.rasterizer, intervals, given, meter, start, points_on
        job = StageJob(*what, frozen=frozen, owns=owns)
        for until in stops(block, done):
            state = optimise(replace(job, until=until), take_in(block, state))
    else:
        say(f"{stage.title} has all its {goal} steps already")
    assert state is not None, "a goal is a step, so there is a state at it"
    block.write(status="done" if state.index >= steps else "planned", step=state.index, steps=steps)


@dataclass(frozen=True)
class BlockStart:
    """The initial points of a block: those of the coarse model that it owns, and those that its views show.

    The latter, its context, are rendered with the block, so that it need not fit what others own; they are not merged.
    """

    ctx: RunContext
    block: BlockRun
    views: Sequence[View]
    part: Literal["both", "own", "around"] = "both"

    def __call__(self, _: torch.Generator | None = None) -> InitialModel:
        """Their raw parameters, and the degree of spherical harmonics of the coarse model."""
        coarse, kept, ids, begin = open_coarse_model(self.ctx.run), [], [], 0
        for piece in coarse.pieces():
            rows, params = self.select(piece)
            kept.append({name: params[name][rows] for name in piece.points.params})
            ids.append(rows.nonzero()[:, 0] + begin)
            begin += len(rows)
        params = {name: torch.cat([part[name] for part in kept]) for name in kept[0]}
        stats = {} if consensus_of(self.ctx.run.recipe) is None else {ID: torch.cat(ids)}
        return InitialModel(params | coarse.state.points.shared, coarse.state.sh_degree, stats)

    def select(self, piece: StageState) -> tuple[Tensor, Columns]:
        """(N,) bool, which of some points of the coarse model these are, and the parameters of these N points."""
        ctx = self.ctx
        params, model = ctx.run.recipe.pretrain.finished(piece), activate_coarse_model(ctx, piece)
        own = self.owns(params["means"])
        rows = own.clone()
        for view in self.views if self.part != "own" else ():
            rows |= model.rasterizer.render(model.splats, view.camera, model.near, geometry=False).seen
        rows &= ~own if self.part == "around" else True
        return rows, params

    def owns(self, means: Tensor) -> Tensor:
        """(N,) bool, which of (N, 3) positions the block owns."""
        return self.block.plan.cells.owner(means) == self.block.index


def open_coarse_model(run: Run) -> StoredState:
    """The coarse model of a run, left on disk."""
    found = open_last(run.pretrain.checkpoint)
    if found is None:
        raise BadInput(f"{run.out}: the coarse model is gone; `{train_command(run)}` makes it again")
    return found[0]


def activate_coarse_model(ctx: RunContext, coarse: StageState) -> CoarseModel:
    """The coarse model, or some of its points, as splats to render."""
    stage = ctx.run.recipe.pretrain
    splats = ctx.run.recipe.primitive.activate(stage.finished(coarse), coarse.sh_degree)
    draws = drawn_by(ctx.run.recipe.primitive, ctx.rasterizer)
    seed = ctx.run.recipe.seed
    return CoarseModel(splats.detached(), ctx.scene.train, draws, stage.near, ctx.scene.frame, seed=seed)


@contextmanager
def heartbeats(block: BlockRun) -> Iterator[None]:
    """Within, the state of a block gets heartbeats; a worker whose driver is gone stops as if it were asked to.

    Raises:
        KeyboardInterrupt: The driver is gone, or this process has received SIGTERM.
    """
    heartbeat = Heartbeat(block)
    if heartbeat.is_orphan():
        raise KeyboardInterrupt
    plugins().register(heartbeat, f"heartbeat of {block.folder}")
    thread = threading.Thread(target=heartbeat.repeat, daemon=True)
    with terminable():
        thread.start()
        try:
            yield
        finally:
            heartbeat.over.set()
            thread.join()
            heartbeat.send()
            plugins().unregister(heartbeat)


class Heartbeat:
    """Saves the step of a block every few seconds, also while photographs are read and no step is made."""

    def __init__(self, block: BlockRun) -> None:
        self.block = block
        self.driver = int(os.environ.get(DRIVER, 0))
        self.step: dict[str, int] = {}
        self.over = threading.Event()

    def is_orphan(self) -> bool:
        """Whether a driver has started this process and is gone."""
        return self.driver not in (0, os.getppid())

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """Note the number of the step, and of the points at the first step."""
        if isinstance(event, StageBegan):
            fresh = {"begun_points": event.points} if event.first == 1 else {}
            self.block.write(began=time.time(), **fresh)
        if isinstance(event, StepDone):
            self.step = {"step": event.index}

    def repeat(self) -> None:
        """Check for the driver and send heartbeats, until it is over."""
        since = time.monotonic()
        while not self.over.wait(CHILD_POLL_S):
            if self.is_orphan():
                self.driver = 0
                os.kill(os.getpid(), signal.SIGTERM)
            if time.monotonic() - since >= HEARTBEAT_S:
                since = time.monotonic()
                self.send()

    def send(self) -> None:
        """Send a heartbeat."""
        with suppress(OSError):  # a full disk is reported by the checkpoint
            self.block.write(**self.step)
