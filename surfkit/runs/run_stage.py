"""One stage of a run: from its last checkpoint to its end, also after memory or numbers have failed."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect, expect_kind
from surfkit.core.events import FileWritten, StageBegan, StageEnded, Warned, emit, say
from surfkit.core.memory import is_out_of_gpu_memory, is_out_of_memory, peak_memory_bytes
from surfkit.evaluate.images.measure_images import Draw
from surfkit.evaluate.images.progress_pictures import ProgressPictures
from surfkit.primitives.base import refuse_other_params
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.points import Points
from surfkit.primitives.storage import Storage
from surfkit.raster.api import Maps
from surfkit.raster.base import Rasterizer
from surfkit.raster.nvrtc.gpu_memory import peak_gpu_bytes
from surfkit.raster.select import Device, select
from surfkit.runs.folder import Run, RunStage
from surfkit.runs.photo_light import held_out_response, light_of
from surfkit.scene.available_memory import free_bytes
from surfkit.scene.scene import Scene, View
from surfkit.start.base import InitialModel
from surfkit.train import checkpoint
from surfkit.train.data_cache import TrainingData
from surfkit.train.faults import MAX_RATE_HALVINGS, Diverged, NotFinite, out_of_memory
from surfkit.train.in_view import shown_points, why_all, with_frozen
from surfkit.train.interrupt import graceful
from surfkit.train.memory_meter import MemoryMeter
from surfkit.train.points_on import PLACES, PointsOn
from surfkit.train.progress import TrainingDisplay
from surfkit.train.retry_on_oom import lowered
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer
from surfkit.train.watch import Stopwatch, Watched, watched

CHECKPOINT_EVERY = 500
WATCH_EVERY = 10
"""Steps between two checks of the free memory."""
MIN_FREE_MEMORY_BYTES = 256 << 20
"""Bytes of free memory; with less, the caches are made smaller before the system kills the process."""


@dataclass(frozen=True)
class Intervals:
    """Numbers of steps between what is written while a stage runs.

    Attributes:
        checkpoint: Between checkpoints.
        pictures: Between pictures of a few held-out views; a fifth of the run if None, 0 for none.
    """

    checkpoint: int = CHECKPOINT_EVERY
    pictures: int | None = None


@dataclass(frozen=True)
class StageJob:
    """What a stage is optimised with.

    Attributes:
        run: The run.
        stage: Its stage, or that of one of its blocks.
        scene: Its data.
        rasterizer: What draws.
        intervals: Steps between checkpoints and between pictures.
        given: Photographs, masks and depth priors.
        meter: Records what the memory is used for.
        start: Gives the initial parameters of the points; if None, they are made from the `cloud`.
        cloud: Gives the initial points; the sparse ones of the scene if None.
        points_on: Where the points are kept.
        before: The state of the stage before, if its times count too.
        frozen: Gives points that are drawn with the others and never change; None for none.
        owns: As for `Trainer`.
        until: Step after which to stop with a checkpoint; that of the stage if None.
    """

    run: Run
    stage: RunStage
    scene: Scene
    rasterizer: Rasterizer
    intervals: Intervals
    given: TrainingData
    meter: MemoryMeter
    start: Callable[[torch.Generator], InitialModel]
    points_on: PointsOn
    before: StageState | None = None
    frozen: Callable[[], InitialModel] | None = None
    owns: Callable[[Tensor], Tensor] | None = None
    until: int | None = None


def load_state(run: Run, stage: RunStage, scene: Scene, repair: bool = False) -> StageState | None:
    """The state of the last whole checkpoint of a stage; None if there is none.

    `repair`: put it in the place of a damaged one.

    Raises:
        BadInput: It was trained on another number of photographs.
    """
    found = checkpoint.load_last(stage.checkpoint)
    if found is None:
        return None
    state, damage = found
    if damage is not None:
        emit(Warned(f"{damage.partition(';')[0]}; the one before it, of step {state.index}, is used instead"))
        if repair:
            checkpoint.restore(stage.checkpoint)
    if state.order.count != len(scene.train):
        raise BadInput(
            f"--out {stage.out} was trained on {state.order.count} photographs and {run.data.path} now gives "
            f"{len(scene.train)}; name another folder, or delete that one"
        )
    return state


def optimise(job: StageJob, state: StageState | None) -> StageState:
    """Run the stage from its last state, or from its beginning, to its end.

    On NaN or Inf it returns to its last checkpoint with half the learning rates, twice at most. When memory runs out,
    it returns to its last checkpoint with a smaller cache, until there is no cache; for the GPU, with no cache there.
    Then, if the stage allows it, with its points elsewhere (`PointsOn`).
    """
    trainer, along = trainer_of(job), pictures_of(job)

    def fresh() -> StageState:
        return begin(job, trainer)

    if state is not None:
        say(f"{job.stage.out}: going on after step {state.index} of {job.stage.stage.steps}")
    state = state or fresh()
    while True:
        try:
            return take_steps(job, trainer, state, along)
        except Diverged as error:
            state = return_to_checkpoint(job.stage, state.halvings, error, fresh)
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            trainer = make_room(job, trainer, state, error)
            state = None  # the error and all that it holds go first
        state = state or load_last_state(job.stage, fresh)


def trainer_of(job: StageJob) -> Trainer:
    """What takes the steps of the stage."""
    given, at, rasterizer = job.given, job.stage, job.rasterizer
    return Trainer(
        at.stage,
        at.primitive,
        job.scene.train,
        given.photos,
        rasterizer,
        given.priors,
        given.masks,
        given.expect,
        job.owns,
        gpu_bytes=given.gpu_bytes() if rasterizer.where().type == "cuda" else 0,
        home=job.points_on.home(at.folder),
    )


def pictures_of(job: StageJob) -> ProgressPictures | None:
    """What draws a few held-out views while the stage runs; None if there are none, or nobody wants them."""
    if not job.intervals.pictures or not job.scene.held_out:
        return None
    return ProgressPictures(job.stage.out / "progress", job.scene.held_out)


def begin(job: StageJob, trainer: Trainer) -> StageState:
    """The state before the first step; its times and peaks include those of the stage before, if they count too."""
    generator = torch.Generator().manual_seed(job.run.recipe.seed)
    began = time.perf_counter(), time.process_time()
    start, primitive = job.start(generator), job.stage.primitive
    expect_kind("start.model", start, InitialModel)
    refuse_other_params(primitive, start.params, "the points that it begins with")
    points = Points.fresh(start.params, primitive.shared(), trainer.home)
    for name, value in start.stats.items():
        expect(f"the points that it begins with: stats: {name}", value, (len(points), *tuple(value.shape)[1:]))
    points.stats.update({name: points.storage.held(value) for name, value in start.stats.items()})
    model = job.stage.stage.appearance
    light = light_of(job.run, job.scene.train) if model is not None and model.needs_light else None
    frozen = {name: points.storage.held(value) for name, value in (job.frozen().params if job.frozen else {}).items()}
    state = trainer.begin(points, generator, frozen, light)
    state.sh_degree = min(start.sh_degree, primitive.sh_degree)
    state.seconds, state.cpu_seconds = time.perf_counter() - began[0], time.process_time() - began[1]
    if job.before is not None:
        state.seconds += job.before.seconds
        state.cpu_seconds += job.before.cpu_seconds
        state.peak_memory_bytes = job.before.peak_memory_bytes
        state.peak_gpu_bytes = job.before.peak_gpu_bytes
    return state


def make_room(job: StageJob, trainer: Trainer, state: StageState, error: MemoryError | RuntimeError) -> Trainer:
    """Keep fewer photographs in the memory that has given out, or else no points, with a warning; what takes the steps
    from now on.

    Raises:
        OutOfMemory: None are kept in it any more, and the points stay.
    """
    at, where = job.stage, f"step {state.index + 1}"
    if is_out_of_gpu_memory(error):
        if state.whole and state.index and at.block is None:  # a block falls back to an earlier, smaller state
            save(at, state, job.meter)
        why = f"{where}: the memory of the GPU gave out"
        if trainer.uploads.bytes:
            emit(Warned(lowered(trainer.uploads, why)))
            return trainer
        kept = out_of_memory(at.out, ", though photographs are not kept in it", error)
    else:
        why = f"{where}: out of memory"
        if lower_caches(job.given, why):
            return trainer
        kept = out_of_memory(at.out, ", though photographs are no longer kept in it")
    home = next_home(job, trainer.home or Storage(trainer.rasterizer.where()), why)
    if home is None:
        raise kept from error
    return replace(trainer, home=home)


def next_home(job: StageJob, now: Storage, why: str) -> Storage | None:
    """Where the points are kept from now on, with a warning, when the memory that they are in has given out; None if
    they stay there."""
    place = job.points_on.next_place(now, job.stage.stage, job.stage.primitive)
    if place is None:
        return None
    emit(Warned(f"{why}; points are kept {PLACES[place]} from now on, which is slower (--points-on {place})"))
    return job.points_on.storage(place, job.stage.folder)


def take_steps(job: StageJob, trainer: Trainer, state: StageState, along: ProgressPictures | None) -> StageState:
    """Take the remaining steps; write checkpoints and pictures meanwhile."""
    at, intervals, meter = job.stage, job.intervals, job.meter
    steps, seconds = trainer.stage.steps, state.seconds
    emit(StageBegan(at.name, steps, len(state.points), state.index + 1, at.block))
    clock, draw, respond = Stopwatch(state), live_drawing(job, trainer, state), held_out_response(job.run, job.stage)

    def taken(view: View) -> Maps:
        maps = drawn_now(trainer, state, view)
        return maps if respond is None else respond(view, maps)

    with (
        graceful() as request,
        TrainingDisplay(at.title, steps) as display,
        watched(Watched(at.title, at.journal, job.scene, draw, lambda: request.asked)) as look,
    ):
        for done in trainer.run(state, clock):
            display.show(done)
            meter.step(state, job.given, trainer.uploads)
            if done.index % WATCH_EVERY == 0 and (free := free_bytes()) < MIN_FREE_MEMORY_BYTES:
                why = f"step {done.index}: only {free >> 20} MiB of memory are free"
                on_host = state.points.device.type == "cpu"
                if not lower_caches(job.given, why) and on_host and (home := next_home(job, state.points.storage, why)):
                    state.move(trainer.rasterizer.where(), home)
            if along is not None and intervals.pictures and done.index % intervals.pictures == 0 and done.index < steps:
                with meter.adding("pictures"):
                    along.look(done.index, taken)
            is_over = request.asked or done.index == job.until
            if is_over or done.index % intervals.checkpoint == 0 or done.index == steps:
                save(at, state, meter)
            if is_over:
                break
            if look is not None:
                with clock.stopped(), display.paused():
                    look(done.index, display.psnr.value if display.psnr.count else None)
    if request.asked:
        say(f"stopped after step {state.index} of {steps}; the same command goes on from there")
        raise KeyboardInterrupt
    emit(StageEnded(at.name, steps, len(state.points), state.seconds - seconds))
    state.move(torch.device("cpu"))
    return state


def save(stage: RunStage, state: StageState, meter: MemoryMeter) -> None:
    """Write a checkpoint, and emit what the memory is used for."""
    state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())
    state.peak_gpu_bytes = max(state.peak_gpu_bytes, peak_gpu_bytes())
    with meter.adding("checkpoints"):
        checkpoint.save(stage.checkpoint, state)
    emit(FileWritten(stage.checkpoint, "checkpoint"))
    meter.tell()


def lower_caches(given: TrainingData, why: str) -> bool:
    """Make the caches smaller, with a warning; False if they cannot be made smaller."""
    found = given.lower()
    if found is not None:
        before, after = (f"{count / 1e6:.3g} MB" for count in found)
        emit(Warned(f"{why}; photographs, masks and depth priors in memory are lowered from {before} to {after}"))
    return found is not None


def last_state(stage: RunStage, fresh: Callable[[], StageState]) -> StageState:
    """The state of the last checkpoint, or a new one."""
    found = checkpoint.load_last(stage.checkpoint)
    return found[0] if found else fresh()


def load_last_state(stage: RunStage, fresh: Callable[[], StageState]) -> StageState:
    """The same, and say so."""
    state = last_state(stage, fresh)
    say(f"{stage.out}: going on after step {state.index} of {stage.stage.steps}")
    return state


def return_to_checkpoint(
    stage: RunStage, halvings: int, error: Diverged, fresh: Callable[[], StageState]
) -> StageState:
    """The state of the last checkpoint, or a new one, with half the learning rates; saved, so that they stay so.

    Raises:
        NotFinite: They have been halved often enough.
    """
    if halvings >= MAX_RATE_HALVINGS:
        raise NotFinite(
            f"{stage.out}: {error}, also after the learning rates were halved {halvings} times; look at that "
            f"photograph and its camera, or lower {stage.setting}.rates in another folder; the last checkpoint is whole"
        ) from error
    state = last_state(stage, fresh)
    state.halvings = halvings + 1
    times = f"{state.halvings} of {MAX_RATE_HALVINGS} times"
    emit(Warned(f"{error}; back to step {state.index}, with learning rates halved ({times})"))
    checkpoint.save(stage.checkpoint, state)
    return state


def drawing(stage: RunStage, state: StageState, rasterizer: Rasterizer, geometry: bool = True) -> Draw:
    """A function that renders the points of a finished stage."""
    splats, near = stage.primitive.activate(stage.stage.finished(state), state.sh_degree), stage.stage.near
    draws = drawn_by(stage.primitive, rasterizer)
    return lambda view: draws.render(splats, view.camera, near, geometry).maps


def live_drawing(job: StageJob, trainer: Trainer, state: StageState) -> Callable[[View, bool], Maps]:
    """A function that renders the points of a stage as they are when it is called, with those that are frozen."""

    def draw(view: View, geometry: bool) -> Maps:
        with job.meter.adding("pictures"):
            return drawn_now(trainer, state, view, geometry, distortion=False)

    return draw


def drawn_now(trainer: Trainer, state: StageState, view: View, geometry: bool = True, distortion: bool = True) -> Maps:
    """Maps of a view with the points of a stage between two steps, and those that are frozen."""
    stage, primitive, camera, degree = trainer.stage, trainer.primitive, view.camera, state.sh_degree
    if why_all(stage, primitive) is None:
        _, splats = shown_points(trainer, state, camera, degree)
    else:
        splats = with_frozen(trainer, state, primitive.activate(stage.finished(state), degree), degree)
    return trainer.draws.render(splats, camera, stage.near, geometry, distortion).maps


def select_rasterizer(device: Device) -> tuple[Rasterizer, str]:
    """The rasterizer for a device and its name; Python's warnings become warnings of the run."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rasterizer, name = select(device)
    for warning in caught:
        emit(Warned(str(warning.message)))
    if device == "auto" and rasterizer.device == "cuda":
        say(f"--device auto: {name} draws and optimises")
    return rasterizer, name
