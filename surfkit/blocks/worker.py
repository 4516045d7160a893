"""One block of a large scene, tuned in this process."""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from surfkit.blocks.oom_retry import reduced, take_fallback
from surfkit.core.check import BadInput, Fault
from surfkit.core.events import StageBegan, StepDone, say
from surfkit.core.files import sweep
from surfkit.core.lock import held
from surfkit.core.registry import hookimpl, plugins
from surfkit.execute.base import terminable
from surfkit.execute.remote import CRASHED, DRIVER, INTERRUPTED, POLL_S
from surfkit.execute.state import STALE_S, heard_elsewhere, read_state, worked_on, write_state
from surfkit.partition.base import CoarseModel
from surfkit.partition.plan import Plan
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.points import Columns
from surfkit.readers import extract
from surfkit.run.context import RunContext
from surfkit.run.folder import Run, refuse_file
from surfkit.run.journal import kept
from surfkit.run.notes import naming
from surfkit.run.stage import InitialModel, Job, load_state, optimise
from surfkit.scene.scene import View
from surfkit.train.faults import DiskFull, OutOfMemory, in_one_line
from surfkit.train.material import read_ahead
from surfkit.train.meter import Meter
from surfkit.train.stage import StageState
from surfkit.train.streaming import Stored, open_last

ALIVE_S = 5.0
"""Seconds between signs of life of a block."""
FULL, BUSY = 74, 75
"""Exit statuses beside those of `surfkit train` and of errands: a full disk, and a block that another works on."""


def guarded(ctx: RunContext, blocks: Plan, index: int, patience_s: float = 0.0) -> int:
    """Tune a block and return an exit status; what goes wrong is told, and is in the block's state.

    Args:
        ctx: Where.
        blocks: All of them.
        index: Which one.
        patience_s: How long to wait for another process that works on it.
    """
    folder, until = ctx.place(index), time.monotonic() + patience_s
    refuse_file(folder)
    read_state(folder)  # or BadInput: what is damaged cannot be written on
    while time.monotonic() < until and worked_on(folder):
        time.sleep(POLL_S)
    try:
        with held(folder):
            if other := heard_elsewhere(folder):
                raise BadInput(f"{folder}: {other} was heard of in the last {STALE_S:.0f} s; wait for its end")
            return _begun(ctx, blocks, index)
    except BadInput as error:  # another process works there, and the state is its
        say(f"surfkit: block {index}: {error}")
        return BUSY


def _begun(ctx: RunContext, blocks: Plan, index: int) -> int:
    folder = ctx.place(index)
    sweep(folder)
    try:
        with naming(f"block {index}: "), kept(folder), signs(folder), in_one_line(folder):
            tune(ctx, blocks, index)
    except (BadInput, Fault) as error:
        brief = error.what if isinstance(error, (OutOfMemory, DiskFull)) else str(error)
        reason = " ".join(brief.split())
        say(f"surfkit: block {index}: {reason}")
        with suppress(OSError):  # the disk may be full
            write_state(
                folder, status="failed", kind="data" if isinstance(error, BadInput) else error.kind, error=reason
            )
        return 2 if isinstance(error, BadInput) else FULL if isinstance(error, DiskFull) else 1
    except KeyboardInterrupt:
        write_state(folder, status="failed", kind="interrupted", error="interrupted")
        return INTERRUPTED
    except Exception as error:
        traceback.print_exc()
        write_state(folder, status="failed", kind="crash", error=f"{type(error).__name__}: {error}")
        return CRASHED
    return 0


def tune(ctx: RunContext, blocks: Plan, index: int) -> None:
    """Tune one block from where it stands to its end."""
    take_fallback(ctx.block(index))
    block, caches = reduced(ctx.block(index), ctx.caches)
    part = extract.load(ctx.views(index))
    scene, steps, folder = part.scene, block.stage.steps, block.out
    around_is, state = block.recipe.context, load_state(block, scene, repair=True)
    if state is not None and bool(state.frozen) != (around_is == "frozen"):
        there = "frozen points" if state.frozen else "no frozen points"
        raise BadInput(
            f"{block.checkpoint} has {there}, and the recipe --context {around_is}; delete {folder} to tune it anew"
        )
    begun = read_state(folder).attempts + 1
    done = state.index if state else 0
    write_state(
        folder, status="running", step=done, steps=steps, attempts=begun, error=None, kind=None, first=done, began=0.0
    )
    if state is None or state.index < steps:
        given = read_ahead(ctx.run.data, scene, block.stage.losses, caches, part.priors)
        intervals = replace(ctx.intervals, pictures=0)
        start, frozen = Start(ctx, blocks, index, scene.train), None
        if around_is == "frozen":
            start, frozen = replace(start, part="own"), replace(start, part="around")
        owns = None if around_is == "densified" else start.owns
        job = Job(block, scene, ctx.rasterizer, intervals, given, Meter(), start, frozen=frozen, owns=owns)
        state = optimise(job, state)
    else:
        say(f"block {index} has all its {steps} steps already")
    write_state(folder, status="done", step=state.index, steps=steps)


@dataclass(frozen=True)
class Start:
    """Where a block begins: with the points that it owns, and those that its views show, of the coarse model.

    The latter, its context, are drawn with the block, so that it need not explain what others own; they are not merged.
    """

    ctx: RunContext
    blocks: Plan
    index: int
    views: Sequence[View]
    part: Literal["both", "own", "around"] = "both"

    def __call__(self) -> InitialModel:
        """Their raw parameters, and the degree of harmonics that the coarse model has come to."""
        coarse = coarse_model(self.ctx.run)
        kept = [self.wanted(piece) for piece in coarse.pieces()]
        params = {name: torch.cat([part[name] for part in kept]) for name in kept[0]}
        return InitialModel(params | coarse.state.points.shared, coarse.state.sh_degree)

    def wanted(self, piece: StageState) -> Columns:
        """Those among some points of the coarse model."""
        ctx = self.ctx
        params, sight = ctx.run.recipe.pretrain.finished(piece), coarse_model_of(ctx, piece)
        own = self.owns(params["means"])
        rows = own.clone()
        for view in self.views if self.part != "own" else ():
            rows |= sight.rasterizer.render(sight.splats, view.camera, sight.near, geometry=False).seen
        rows &= ~own if self.part == "around" else True
        return {name: params[name][rows] for name in piece.points.params}

    def owns(self, means: Tensor) -> Tensor:
        """(N,) bool, which of (N, 3) positions are the block's own."""
        return self.blocks.cells.owner(means) == self.index


def coarse_model(run: Run) -> Stored:
    """The coarse model of a run, which stays on disk."""
    found = open_last(replace(run, part="pretrain").checkpoint)
    if found is None:
        raise BadInput(f"{run.out}: the coarse model is gone; give its surfkit train command again")
    return found[0]


def coarse_model_of(ctx: RunContext, coarse: StageState) -> CoarseModel:
    """The coarse model, or some points of it, to be looked at."""
    stage = ctx.run.recipe.pretrain
    splats = ctx.run.recipe.primitive.activate(stage.finished(coarse), coarse.sh_degree)
    draws = drawn_by(ctx.run.recipe.primitive, ctx.rasterizer)
    return CoarseModel(splats.detached(), ctx.scene.train, draws, stage.near)


@contextmanager
def signs(folder: Path) -> Iterator[None]:
    """Within, a block gives signs of life; a worker whose driver is gone stops as if it were asked to.

    Raises:
        KeyboardInterrupt: The driver is gone already, or it is now, or someone sent SIGTERM.
    """
    watch = Watch(folder)
    if watch.alone():
        raise KeyboardInterrupt
    plugins().register(watch, f"signs of {folder}")
    thread = threading.Thread(target=watch.look, daemon=True)
    with terminable():
        thread.start()
        try:
            yield
        finally:
            watch.over.set()
            thread.join()
            watch.sign()
            plugins().unregister(watch)


class Watch:
    """Writes where a block stands, every few seconds, also while photographs are read and no step is made."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.driver = int(os.environ.get(DRIVER, 0))
        self.step: dict[str, int] = {}
        self.over = threading.Event()

    def alone(self) -> bool:
        """Whether a driver began this process and is gone."""
        return self.driver not in (0, os.getppid())

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if isinstance(event, StageBegan):
            fresh = {"begun_points": event.points} if event.first == 1 else {}
            write_state(self.folder, began=time.time(), **fresh)
        if isinstance(event, StepDone):
            self.step = {"step": event.index}

    def look(self) -> None:
        """Look for the driver and give signs of life, until it is over."""
        since = time.monotonic()
        while not self.over.wait(POLL_S):
            if self.alone():
                self.driver = 0
                os.kill(os.getpid(), signal.SIGTERM)
            if time.monotonic() - since >= ALIVE_S:
                since = time.monotonic()
                self.sign()

    def sign(self) -> None:
        """Give a sign of life."""
        with suppress(OSError):  # a full disk is told where it matters
            write_state(self.folder, **self.step)
