"""Recipe and data to a run folder: what happens, from top to bottom."""

from __future__ import annotations

import json
import platform
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load, read_json, write_json
from surfkit.core.events import FileWritten, StageBegan, StageEnded, Warned, emit
from surfkit.core.registry import hookimpl, plugins, records
from surfkit.core.schedule import rescale
from surfkit.core.version import own_version
from surfkit.evaluate.images import evaluate_views, frames_per_second
from surfkit.evaluate.pictures import panel, picture_path, write_picture
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
from surfkit.train.interrupt import graceful
from surfkit.train.progress import Display, peak_memory_bytes
from surfkit.train.stage import StageState, Trainer

CHECKPOINT_EVERY = 500


@dataclass(frozen=True)
class Run:
    """A run folder and what it was made from.

    Attributes:
        out: The folder.
        recipe: Part of it as recipe.json.
        data: Part of it in run.json.
    """

    out: Path
    recipe: Recipe
    data: Data

    @property
    def checkpoint(self) -> Path:
        """The state of the optimisation."""
        return self.out / "pretrain" / "checkpoint.safetensors"

    @property
    def metrics(self) -> Path:
        """The measurements."""
        return self.out / "metrics.json"

    @property
    def cloud(self) -> Path:
        """The points, in the frame of the input."""
        return self.out / "point_cloud.ply"

    @property
    def pictures(self) -> Path:
        """Renders beside the photographs."""
        return self.out / "pictures"


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
    cache: str = "auto",
) -> dict[str, Any]:
    """Train, write the results into `out` and return the metrics; an interrupted run goes on where it stopped.

    `cache` is the memory for photographs, masks and depth priors, such as "4GB"; the result does not depend on it.

    Raises:
        BadInput: `out` holds a run of another recipe or of other data, or the data cannot be used.
        KeyboardInterrupt: The run was asked to stop, and has saved its state.
    """
    this = Run(out, recipe, replace(data, path=data.path.resolve()))
    refuse_other(this)
    budget = cache_bytes(cache)
    with noted() as notes:
        scene = read(this.data)
        rasterizer, backend = drawer(device)
        state = saved(this, scene)
        warn_of_gaps(scene, state)
        unfinished = state is None or state.index < recipe.pretrain.steps
        claim(this, backend, notes)
        if unfinished:
            discard(this.metrics, this.cloud)
            state = optimise(this, scene, rasterizer, state, checkpoint_every, read_ahead(this, scene, budget))
        elif this.metrics.exists() and this.cloud.exists():
            say(f"{out} is finished; delete {this.metrics.name} in it to measure again")
            return read_json(this.metrics, Any)
        if not this.cloud.exists():
            export(this, state, scene)
        return evaluate(this, state, scene, rasterizer, budget)


def refuse_other(this: Run) -> None:
    """BadInput if the folder holds a run that this one does not continue."""
    if this.out.exists() and not this.out.is_dir():
        raise BadInput(f"--out {this.out}: a file, not a folder; name another one")
    for name, key, value in (("recipe.json", None, this.recipe), ("run.json", "data", this.data)):
        path = this.out / name
        if not path.exists():
            continue
        there = read_json(path, Any)
        before = there if key is None else dump(load(Data, there.get(key), key))  # with the defaults of newer settings
        found = difference(before, dump(value), key or "")
        if found is not None:
            at, old, new = found
            raise BadInput(
                f"--out {this.out} holds a run with {at} {short(old)}, and this one has {short(new)}; "
                "name another folder, or delete that one"
            )


def difference(old: Any, new: Any, at: str) -> tuple[str, Any, Any] | None:
    """Path and both values of the first difference between plain data; what a recipe says of itself does not count."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            path = f"{at}.{key}" if at else key
            if path != "about" and (found := difference(old.get(key), new.get(key), path)):
                return found
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = enumerate(zip(old, new, strict=True))
        return next((found for i, (a, b) in pairs if (found := difference(a, b, f"{at}.{i}"))), None)
    return None if old == new else (at, old, new)


def claim(this: Run, backend: str, notes: list[str]) -> None:
    """Write down what the run is made from, and on what it runs."""
    path = this.out / "run.json"
    before = read_json(path, Any)["notes"] if path.exists() else []
    write_json(this.out / "recipe.json", this.recipe)
    write_json(
        path,
        {
            "versions": {"surfkit": own_version(), "python": platform.python_version(), "torch": torch.__version__},
            "plugins": [str(plugin) for plugin in records() if plugin.distribution],
            "device": backend,
            "threads": torch.get_num_threads(),
            "seed": this.recipe.seed,
            "data": this.data,
            "notes": list(dict.fromkeys([*before, *notes])),
        },
    )


def saved(this: Run, scene: Scene) -> StageState | None:
    """The state of the last checkpoint, if there is one and the data is still what it was."""
    if not this.checkpoint.exists():
        return None
    state = checkpoint.load(this.checkpoint)
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
    checkpoint_every: int,
    given: Material,
) -> StageState:
    """Run the stage from its last state, or from the sparse points, to its end."""
    stage, primitive = this.recipe.pretrain, this.recipe.primitive
    sources = (given.photos, rasterizer, given.priors, given.masks, given.expect)
    trainer = Trainer(stage, primitive, scene.train, *sources)
    if state is None:
        generator = torch.Generator().manual_seed(this.recipe.seed)
        state = trainer.begin(Points.fresh(primitive.init(scene.cloud, generator)), generator)
    else:
        say(f"{this.out}: going on after step {state.index} of {stage.steps}")
    emit(StageBegan("pretrain", stage.steps, len(state.points), state.index + 1))
    seconds = state.seconds
    with graceful() as request, Display("pretrain", stage.steps) as display:
        for done in trainer.run(state):
            display.show(done)
            if request.asked or done.index % checkpoint_every == 0 or done.index == stage.steps:
                state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes())
                checkpoint.save(this.checkpoint, state)
                emit(FileWritten(this.checkpoint, "checkpoint"))
            if request.asked:
                break
    if request.asked:
        say(f"stopped after step {state.index} of {stage.steps}; the same command goes on from there")
        raise KeyboardInterrupt
    emit(StageEnded("pretrain", stage.steps, len(state.points), state.seconds - seconds))
    return state


def export(this: Run, state: StageState, scene: Scene) -> None:
    """Write the points in the frame of the input."""
    params = this.recipe.pretrain.finished(state)
    write_splats(this.cloud, to_table(this.recipe.primitive, params).in_input_frame(scene.frame))
    emit(FileWritten(this.cloud, "points"))


def evaluate(
    this: Run, state: StageState, scene: Scene, rasterizer: Rasterizer, budget_bytes: int | None = None
) -> dict[str, Any]:
    """Measure on the held-out photographs, write metrics and pictures, and return the metrics."""
    stage, primitive = this.recipe.pretrain, this.recipe.primitive
    degree = min(primitive.sh_degree, state.index // stage.sh_every)
    splats = primitive.shape(stage.finished(state), degree)

    def draw(view: View) -> Maps:
        return rasterizer.render(splats, view.camera, stage.near).maps

    def colors(view: View) -> Maps:
        return rasterizer.render(splats, view.camera, stage.near, geometry=False).maps

    def show(view: View, photo: Tensor, maps: Maps) -> None:
        write_picture(picture_path(this.pictures, view.name), panel(photo, maps))

    measured = evaluate_views(
        scene.held_out,
        photo_cache(scene.held_out, budget_bytes),
        draw,
        timed=colors,
        show=show,
        correct_color=stage.appearance is not None,
        masks=mask_cache(scene.held_out, budget_bytes),
    )
    metrics = {
        **measured,
        "fps": measured["fps"] or frames_per_second(scene.train, colors),
        "points": len(state.points),
        "steps": state.index,
        "seconds": state.seconds,
        "cpu_seconds": state.cpu_seconds,
        "peak_memory_bytes": state.peak_memory_bytes or None,
    }
    write_json(this.metrics, metrics)
    emit(FileWritten(this.metrics, "metrics"))
    return metrics


def load_run(out: Path) -> tuple[Run, StageState, Scene]:
    """A run folder, the state of its optimisation, and the scene that it was made from.

    Raises:
        BadInput: The folder holds no run, or one that is not finished.
    """
    if not (out / "recipe.json").exists() or not (out / "run.json").exists():
        raise BadInput(f"{out}: no run folder (no recipe.json and run.json in it); name one that surfkit train made")
    record = read_json(out / "run.json", Any)
    this = Run(out, read_json(out / "recipe.json", Recipe), load(Data, record["data"], "data"))
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


class Notes:
    """Keeps and prints the warnings of a run."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if isinstance(event, Warned):
            self.texts.append(event.text)
            say(f"note: {event.text}")


@contextmanager
def noted() -> Iterator[list[str]]:
    """The warnings of what happens within, as a list that grows."""
    notes = Notes()
    plugins().register(notes, "notes of the run")
    try:
        yield notes.texts
    finally:
        plugins().unregister(notes)


def discard(*paths: Path) -> None:
    """Delete results that further steps make wrong."""
    for path in paths:
        path.unlink(missing_ok=True)


def say(text: str) -> None:
    """Tell the person who watches."""
    print(text, file=sys.stderr)


def short(value: Any) -> str:
    """A value in a few words."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
