"""One stage carried through: from its last state to its end, whatever happens on the way."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import FileWritten, MemoryTaken, StageBegan, StageEnded, Warned, emit, say
from surfkit.core.memory import peak_memory_bytes
from surfkit.evaluate.images.measure import Draw
from surfkit.evaluate.images.progress_pictures import ProgressPictures
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Rasterizer
from surfkit.raster.select import Device, select
from surfkit.run.folder import Run
from surfkit.scene.memory import free_bytes
from surfkit.scene.scene import Cloud, Scene
from surfkit.train import checkpoint
from surfkit.train.faults import MOST_HALVINGS, Diverged, NotFinite, is_out_of_memory, out_of_memory
from surfkit.train.interrupt import graceful
from surfkit.train.material import TrainingData
from surfkit.train.meter import Meter
from surfkit.train.progress import Display
from surfkit.train.stage import StageState, Trainer

CHECKPOINT_EVERY = 500
WATCH_EVERY = 10
"""Steps between two looks at the free memory."""
LEAST_FREE = 256 << 20
"""Bytes of free memory; when there are fewer, the caches are lowered before the system ends the process."""


@dataclass(frozen=True)
class Intervals:
    """Steps between what is written while a stage runs.

    Attributes:
        checkpoint: States of the optimisation.
        pictures: Pictures of a few held-out views; a fifth of the run if None, 0 for none.
    """

    checkpoint: int = CHECKPOINT_EVERY
    pictures: int | None = None


@dataclass(frozen=True)
class InitialModel:
    """What a stage begins with where it goes on from a model.

    Attributes:
        params: Raw parameters of the points.
        sh_degree: Of the spherical harmonics that they have learnt so far.
    """

    params: Columns
    sh_degree: int


@dataclass(frozen=True)
class Job:
    """What the steps of a run are made with.

    Attributes:
        run: The run.
        scene: Its data.
        rasterizer: What draws.
        intervals: When to write what.
        given: What to look at.
        meter: Sees what memory is taken by.
        start: Gives the points to begin with; if None, those of the `cloud`.
        cloud: Gives the points to begin at; the sparse ones of the scene if None.
        before: The model that it goes on from, if its times count too.
        frozen: Points that are drawn beside them and stay as they are; none if None.
        owns: As for `Trainer`.
    """

    run: Run
    scene: Scene
    rasterizer: Rasterizer
    intervals: Intervals
    given: TrainingData
    meter: Meter
    start: Callable[[], InitialModel] | None = None
    before: StageState | None = None
    cloud: Callable[[], Cloud] | None = None
    frozen: Callable[[], InitialModel] | None = None
    owns: Callable[[Tensor], Tensor] | None = None


def load_state(run: Run, scene: Scene, repair: bool = False) -> StageState | None:
    """The state of the last whole checkpoint, if there is one and the data is still what it was.

    `repair`: put it in the place of a damaged one.
    """
    found = checkpoint.load_last(run.checkpoint)
    if found is None:
        return None
    state, damage = found
    if damage is not None:
        emit(Warned(f"{damage.partition(';')[0]}; the one before it, of step {state.index}, is used instead"))
        if repair:
            checkpoint.restore(run.checkpoint)
    if state.order.count != len(scene.train):
        raise BadInput(
            f"--out {run.out} was trained on {state.order.count} photographs and {run.data.path} now gives "
            f"{len(scene.train)}; name another folder, or delete that one"
        )
    return state


def optimise(job: Job, state: StageState | None) -> StageState:
    """Run the stage from its last state, or from its beginning, to its end.

    After numbers that are not finite it goes back to its last checkpoint with half the learning rates, twice at most.
    When memory gives out, it goes back with a smaller cache, until there is none.
    """
    run, given = job.run, job.given
    stage, primitive = run.stage, run.primitive
    sources = (given.photos, job.rasterizer, given.priors, given.masks, given.expect)
    trainer = Trainer(stage, primitive, job.scene.train, *sources, job.owns)
    along = (
        ProgressPictures(run.out / "progress", job.scene.held_out)
        if job.intervals.pictures and job.scene.held_out
        else None
    )

    def begin() -> StageState:
        generator = torch.Generator().manual_seed(run.recipe.seed)
        began = time.perf_counter(), time.process_time()
        cloud = job.cloud() if job.cloud else job.scene.cloud
        begun = job.start() if job.start else InitialModel(primitive.init(cloud, generator), 0)
        fresh = trainer.begin(
            Points.fresh(begun.params, primitive.shared()), generator, job.frozen().params if job.frozen else None
        )
        fresh.sh_degree = min(begun.sh_degree, primitive.sh_degree)
        if job.cloud:
            fresh.seconds, fresh.cpu_seconds = time.perf_counter() - began[0], time.process_time() - began[1]
        if job.before is not None:
            for name in ("seconds", "cpu_seconds", "peak_memory_bytes"):
                setattr(fresh, name, getattr(job.before, name))
        return fresh

    if state is not None:
        say(f"{run.out}: going on after step {state.index} of {stage.steps}")
    state = state or begin()
    while True:
        try:
            return take_steps(job, trainer, state, along)
        except Diverged as error:
            state = rolled_back(run, state.halvings, error, begin)
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            if not lower(given, f"step {state.index + 1}: out of memory"):
                raise out_of_memory(run.out, ", though photographs are no longer kept in it") from error
            state = None  # the error and all that it holds go first
        state = state or last_good(run, begin)


def take_steps(job: Job, trainer: Trainer, state: StageState, along: ProgressPictures | None) -> StageState:
    """Take the steps that are left, and write checkpoints and pictures on the way."""
    run, intervals, meter = job.run, job.intervals, job.meter
    steps, seconds = trainer.stage.steps, state.seconds
    emit(StageBegan(run.part, steps, len(state.points), state.index + 1, run.block))
    with graceful() as request, Display(run.title, steps) as display:
        for done in trainer.run(state):
            display.show(done)
            meter.step(state, job.given)
            if done.index % WATCH_EVERY == 0 and (free := free_bytes()) < LEAST_FREE:
                lower(job.given, f"step {done.index}: only {free >> 20} MiB of memory are free")
            if along is not None and done.index % intervals.pictures == 0 and done.index < steps:
                with meter.adding("pictures"):
                    along.look(done.index, drawing(run, state, trainer.rasterizer))
            if request.asked or done.index % intervals.checkpoint == 0 or done.index == steps:
                save(run, state, meter)
            if request.asked:
                break
    if request.asked:
        say(f"stopped after step {state.index} of {steps}; the same command goes on from there")
        raise KeyboardInterrupt
    emit(StageEnded(run.part, steps, len(state.points), state.seconds - seconds))
    return state


def save(run: Run, state: StageState, meter: Meter) -> None:
    """Write a checkpoint, and what the memory is taken by."""
    state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())
    with meter.adding("checkpoints"):
        checkpoint.save(run.checkpoint, state)
    emit(FileWritten(run.checkpoint, "checkpoint"))
    emit(MemoryTaken(meter.report()))


def lower(given: TrainingData, why: str) -> bool:
    """Make the caches smaller, and say so; False if they are as small as can be."""
    found = given.lower()
    if found is not None:
        before, after = (f"{count / 1e6:.3g} MB" for count in found)
        emit(Warned(f"{why}; photographs, masks and depth priors in memory are lowered from {before} to {after}"))
    return found is not None


def last_good(run: Run, begin: Callable[[], StageState]) -> StageState:
    """The state of the last checkpoint, or a new beginning."""
    found = checkpoint.load_last(run.checkpoint)
    state = found[0] if found else begin()
    say(f"{run.out}: going on after step {state.index} of {run.stage.steps}")
    return state


def rolled_back(run: Run, halvings: int, error: Diverged, begin: Callable[[], StageState]) -> StageState:
    """The last good state, or a new beginning, with half the learning rates; it is saved, so that nothing forgets it.

    Raises:
        NotFinite: They have been halved often enough.
    """
    if halvings >= MOST_HALVINGS:
        raise NotFinite(
            f"{run.out}: {error}, also after the learning rates were halved {halvings} times; look at that photograph "
            f"and its camera, or lower {run.setting}.rates in another folder; the last checkpoint is whole"
        ) from error
    found = checkpoint.load_last(run.checkpoint)
    state = found[0] if found else begin()
    state.halvings = halvings + 1
    times = f"{state.halvings} of {MOST_HALVINGS} times"
    emit(Warned(f"{error}; back to step {state.index}, with learning rates halved ({times})"))
    checkpoint.save(run.checkpoint, state)
    return state


def drawing(run: Run, state: StageState, rasterizer: Rasterizer, geometry: bool = True) -> Draw:
    """What draws the points of a state, as they are to be looked at."""
    stage = run.stage
    splats = run.primitive.activate(stage.finished(state), state.sh_degree)
    draws = drawn_by(run.primitive, rasterizer)
    return lambda view: draws.render(splats, view.camera, stage.near, geometry).maps


def drawer(device: Device) -> tuple[Rasterizer, str]:
    """The rasterizer for a device and its name; what is warned of on the way becomes a note."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rasterizer, name = select(device)
    for warning in caught:
        emit(Warned(str(warning.message)))
    return rasterizer, name
