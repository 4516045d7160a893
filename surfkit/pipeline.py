"""Recipe and data to a run folder: what happens, from top to bottom."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import load, read_json
from surfkit.core.events import FileWritten, StageBegan, StageEnded, Warned, emit
from surfkit.core.files import sweep
from surfkit.core.journal import kept
from surfkit.core.lock import held
from surfkit.core.memory import peak_memory_bytes
from surfkit.core.schedule import rescale
from surfkit.evaluate.along import Along
from surfkit.evaluate.images import Draw, evaluate_views, frames_per_second
from surfkit.evaluate.lpips import networks
from surfkit.evaluate.pictures import panel, picture_path, write_picture
from surfkit.folder import Run, claim, discard, note_metrics, noted, refuse_changed, refuse_file, refuse_other, say
from surfkit.primitives.base import to_table
from surfkit.primitives.points import Points
from surfkit.raster.api import Maps, Rasterizer
from surfkit.raster.select import Device, select
from surfkit.recipe import Recipe
from surfkit.scene.cache import Cache, share
from surfkit.scene.data import Data
from surfkit.scene.depth_prior import Priors, read_priors
from surfkit.scene.masks import mask_cache, mask_sizes
from surfkit.scene.memory import cache_bytes
from surfkit.scene.photos import photo_cache
from surfkit.scene.ply import write_splats
from surfkit.scene.read import read
from surfkit.scene.scene import Scene, View
from surfkit.train import checkpoint
from surfkit.train.faults import MOST_HALVINGS, Diverged, in_one_line
from surfkit.train.interrupt import graceful
from surfkit.train.progress import Display
from surfkit.train.stage import StageState, Trainer

CHECKPOINT_EVERY = 500


@dataclass(frozen=True)
class Every:
    """Steps between what is written while a stage runs.

    Attributes:
        checkpoint: States of the optimisation.
        pictures: Pictures of a few held-out views; 0 for none.
    """

    checkpoint: int = CHECKPOINT_EVERY
    pictures: int = 0


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
    checkpoint_every: int = CHECKPOINT_EVERY,
    pictures_every: int | None = None,
    cache: str = "auto",
) -> dict[str, Any]:
    """Train, write the results into `out` and return the metrics; an interrupted run goes on where it stopped.

    Args:
        recipe: What to do.
        data: What to do it with.
        out: Run folder.
        device: Where to compute.
        checkpoint_every: Steps between checkpoints.
        pictures_every: Steps between pictures of a few held-out views; a fifth of the run if None, 0 for none.
        cache: Memory for photographs, masks and depth priors, such as "4GB"; the result does not depend on it.

    Raises:
        BadInput: `out` holds a run of another recipe or of other data, another process works in it, or the data cannot
            be used.
        Fault: Memory, disk or numbers gave out; the last checkpoint is whole.
        KeyboardInterrupt: The run was asked to stop, and has saved its state.
    """
    this = Run(out, recipe, replace(data, path=data.path.resolve()))
    pictures_every = max(1, recipe.pretrain.steps // 5) if pictures_every is None else pictures_every
    refuse_file(out)
    budget = cache_bytes(cache)
    with noted() as notes, held(out), in_one_line(out):
        sweep(out)
        refuse_other(this)
        scene = read(this.data)
        rasterizer, backend = drawer(device)
        state = saved(this, scene, repair=True)
        prints = refuse_changed(this, scene, {scene.train[at].name for at in state.skipped} if state else set())
        warn_of_gaps(scene, state)
        unfinished = state is None or state.index < recipe.pretrain.steps
        given = read_ahead(this, scene, budget) if unfinished else None
        claim(this, backend, prints, notes)
        with kept(out):
            if unfinished:
                discard(this.metrics, this.cloud)
                every = Every(checkpoint_every, pictures_every)
                state = optimise(this, scene, rasterizer, state, every, given)
            elif this.metrics.exists() and this.cloud.exists():
                say(f"{out} is finished; delete {this.metrics.name} in it to measure again")
                return read_json(this.metrics, Any)
            if not this.cloud.exists():
                export(this, state, scene)
            return evaluate(this, state, scene, rasterizer, budget)


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


@dataclass(frozen=True)
class Material:
    """What training looks at, by position of the view.

    Attributes:
        photos: (3, H, W) uint8.
        masks: (H, W) bool or None.
        priors: Estimated depths, if a loss of the recipe needs them and the data set has any.
    """

    photos: Cache[Tensor]
    masks: Cache[Tensor | None] | None = None
    priors: Priors | None = None

    def expect(self, coming: Sequence[int]) -> None:
        """Read in this order from now on."""
        for cache in filter(None, (self.photos, self.masks, self.priors)):
            cache.expect(coming)


def read_ahead(this: Run, scene: Scene, budget_bytes: int) -> Material:
    """The photographs, masks and depth priors of the training views, within a number of bytes."""
    pixels = sum(view.camera.width * view.camera.height for view in scene.train)
    needed = any(loss.needs_prior for loss in this.recipe.pretrain.losses.values())
    wanted = [3 * pixels, sum(mask_sizes(scene.train)), 8 * pixels if needed else 0]
    for_photos, for_masks, for_priors = share(budget_bytes, wanted)
    priors = read_priors(this.data, scene, for_priors) if needed else None
    return Material(photo_cache(scene.train, for_photos), mask_cache(scene.train, for_masks), priors)


def optimise(
    this: Run,
    scene: Scene,
    rasterizer: Rasterizer,
    state: StageState | None,
    every: Every,
    given: Material,
) -> StageState:
    """Run the stage from its last state, or from the sparse points, to its end.

    After numbers that are not finite it goes back to its last checkpoint with half the learning rates, twice at most.
    """
    stage, primitive = this.recipe.pretrain, this.recipe.primitive
    sources = (given.photos, rasterizer, given.priors, given.masks, given.expect)
    trainer = Trainer(stage, primitive, scene.train, *sources)
    along = Along(this.out / "progress", scene.held_out) if every.pictures and scene.held_out else None

    def begin() -> StageState:
        generator = torch.Generator().manual_seed(this.recipe.seed)
        return trainer.begin(Points.fresh(primitive.init(scene.cloud, generator)), generator)

    if state is not None:
        say(f"{this.out}: going on after step {state.index} of {stage.steps}")
    state = state or begin()
    while True:
        try:
            return take_steps(this, trainer, state, every, along)
        except Diverged as error:
            state = rolled_back(this, state.halvings, error, begin)


def take_steps(this: Run, trainer: Trainer, state: StageState, every: Every, along: Along | None) -> StageState:
    """Take the steps that are left, and write checkpoints and pictures on the way."""
    steps, seconds = trainer.stage.steps, state.seconds
    emit(StageBegan("pretrain", steps, len(state.points), state.index + 1))
    with graceful() as request, Display("pretrain", steps) as display:
        for done in trainer.run(state):
            display.show(done)
            if along is not None and done.index % every.pictures == 0 and done.index < steps:
                along.look(done.index, drawing(this, state, trainer.rasterizer))
            if request.asked or done.index % every.checkpoint == 0 or done.index == steps:
                state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())
                checkpoint.save(this.checkpoint, state)
                emit(FileWritten(this.checkpoint, "checkpoint"))
            if request.asked:
                break
    if request.asked:
        say(f"stopped after step {state.index} of {steps}; the same command goes on from there")
        raise KeyboardInterrupt
    emit(StageEnded("pretrain", steps, len(state.points), state.seconds - seconds))
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
    """Write the points in the frame of the input."""
    params = this.recipe.pretrain.finished(state)
    write_splats(this.cloud, to_table(this.recipe.primitive, params).in_input_frame(scene.frame))
    emit(FileWritten(this.cloud, "points"))


def evaluate(
    this: Run,
    state: StageState,
    scene: Scene,
    rasterizer: Rasterizer,
    budget_bytes: int | None = None,
    lpips_weights: str = "auto",
) -> dict[str, Any]:
    """Measure on the held-out photographs, write pictures and metrics, and return all the metrics there are."""
    sides = [min(view.camera.width, view.camera.height) for view in scene.held_out]
    perceptual, lacking = networks(lpips_weights, min(sides)) if sides else ((), None)
    draw, colors = (drawing(this, state, rasterizer, geometry) for geometry in (True, False))

    def show(view: View, photo: Tensor, maps: Maps) -> None:
        write_picture(picture_path(this.pictures, view.name), panel(photo, maps))

    measured = evaluate_views(
        scene.held_out,
        photo_cache(scene.held_out, budget_bytes),
        draw,
        timed=colors,
        show=show,
        correct_color=this.recipe.pretrain.appearance is not None,
        masks=mask_cache(scene.held_out, budget_bytes),
        networks=perceptual,
    )
    if lacking is not None:
        measured["images"]["lpips_not_measured"] = lacking
    metrics = {
        **measured,
        "fps": measured["fps"] or frames_per_second(scene.train, colors),
        "points": len(state.points),
        "steps": state.index,
        "seconds": state.seconds,
        "cpu_seconds": state.cpu_seconds,
        "peak_memory_bytes": state.peak_memory_bytes or None,
    }
    return note_metrics(this.metrics, metrics)


def opened(out: Path) -> Run:
    """A run folder and what it was made from, finished or not.

    Raises:
        BadInput: The folder holds no run.
    """
    if not (out / "recipe.json").exists() or not (out / "run.json").exists():
        raise BadInput(f"{out}: no run folder (no recipe.json and run.json in it); name one that surfkit train made")
    record = read_json(out / "run.json", Any)
    return Run(out, read_json(out / "recipe.json", Recipe), load(Data, record["data"], "data"))


def load_run(out: Path) -> tuple[Run, StageState, Scene]:
    """A run folder, the state of its optimisation, and the scene that it was made from.

    Raises:
        BadInput: The folder holds no run, or one that is not finished.
    """
    this = opened(out)
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
