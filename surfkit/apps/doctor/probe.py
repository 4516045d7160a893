"""A few steps of a run, spread over its schedule, measured in a process of their own.

A process that ends gives back all it took, and one that the system kills for want of memory takes nothing with it.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import random
import signal
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from surfkit.core.memory import peak_memory_bytes
from surfkit.densify.base import Prune, Step
from surfkit.evaluate.images.comparison_pictures import panel, write_picture
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.io.datasets.masks import view_mask
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.io.splats.ply import write_splats
from surfkit.primitives.base import Primitive
from surfkit.primitives.edit import Edit, apply
from surfkit.primitives.points import Points
from surfkit.raster.nvrtc.gpu_memory import free_gpu_bytes, peak_gpu_bytes
from surfkit.raster.select import Device, select
from surfkit.runs.recipe import Recipe
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Scene, View
from surfkit.scene.vectors import unit
from surfkit.train import checkpoint
from surfkit.train.data_cache import needs_normals
from surfkit.train.stage import Stage
from surfkit.train.state import StageState
from surfkit.train.trainer import Trainer

WARM = 2
"""Steps of each part before the clock counts: caches are cold and memory is new."""
PART_S = 0.4
"""Cheap steps are taken for so long in each part, since a few of them tell little of the others; but no more where the
next one may add points, as the part is to be measured with so many."""
EDITED = 0.05
"""Share of the points that go, and of those that come, in the edit of each part: an edit holds the points several times
over."""
DRAWN = 2_000
"""Steps of a part that are looked at to tell how many of them take a second view."""


@dataclass(frozen=True)
class EditStress(Prune):
    """Some points go and as many come, at given steps: memory is at its highest while a step edits its points."""

    at: tuple[int, ...] = ()
    """Steps."""

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Drop some, and clone others."""
        if step.index not in self.at:
            return None
        draw = torch.rand(len(points), generator=torch.Generator().manual_seed(step.index))
        draw = draw.to(points.params["means"].device)
        return Edit(drop=draw < EDITED, clone=draw > 1 - EDITED)


@dataclass(frozen=True)
class ProbeSegment:
    """A part of the schedule, measured at its middle.

    Attributes:
        index: Steps before it.
        points: How many there are by then.
        share: Of all steps.
    """

    index: int
    points: int
    share: float


@dataclass(frozen=True)
class ProbeJob:
    """What to measure.

    Attributes:
        recipe: Of the run.
        scene: With a few of the training views, and all points.
        parts: With points that do not fall.
        steps: Steps of all parts together.
        seconds: After so long, a part ends early.
        priors: Whether the losses are to be given depth priors.
        device: Where to compute.
        threads: Of the run; 0 for as many as torch uses.
    """

    recipe: Recipe
    scene: Scene
    parts: tuple[ProbeSegment, ...]
    steps: int
    seconds: float
    priors: bool
    device: Device = "auto"
    threads: int = 0


@dataclass(frozen=True)
class ProbeStart:
    """Measured before the first step.

    Attributes:
        photo_seconds: To read one photograph.
        init_seconds: To make the points.
        held_bytes: Photographs, masks and priors in memory.
        gpu_free_bytes: What the GPU has free; 0 without one.
    """

    photo_seconds: float
    init_seconds: float
    held_bytes: int
    gpu_free_bytes: int = 0


@dataclass(frozen=True)
class SegmentCosts:
    """Measured in one part.

    Attributes:
        points: How many there were.
        seconds: Of a step: the median one, or the mean of the medians where some take a second view.
        peak_bytes: Most memory that the process has held by its end.
        gpu_bytes: The same of the memory of the GPU; 0 without one.
        divisor: By which photographs were smaller at its beginning (`Stage.divisor_at`).
    """

    points: int
    seconds: float
    peak_bytes: int
    gpu_bytes: int = 0
    divisor: int = 1


@dataclass(frozen=True)
class ProbeOutput:
    """Measured after the last step.

    Attributes:
        checkpoint_bytes: A point's share of a checkpoint.
        cloud_bytes: A point's share of the file of points.
        picture_bytes: A picture of a held-out view.
        draw_seconds: To render and write such a picture.
        save_seconds: To write a checkpoint of the points of the last part.
        peak_bytes: Most memory that the process has held.
    """

    checkpoint_bytes: float
    cloud_bytes: float
    picture_bytes: int
    draw_seconds: float
    save_seconds: float
    peak_bytes: int


@dataclass(frozen=True)
class ProbeResult:
    """What a probe has measured.

    Attributes:
        started: None if it did not come so far.
        taken: One for each part that came to its end.
        written: None if it did not come so far.
        failure: Why it ended early, in a few words; None if it did not.
    """

    started: ProbeStart | None
    taken: tuple[SegmentCosts, ...]
    written: ProbeOutput | None
    failure: str | None = None


def probe(job: ProbeJob, told: Callable[[int, int], None] | None = None) -> ProbeResult:
    """Measure, in a new process.

    Args:
        job: What to measure.
        told: Called with the parts done and their number.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    found: list[ProbeStart | SegmentCosts | ProbeOutput | str] = []
    with tempfile.TemporaryDirectory(prefix="surfkit-doctor-") as folder:
        # As a file: a process that dies before it has read its arguments leaves `start` waiting if they fill a pipe.
        Path(folder, "job").write_bytes(pickle.dumps(job))
        process = context.Process(target=_work, args=(theirs, folder), daemon=True)
        process.start()
        theirs.close()
        try:
            with suppress(EOFError):
                while True:
                    found.append(ours.recv())
                    if told is not None:
                        told(sum(isinstance(one, SegmentCosts) for one in found), len(job.parts))
            process.join()
        finally:
            process.kill()
    failure = next((one for one in found if isinstance(one, str)), None)
    if failure is None and process.exitcode:
        killed = process.exitcode == -signal.SIGKILL
        failure = "the system killed it, as it does when memory runs out" if killed else "it crashed"
    return ProbeResult(
        next((one for one in found if isinstance(one, ProbeStart)), None),
        tuple(one for one in found if isinstance(one, SegmentCosts)),
        next((one for one in found if isinstance(one, ProbeOutput)), None),
        failure,
    )


def _work(connection: Connection, folder: str) -> None:
    """What the new process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)  # what goes wrong is told through the connection
        job: ProbeJob = pickle.loads(Path(folder, "job").read_bytes())
        if job.threads:
            torch.set_num_threads(job.threads)
        for found in measure(job):
            connection.send(found)
    except Exception as error:  # whatever it is, the parent has to know
        connection.send(f"{type(error).__name__}: {' '.join(str(error).split())}")
    finally:
        connection.close()


def measure(job: ProbeJob) -> Iterator[ProbeStart | SegmentCosts | ProbeOutput]:
    """Measure, in this process."""
    load_pycolmap()  # a run has loaded it too, to read the data
    recipe, views, start = job.recipe, job.scene.train, time.perf_counter()
    photos = [view_photo(view) for view in views]
    photo_seconds = (time.perf_counter() - start) / len(views)
    masks = [view_mask(view) for view in views]
    normals = needs_normals(recipe.pretrain.losses)
    priors = [_made_up_prior(view, normals) for view in views] if job.priors else None
    held = sum(photo.numel() for photo in photos) + sum(mask.numel() for mask in masks if mask is not None)
    held += sum((20 if normals else 8) * prior.inverse.numel() for prior in priors or ())
    generator, start = torch.Generator().manual_seed(recipe.seed), time.perf_counter()
    points = Points.fresh(recipe.primitive.init(job.scene.cloud, generator), recipe.primitive.shared())
    init_seconds, rasterizer = time.perf_counter() - start, select(job.device)[0]
    on_gpu = rasterizer.where().type == "cuda"
    yield ProbeStart(photo_seconds, init_seconds, held, free_gpu_bytes() if on_gpu else 0)
    churn = EditStress(tuple(part.index + 1 for part in job.parts))
    stage = replace(recipe.pretrain, prune=(*recipe.pretrain.prune, churn))
    trainer = Trainer(stage, recipe.primitive, views, photos, rasterizer, priors, masks, beside=_next_of(len(views)))
    state = trainer.begin(points, generator)
    del points
    done = 0.0
    for part in job.parts:
        first, done = round(done * stage.steps), done + part.share
        own = range(first + 1, max(first + 1, round(done * stage.steps)) + 1)
        yield _taken(trainer, state, part, job, by_kind(stage, own))
    yield _written(trainer, state)


def _next_of(count: int) -> Callable[[int, torch.Tensor], list[int]]:
    """The next view is the second one of each: points that are not trained show no surface to choose it by."""
    return lambda at, depth: [(at + 1) % count] if count > 1 else []


def by_kind(stage: Stage, own: range) -> dict[bool, list[int]]:
    """Some steps of a part, evenly drawn, by whether they take a second view."""
    drawn = sorted(random.Random(0).sample(own, min(DRAWN, len(own))))
    kinds = {paired: [index for index in drawn if stage.is_paired(index) == paired] for paired in (False, True)}
    return {paired: indices for paired, indices in kinds.items() if indices}


def _made_up_prior(view: View, normals: bool) -> DepthPrior:
    """As large as a real one, which takes the sparse points of all photographs to read."""
    ones = torch.ones(view.camera.height, view.camera.width)
    towards = -unit(view.camera.rays()) if normals else None
    return DepthPrior(ones, ones.clone(), 1.0, towards)


def _taken(
    trainer: Trainer, state: StageState, part: ProbeSegment, job: ProbeJob, kinds: dict[bool, list[int]]
) -> SegmentCosts:
    """Take steps of a part, with an edit in the first, and then of the kind (`by_kind`) that was not among them."""
    state.points = with_count(trainer.primitive, state.points, part.points, state.generator)
    state.index = part.index
    wanted = max(WARM + 1, job.steps // len(job.parts))
    times: list[tuple[bool, float]] = []
    begun = time.perf_counter()
    spent, edits = 0.0, _edits(trainer.stage)
    while state.index < trainer.stage.steps:
        if len(times) >= wanted and (spent >= PART_S or state.index + 1 in edits):
            break
        times.append(_timed(trainer, state))
        spent = time.perf_counter() - begun
        if spent > job.seconds / len(job.parts) and len(times) > WARM:
            break
    counted = times[WARM:] or times
    seconds = 0.0
    for paired, indices in kinds.items():
        own = [taken for kind, taken in counted if kind == paired]
        for index in [] if own else indices[: WARM + 1]:
            state.index = index - 1
            own = [_timed(trainer, state)[1]]
        seconds += statistics.median(own) * len(indices) / sum(map(len, kinds.values()))
    divisor = trainer.stage.divisor_at(part.index + 1)
    return SegmentCosts(len(state.points), seconds, peak_memory_bytes(), peak_gpu_bytes(), divisor)


def _edits(stage: Stage) -> Sequence[int]:
    """The steps that may add points; all of them where the densifier does not tell."""
    known = () if stage.densify is None else stage.densify.edits(stage.steps)
    return range(1, stage.steps + 1) if known is None else known


def _timed(trainer: Trainer, state: StageState) -> tuple[bool, float]:
    """Take a step: whether it has a second view, and the seconds."""
    start = time.perf_counter()
    trainer.step(state)
    return trainer.stage.is_paired(state.index), time.perf_counter() - start


def _written(trainer: Trainer, state: StageState) -> ProbeOutput:
    """Write what a run writes, into a folder that is deleted at once."""
    count, view = len(state.points), trainer.views[0]
    with tempfile.TemporaryDirectory(prefix="surfkit-doctor-") as name:
        folder, start = Path(name), time.perf_counter()
        checkpoint.save(folder / "checkpoint.safetensors", state)
        save_seconds, start = time.perf_counter() - start, time.perf_counter()
        splats = trainer.primitive.activate(state.points.all_params(), state.sh_degree)
        maps = trainer.rasterizer.render(splats, view.camera, trainer.stage.near, True).maps
        write_picture(folder / "picture.png", panel(trainer.photos[0], maps))
        draw_seconds = time.perf_counter() - start
        write_splats(folder / "cloud.ply", trainer.primitive.table(state.points.all_params()))
        sizes = {path.stem: path.stat().st_size for path in folder.iterdir()}
    per_point = sizes["checkpoint"] / count, sizes["cloud"] / count
    return ProbeOutput(*per_point, sizes["picture"], draw_seconds, save_seconds, peak_memory_bytes())


def with_count(primitive: Primitive, points: Points, count: int, generator: torch.Generator) -> Points:
    """As many points: some split, as densification does, or some left out."""
    while len(points) < count:
        chosen = torch.randperm(len(points), generator=generator)[: count - len(points)]
        split = torch.zeros(len(points), dtype=torch.bool).index_fill(0, chosen, True)
        points = apply(primitive, points, Edit(split=split), generator)
    if len(points) > count:
        points = points.take(torch.randperm(len(points), generator=generator)[:count].sort().values)
    return points


def some(scene: Scene, views: Sequence[View]) -> Scene:
    """The scene with these training views only."""
    return replace(scene, train=tuple(views), held_out=())
