"""One block of a large scene, tuned in this process."""

from __future__ import annotations

import math
import os
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import StageBegan, StepDone
from surfkit.core.files import sweep
from surfkit.core.journal import kept
from surfkit.core.lock import held
from surfkit.core.registry import hookimpl, plugins
from surfkit.folder import Run, naming, refuse_file, say
from surfkit.ladder import climb, eased
from surfkit.optimise import Every, Job, optimise, saved
from surfkit.partition.base import Sight
from surfkit.partition.executor import DRIVER
from surfkit.partition.plan import Plan
from surfkit.partition.state import read_state, write_state
from surfkit.primitives.points import Columns
from surfkit.raster.api import Rasterizer
from surfkit.scene.depth_prior import Alignment, alignment
from surfkit.scene.scene import Scene, View
from surfkit.train import checkpoint
from surfkit.train.faults import DiskFull, OutOfMemory, in_one_line
from surfkit.train.material import Store, needs_priors, read_ahead
from surfkit.train.meter import Meter
from surfkit.train.stage import StageState

ALIVE_S = 5.0
"""Seconds between signs of life of a block."""
CRASHED, FULL, BUSY, INTERRUPTED = 70, 74, 75, 130
"""Exit statuses beside those of `surfkit train`: an error that nobody foresaw, a full disk, and a block that another
works on."""


@dataclass(frozen=True)
class Site:
    """Where blocks are worked on.

    Attributes:
        this: The run.
        scene: Its data.
        rasterizer: What draws.
        every: When a block writes what.
        store: Where its photographs are kept at hand.
    """

    this: Run
    scene: Scene
    rasterizer: Rasterizer
    every: Every
    store: Store

    @property
    def folder(self) -> Path:
        """Of all blocks."""
        return self.this.out / "blocks"

    def place(self, index: int) -> Path:
        """The folder of one block."""
        return self.folder / f"{index:03}"

    def folders(self) -> list[Path]:
        """Those of the blocks that somebody has begun."""
        return sorted(self.folder.glob("[0-9]*"))

    def block(self, index: int) -> Run:
        """One block as a run of its own."""
        return Run(self.place(index), self.this.recipe, self.this.data, "tune", index)


def guarded(site: Site, blocks: Plan, index: int) -> int:
    """Tune a block and return an exit status; what goes wrong is told, and is in the block's state."""
    folder = site.place(index)
    refuse_file(folder)
    read_state(folder)  # or BadInput: what is damaged cannot be written on
    try:
        with held(folder):
            return _begun(site, blocks, index)
    except BadInput as error:  # another process works there, and the state is its
        say(f"surfkit: block {index}: {error}")
        return BUSY


def _begun(site: Site, blocks: Plan, index: int) -> int:
    folder = site.place(index)
    sweep(folder)
    try:
        with naming(f"block {index}: "), kept(folder), signs(folder), in_one_line(folder):
            tune(site, blocks, index)
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


def tune(site: Site, blocks: Plan, index: int) -> None:
    """Tune one block from where it stands to its end."""
    climb(site.block(index))
    block, store = eased(site.block(index), site.store)
    wanted = set(blocks.blocks[index].views)
    views = tuple(view for view in site.scene.train if view.name in wanted)
    scene = replace(site.scene, train=views, held_out=())
    steps, folder = block.stage.steps, block.out
    state = saved(block, scene, repair=True)
    begun = read_state(folder).attempts + 1
    done = state.index if state else 0
    write_state(
        folder, status="running", step=done, steps=steps, attempts=begun, error=None, kind=None, first=done, began=0.0
    )
    if state is None or state.index < steps:
        given = read_ahead(site.this.data, scene, block.stage.losses, store, aligned(site))
        every = replace(site.every, pictures=0)
        start = Start(site, blocks, index, views)
        state = optimise(Job(block, scene, site.rasterizer, every, given, Meter(), start), state)
    write_state(folder, status="done", step=state.index, steps=steps)


def aligned(site: Site) -> Alignment | None:
    """How the depth priors of the whole scene are aligned, kept for all blocks; None if no loss needs any.

    A block's own views would give another scale to its loss, and another judgement of failed alignments.
    """
    if not needs_priors(site.this.recipe.tune.losses):
        return None
    path = site.folder / "priors.json"
    if not path.exists():
        write_json(path, alignment(site.this.data, site.scene))
    return read_json(path, Alignment)


@dataclass(frozen=True)
class Start:
    """Where a block begins: with the points that it owns, and those that its views show, of the coarse model.

    The latter are drawn and tuned with the block, so that it need not explain what others own; they are not merged.
    """

    site: Site
    blocks: Plan
    index: int
    views: Sequence[View]

    def __call__(self) -> Columns:
        """Their raw parameters."""
        site = self.site
        found = checkpoint.load_last(replace(site.this, part="pretrain").checkpoint)
        if found is None:
            raise BadInput(f"{site.this.out}: the coarse model is gone; give its surfkit train command again")
        coarse = found[0]
        params = site.this.recipe.pretrain.finished(coarse)
        wanted = self.blocks.cells.owner(params["means"]) == self.index
        sight = sight_of(site, coarse)
        for view in self.views:
            wanted |= site.rasterizer.render(sight.splats, view.camera, sight.near, geometry=False).seen
        return {name: value[wanted].clone() for name, value in params.items()}


def sight_of(site: Site, coarse: StageState) -> Sight:
    """The coarse model, to be looked at."""
    stage = site.this.recipe.pretrain
    splats = site.this.recipe.primitive.shape(stage.finished(coarse), coarse.sh_degree)
    splats = replace(splats, **{name: value.detach() for name, value in splats.tensors().items()})
    return Sight(splats, site.scene.train, site.rasterizer, stage.near)


@contextmanager
def signs(folder: Path) -> Iterator[None]:
    """Within, steps become signs of life of a block; a worker whose driver is gone stops as if it were asked to.

    Raises:
        KeyboardInterrupt: The driver is gone already.
    """
    watch = Watch(folder)
    if watch.alone():
        raise KeyboardInterrupt
    plugins().register(watch, f"signs of {folder}")
    try:
        yield
    finally:
        plugins().unregister(watch)


class Watch:
    """Writes where a block stands, every few seconds."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.driver = int(os.environ.get(DRIVER, 0))
        self.next = -math.inf

    def alone(self) -> bool:
        """Whether a driver began this process and is gone."""
        return self.driver not in (0, os.getppid())

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if isinstance(event, StageBegan):
            fresh = {"begun_points": event.points} if event.first == 1 else {}
            write_state(self.folder, began=time.time(), **fresh)
        if not isinstance(event, StepDone):
            return
        if self.alone():
            self.driver = 0
            os.kill(os.getpid(), signal.SIGTERM)
        if time.monotonic() >= self.next:
            self.next = time.monotonic() + ALIVE_S
            write_state(self.folder, status="running", step=event.index)
