"""Recipe and data to a run folder: what happens, from top to bottom."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import FileWritten, MemoryTaken, StageBegan, StageEnded, Warned, emit
from surfkit.core.files import sweep
from surfkit.core.journal import kept
from surfkit.core.lock import held
from surfkit.core.memory import peak_memory_bytes
from surfkit.core.schedule import rescale
from surfkit.evaluate.along import Along
from surfkit.evaluate.images import Draw, evaluate_views, frames_per_second
from surfkit.evaluate.metrics import read_metrics
from surfkit.evaluate.pictures import panel, picture_path, write_picture
from surfkit.folder import (
    Run,
    claim,
    discard,
    noted,
    read_data,
    read_record,
    refuse_changed,
    refuse_file,
    refuse_no_run,
    refuse_other,
    say,
)
from surfkit.primitives.base import to_table
from surfkit.primitives.points import Points
from surfkit.raster.api import Maps, Rasterizer
from surfkit.raster.select import Device, select
from surfkit.recipe import Recipe
from surfkit.scene.cameras import write_cameras
from surfkit.scene.data import Data
from surfkit.scene.masks import mask_cache
from surfkit.scene.memory import free_bytes
from surfkit.scene.photos import photo_cache
from surfkit.scene.ply import write_splats
from surfkit.scene.read import read
from surfkit.scene.scene import Scene, View
from surfkit.train import checkpoint
from surfkit.train.faults import MOST_HALVINGS, Diverged, in_one_line, is_out_of_memory, out_of_memory
from surfkit.train.interrupt import graceful
from surfkit.train.material import Material, Store, read_ahead
from surfkit.train.meter import Meter
from surfkit.train.progress import Display
from surfkit.train.stage import StageState, Trainer

CHECKPOINT_EVERY = 500
WATCH_EVERY = 10
"""Steps between two looks at the free memory."""
LEAST_FREE = 256 << 20
"""Bytes of free memory; when there are fewer, the caches are lowered before the system ends the process."""
AHEAD = 8
"""Photographs in memory while held-out ones are measured: each is needed once."""


@dataclass(frozen=True)
class Every:
    """Steps between what is written while a stage runs.

    Attributes:
        checkpoint: States of the optimisation.
        pictures: Pictures of a few held-out views; a fifth of the run if None, 0 for none.
    """

    checkpoint: int = CHECKPOINT_EVERY
    pictures: int | None = None


@dataclass(frozen=True)
class Job:
    """What the steps of a run are made with.

    Attributes:
        this: The run.
        scene: Its data.
        rasterizer: What draws.
        every: When to write what.
        given: What to look at.
        meter: Sees what memory is taken by.
    """

    this: Run
    scene: Scene
    rasterizer: Rasterizer
    every: Every
    given: Material
    meter: Meter


def with_steps(recipe: Recipe, steps: int) -> Recipe:
    """The recipe as a run of `steps` steps, every schedule scaled along."""
    if steps < 1:
        raise BadInput(f"--steps {steps}: give 1 or more")
    return rescale(recipe, steps / recipe.pretrain.steps)


def run(
    recipe: Recipe,
    data: Data,
    out: Path,
    device: Device = "auto",
    every: Every | None = None,
    store: Store | None = None,
) -> dict[str, Any]:
    """Train, write the results into `out` and return the metrics; an interrupted run goes on where it stopped.

    Args:
        recipe: What to do.
        data: What to do it with.
        out: Run folder.
        device: Where to compute.
        every: When checkpoints and pictures are written.
        store: Where photographs, masks and depth priors are kept at hand; the result does not depend on it.

    Raises:
        BadInput: `out` holds a run of another recipe or of other data, another process works in it, or the data cannot
            be used.
        Fault: Memory, disk or numbers gave out; the last checkpoint is whole.
        KeyboardInterrupt: The run was asked to stop, and has saved its state.
    """
    this = Run(out, recipe, replace(data, path=data.path.resolve()))
    every, store, meter = every or Every(), store or Store(), Meter()
    if every.pictures is None:
        every = replace(every, pictures=max(1, recipe.pretrain.steps // 5))
    refuse_file(out)
    store.bytes()  # or BadInput, before anything is done
    with noted() as notes, held(out), in_one_line(out):
        sweep(out)
        refuse_other(this)
        scene = read(this.data)
        meter.scene_read()
        rasterizer, backend = drawer(device)
        state = saved(this, scene, repair=True)
        prints = refuse_changed(this, scene, {scene.train[at].name for at in state.skipped} if state else set())
        warn_of_gaps(scene, state)
        unfinished = state is None or state.index < recipe.pretrain.steps
        given = read_ahead(this.data, scene, recipe.pretrain.losses, store) if unfinished else None
        claim(this, backend, prints, notes, scene.frame)
        with kept(out):
            if given is not None:
                discard(this.metrics, this.cloud)
                state = optimise(Job(this, scene, rasterizer, every, given, meter), state)
                del given  # its memory is free for what comes
            elif this.metrics.exists() and this.cloud.exists():
                say(f"{out} is finished; delete {this.metrics.name} in it to measure again")
                return read_metrics(out)
            if not this.cloud.exists():
                export(this, state, scene)
            return evaluate(this, state, scene, rasterizer, meter)


def saved(this: Run, scene: Scene, repair: bool = False) -> StageState | None:
    """The state of the last whole checkpoint, if there is one and the data is still what it was.

    `repair`: put it in the place of a damaged one.
    """
    found = checkpoint.load_last(this.checkpoint)
    if found is None:
        return None
    state, damage = found
    if damage is not None:
        emit(Warned(f"{damage.partition(';')[0]}; the one before it, of step {state.index}, is used instead"))
        if repair:
            checkpoint.restore(this.checkpoint)
    if state.order.count != len(scene.train):
        raise BadInput(
            f"--out {this.out} was trained on {state.order.count} photographs and {this.data.path} now gives "
            f"{len(scene.train)}; name another folder, or delete that one"
        )
    return state


def optimise(job: Job, state: StageState | None) -> StageState:
    """Run the stage from its last state, or from the sparse points, to its end.

    After numbers that are not finite it goes back to its last checkpoint with half the learning rates, twice at most.
    When memory gives out, it goes back with a smaller cache, until there is none.
    """
    this, given = job.this, job.given
    stage, primitive = this.recipe.pretrain, this.recipe.primitive
    sources = (given.photos, job.rasterizer, given.priors, given.masks, given.expect)
    trainer = Trainer(stage, primitive, job.scene.train, *sources)
    along = Along(this.out / "progress", job.scene.held_out) if job.every.pictures and job.scene.held_out else None

    def begin() -> StageState:
        generator = torch.Generator().manual_seed(this.recipe.seed)
        return trainer.begin(Points.fresh(primitive.init(job.scene.cloud, generator)), generator)

    if state is not None:
        say(f"{this.out}: going on after step {state.index} of {stage.steps}")
    state = state or begin()
    while True:
        try:
            return take_steps(job, trainer, state, along)
        except Diverged as error:
            state = rolled_back(this, state.halvings, error, begin)
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            if not lower(given, f"step {state.index + 1}: out of memory"):
                raise out_of_memory(this.out, ", though photographs are no longer kept in it") from error
            state = None  # the error and all that it holds go first
        state = state or last_good(this, begin)


def take_steps(job: Job, trainer: Trainer, state: StageState, along: Along | None) -> StageState:
    """Take the steps that are left, and write checkpoints and pictures on the way."""
    this, every, meter = job.this, job.every, job.meter
    steps, seconds = trainer.stage.steps, state.seconds
    emit(StageBegan("pretrain", steps, len(state.points), state.index + 1))
    with graceful() as request, Display("pretrain", steps) as display:
        for done in trainer.run(state):
            display.show(done)
            meter.step(state, job.given)
            if done.index % WATCH_EVERY == 0 and (free := free_bytes()) < LEAST_FREE:
                lower(job.given, f"step {done.index}: only {free >> 20} MiB of memory are free")
            if along is not None and done.index % every.pictures == 0 and done.index < steps:
                with meter.adding("pictures"):
                    along.look(done.index, drawing(this, state, trainer.rasterizer))
            if request.asked or done.index % every.checkpoint == 0 or done.index == steps:
                save(this, state, meter)
            if request.asked:
                break
    if request.asked:
        say(f"stopped after step {state.index} of {steps}; the same command goes on from there")
        raise KeyboardInterrupt
    emit(StageEnded("pretrain", steps, len(state.points), state.seconds - seconds))
    return state


def save(this: Run, state: StageState, meter: Meter) -> None:
    """Write a checkpoint, and what the memory is taken by."""
    state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())
    with meter.adding("checkpoints"):
        checkpoint.save(this.checkpoint, state)
    emit(FileWritten(this.checkpoint, "checkpoint"))
    emit(MemoryTaken(meter.report()))


def lower(given: Material, why: str) -> bool:
    """Make the caches smaller, and say so; False if they are as small as can be."""
    found = given.lower()
    if found is not None:
        before, after = (f"{count / 1e6:.3g} MB" for count in found)
        emit(Warned(f"{why}; photographs, masks and depth priors in memory are lowered from {before} to {after}"))
    return found is not None


def last_good(this: Run, begin: Callable[[], StageState]) -> StageState:
    """The state of the last checkpoint, or a new beginning."""
    found = checkpoint.load_last(this.checkpoint)
    state = found[0] if found else begin()
    say(f"{this.out}: going on after step {state.index} of {this.recipe.pretrain.steps}")
    return state


def rolled_back(this: Run, halvings: int, error: Diverged, begin: Callable[[], StageState]) -> StageState:
    """The last good state, or a new beginning, with half the learning rates; it is saved, so that nothing forgets it.

    Raises:
        Fault: They have been halved often enough.
    """
    if halvings >= MOST_HALVINGS:
        raise Fault(
            f"{this.out}: {error}, also after the learning rates were halved {halvings} times; look at that photograph "
            "and its camera, or lower pretrain.rates in another folder; the last checkpoint is whole"
        ) from error
    found = checkpoint.load_last(this.checkpoint)
    state = found[0] if found else begin()
    state.halvings = halvings + 1
    times = f"{state.halvings} of {MOST_HALVINGS} times"
    emit(Warned(f"{error}; back to step {state.index}, with learning rates halved ({times})"))
    checkpoint.save(this.checkpoint, state)
    return state


def drawing(this: Run, state: StageState, rasterizer: Rasterizer, geometry: bool = True) -> Draw:
    """What draws the points of a state, as they are to be looked at."""
    stage = this.recipe.pretrain
    splats = this.recipe.primitive.shape(stage.finished(state), state.sh_degree)
    return lambda view: rasterizer.render(splats, view.camera, stage.near, geometry).maps


def export(this: Run, state: StageState, scene: Scene) -> None:
    """Write the points and the cameras in the frame of the input."""
    params = this.recipe.pretrain.finished(state)
    write_cameras(this.cameras, scene)
    emit(FileWritten(this.cameras, "cameras"))
    write_splats(this.cloud, to_table(this.recipe.primitive, params).in_input_frame(scene.frame), frame=scene.frame)
    emit(FileWritten(this.cloud, "points"))


def evaluate(
    this: Run, state: StageState, scene: Scene, rasterizer: Rasterizer, meter: Meter | None = None
) -> dict[str, Any]:
    """Measure on the held-out photographs, write metrics and pictures, and return the metrics.

    `meter`: of a run that is being made; without one, what memory was taken by stays as it was measured then.
    """
    draw, colors = (drawing(this, state, rasterizer, geometry) for geometry in (True, False))
    ahead = AHEAD * max((3 * view.camera.width * view.camera.height for view in scene.held_out), default=0)

    def show(view: View, photo: Tensor, maps: Maps) -> None:
        write_picture(picture_path(this.pictures, view.name), panel(photo, maps))

    with meter.adding("pictures") if meter else nullcontext():
        measured = evaluate_views(
            scene.held_out,
            photo_cache(scene.held_out, ahead),
            draw,
            timed=colors,
            show=show,
            correct_color=this.recipe.pretrain.appearance is not None,
            masks=mask_cache(scene.held_out, ahead),
        )
    if meter:
        emit(MemoryTaken(meter.report()))
    memory = read_record(this.out).get("memory_bytes") or {}
    metrics = {
        **measured,
        "fps": measured["fps"] or frames_per_second(scene.train, colors),
        "points": len(state.points),
        "steps": state.index,
        "seconds": state.seconds,
        "cpu_seconds": state.cpu_seconds,
        "peak_memory_bytes": max(state.peak_memory_bytes, memory.get("peak", 0)) or None,
        "memory_bytes": memory,
    }
    write_json(this.metrics, metrics)
    emit(FileWritten(this.metrics, "metrics"))
    return metrics


def load_run(out: Path) -> tuple[Run, StageState, Scene]:
    """A run folder, the state of its optimisation, and the scene that it was made from.

    Raises:
        BadInput: The folder holds no run, or one that is not finished.
    """
    refuse_no_run(out)
    this = Run(out, read_json(out / "recipe.json", Recipe), read_data(out))
    scene = read(this.data)
    state = saved(this, scene)
    steps = this.recipe.pretrain.steps
    if state is None or state.index < steps:
        raise BadInput(
            f"{out}: the run stopped after step {state.index if state else 0} of {steps}; "
            "give its surfkit train command again to finish it"
        )
    return this, state, scene


def drawer(device: Device) -> tuple[Rasterizer, str]:
    """The rasterizer for a device and its name; what is warned of on the way becomes a note."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rasterizer, name = select(device)
    for warning in caught:
        emit(Warned(str(warning.message)))
    return rasterizer, name


def warn_of_gaps(scene: Scene, state: StageState | None) -> None:
    """Say what the data does not allow."""
    if state is None and not scene.held_out:
        emit(Warned("no photograph is kept from training, so the quality cannot be measured; see --test-every"))
