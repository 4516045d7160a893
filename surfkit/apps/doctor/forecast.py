"""What a run will take: a probe of the data set that was examined, and what follows from it."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from surfkit.apps.doctor.estimate import FixedCosts, MachineLimits, ResourceEstimate, advice, estimate, first_look
from surfkit.apps.doctor.examine import ExaminedData, Told
from surfkit.apps.doctor.few_photographs import Foretold, foretell
from surfkit.apps.doctor.finding import Finding, from_errors
from surfkit.apps.doctor.gather import depth_maps, heard
from surfkit.apps.doctor.growth import Growth, growth
from surfkit.apps.doctor.probe import ProbeJob, ProbeResult, ProbeSegment, probe
from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import prior_bytes
from surfkit.io.datasets.panoramas import PANORAMAS_FOLDER as PANORAMAS
from surfkit.io.datasets.panoramas import view_names, view_sizes
from surfkit.io.datasets.read import build_scene
from surfkit.io.datasets.undistort import cache_folder, is_pinhole
from surfkit.raster.select import Device
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_stage import CHECKPOINT_EVERY
from surfkit.scene.available_memory import cache_bytes, free_bytes
from surfkit.scene.decoded_photos import place
from surfkit.scene.scene import Scene
from surfkit.train.data_cache import needs_normals, needs_priors
from surfkit.train.in_view import why_all

PROBE_VIEWS = 10
"""Photographs that the probe trains on, evenly chosen; each part of it sees all of them."""
SCHEDULE_PARTS = 5
"""Parts of the schedule, each measured at its middle."""
MAX_PROBE_S = 120.0
"""Most that the steps of a probe take, unless two or three of each part take longer."""
MAX_PROBE_POINTS = 1_000_000
"""Points with which a probe takes steps; what more of them take is extrapolated."""
PROBE_POINT_BYTES = 4_000
"""Memory of a point, at most; a probe must not fill the machine."""


@dataclass(frozen=True)
class ProbePlan:
    """How to measure, and for which run.

    Attributes:
        steps: Of the probe.
        points: At the end of the run, where the user says so.
        cache: As for `surfkit train --cache`.
        device: Where to compute.
        out: Where the run folder will be.
        threads: That the run will have; 0 for as many as torch uses.
    """

    steps: int = 50
    points: int | None = None
    cache: str = "auto"
    device: Device = "auto"
    out: Path = Path("runs")
    threads: int = 0


def forecast(
    data: Data, recipe: Recipe, examined: ExaminedData, plan: ProbePlan, told: Told | None = None
) -> tuple[ResourceEstimate | None, list[Finding]]:
    """What the run of a recipe will take, and what to lower where it will not fit.

    Args:
        data: A data set without errors.
        recipe: What to do with it.
        examined: What is known of it.
        plan: How to measure.
        told: Hears of the progress.
    """
    begun, room = time.perf_counter(), _room(data, plan)
    load = _load(data, recipe, examined, plan)
    with tempfile.TemporaryDirectory(prefix="surfkit-doctor-") as folder:
        try:
            scene, load = _scene(data, examined, load, Path(folder) / "probe")
            if told is not None:
                told("a few photographs", 0, 1)
            few = foretell(data, examined, recipe, plan.device, Path(folder) / "few")
            if told is not None:
                told("a few photographs", 1, 1)
        except BadInput as error:
            return None, from_errors("probe", [error])
        sizes = read_sizes(data, examined, {s.name for s in examined.gathered.train})
        pixels = sum(w * h for w, h in sizes)
        first = few.points or recipe.start.expected(len(scene.cloud.xyz), pixels)
        rising = growth(recipe.pretrain, first, pixels, plan.points, recipe.start.is_dense)
        parts = schedule(recipe.pretrain.steps, rising)
        held_back = within(parts, min(MAX_PROBE_POINTS, int(0.4 * room.memory_bytes / PROBE_POINT_BYTES)))
        wanted = load.view_bytes > 0 and needs_priors(recipe.pretrain.losses)
        priors = wanted and bool(_with_maps(data, examined, recipe))
        job = ProbeJob(recipe, scene, held_back, plan.steps, MAX_PROBE_S, priors, plan.device, plan.threads)
        probed = probe(job, None if told is None else lambda done, all_: told("probe", done, all_))
    if probed.failure is not None or probed.written is None:
        return None, [_failed(probed, held_back)]
    found = estimate(load, parts, rising, probed, room)
    steps = sum(refine.stage.steps for refine in recipe.refine)
    found = replace(
        found,
        probe_seconds=time.perf_counter() - begun,
        depth_seconds=few.depth_seconds,
        mesh=few.mesh,
        first=first,
        refine_seconds=few.refine_depth_seconds + steps * found.step_seconds[-1],
    )
    look = first_look(found) if recipe.start.is_dense and recipe.start.needs_prior else []
    return found, [*beyond(recipe, few), *advice(found), *look]


def beyond(recipe: Recipe, few: Foretold) -> list[Finding]:
    """What of the run the forecast leaves out."""
    later = ["the blocks, which are foretold when they are planned"] if recipe.partition is not None else []
    later += (
        ["making depth maps, where the data set has none"] if recipe.depth is not None and not few.depth_seconds else []
    )
    again = any(refine.estimator is not None for refine in recipe.refine) and not few.refine_depth_seconds
    later += ["making depth maps from what the model draws"] if again else []
    later += ["making the mesh"] if recipe.mesh is not None and few.mesh is None else []
    text = f"memory, disk and time are those of pretraining alone; the run needs more for: {'; '.join(later)}"
    return [Finding("note", "forecast", text)] if later else []


def schedule(steps: int, rising: Growth) -> tuple[ProbeSegment, ...]:
    """The middles of equal parts of a run, aside from the round steps at which points are edited."""
    middles = [round((at + 0.5) / SCHEDULE_PARTS * steps) for at in range(SCHEDULE_PARTS)]
    indices = [at // 100 * 100 + 40 if steps >= 1_000 else at for at in middles]
    return tuple(ProbeSegment(at, rising.at(at / steps), 1 / SCHEDULE_PARTS) for at in indices)


def within(parts: Sequence[ProbeSegment], most: int) -> tuple[ProbeSegment, ...]:
    """Parts with at most so many points; of different numbers where all had more, so that a slope can be measured."""
    most = max(1, most)
    if parts[0].points > most:
        shares = [(at + SCHEDULE_PARTS) / (2 * SCHEDULE_PARTS - 1) for at in range(SCHEDULE_PARTS)]
        return tuple(replace(p, points=max(1, round(s * most))) for p, s in zip(parts, shares, strict=True))
    return tuple(replace(part, points=min(part.points, most)) for part in parts)


def _room(data: Data, plan: ProbePlan) -> MachineLimits:
    return MachineLimits(free_bytes(), _free_disk(plan.out), _free_disk(cache_folder(data.path)))


def _free_disk(path: Path) -> int:
    """Free bytes of the disk that a path will lie on."""
    path = path.resolve()
    return shutil.disk_usage(next(p for p in (path, *path.parents) if p.exists())).free


def read_sizes(data: Data, examined: ExaminedData, names: set[str]) -> list[tuple[int, int]]:
    """Widths and heights at which photographs will be used, once for each view that they give."""
    shots, known = examined.gathered.capture.shots, examined.photographs
    looks = [(shot, known[shot.name]) for shot in shots if shot.name in names and shot.name in known]
    return [size for shot, look in looks if look.size for size in view_sizes(data, shot, look.size)]


def _with_maps(data: Data, examined: ExaminedData, recipe: Recipe) -> set[str]:
    """Names of the training photographs that have a depth map, or will have."""
    train = examined.gathered.train
    maps = set(depth_maps(data, examined.gathered))
    found = {shot.name for shot in train if not maps.isdisjoint(view_names([shot]))}
    return found or ({shot.name for shot in train} if recipe.depth is not None else set())


def _load(data: Data, recipe: Recipe, examined: ExaminedData, plan: ProbePlan) -> FixedCosts:
    """What does not depend on points, as far as it is known without a probe."""
    gathered = examined.gathered
    train = {shot.name for shot in gathered.train}
    losses = recipe.pretrain.losses
    priors = _with_maps(data, examined, recipe) if needs_priors(losses) else set()
    view_bytes = 3 * sum(w * h for w, h in read_sizes(data, examined, train))
    view_bytes += sum(w * h for w, h in read_sizes(data, examined, train & set(gathered.masks)))
    view_bytes += prior_bytes(needs_normals(losses)) * sum(w * h for w, h in read_sizes(data, examined, train & priors))
    bent = sum(not is_pinhole(shot.camera) for shot in gathered.capture.shots)
    kept = [*cache_folder(data.path).glob("*.png"), *place(data.path, PANORAMAS).glob("*-front.png")] if bent else []
    there = sum(not path.stem.endswith("-mask") for path in kept)
    return FixedCosts(
        steps=recipe.pretrain.steps,
        train=len(view_names(gathered.train)),
        held_out=len(view_names(gathered.capture.shots)) - len(view_names(gathered.train)),
        view_bytes=view_bytes,
        budget_bytes=cache_bytes(plan.cache),
        undistort=max(0, bent - there),
        undistort_seconds=0.0,
        undistort_bytes=0.0,
        read_seconds=examined.read_seconds,
        read_peak_bytes=examined.read_peak_bytes,
        checkpoint_every=CHECKPOINT_EVERY,
        threads=min(4, os.cpu_count() or 1),
        movable=why_all(recipe.pretrain, recipe.primitive) is None,
    )


def _scene(data: Data, examined: ExaminedData, load: FixedCosts, folder: Path) -> tuple[Scene, FixedCosts]:
    """The scene with a few views, undistorted or cut into a folder of ours, and what that has taken for each."""
    folder.mkdir()
    train = examined.gathered.train
    chosen = [train[at * len(train) // min(PROBE_VIEWS, len(train))] for at in range(min(PROBE_VIEWS, len(train)))]
    start = time.perf_counter()
    with heard():
        scene = build_scene(data, examined.gathered.capture, folder, set(view_names(chosen)))
    seconds = (time.perf_counter() - start) * min(load.threads, len(chosen)) / len(chosen)
    written = sum(path.stat().st_size for path in folder.iterdir())
    bent = sum(not is_pinhole(shot.camera) for shot in chosen)
    if not bent:
        return scene, load
    return scene, replace(load, undistort_seconds=seconds, undistort_bytes=written / bent)


def _failed(probed: ProbeResult, parts: Sequence[ProbeSegment]) -> Finding:
    """What it means that a probe ended early."""
    kind, _, said = (probed.failure or "").partition(": ")
    if kind == BadInput.__name__:
        return Finding("error", "probe", said)
    done = len(probed.taken)
    points = parts[min(done, len(parts) - 1)].points
    where = "before its first step" if done == 0 else f"with {points:,} points"
    text = f"the probe ended {where}: {probed.failure or 'without a word'}"
    lower = "smaller photographs (--scale 2), fewer points (pretrain.densify.filters.0:count-cap) or a smaller --cache"
    return Finding("error" if done == 0 else "warning", "probe", f"{text}; if memory ran out, {lower} need less")
