"""Which recipe, how many steps, whether in blocks: decided by a look at the data set and a probe, as the doctor's."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from surfkit.apps.doctor.estimate import (
    MIN_CACHE_BYTES,
    USABLE_SHARE,
    ResourceEstimate,
    duration,
    one_digit,
)
from surfkit.apps.doctor.examine import ExaminedData, examine
from surfkit.apps.doctor.finding import Finding
from surfkit.apps.doctor.forecast import ProbePlan, forecast, read_sizes
from surfkit.apps.make.quality import FIXED_SECONDS, MEGAPIXEL_SECONDS, QUALITIES, Quality, QualityName
from surfkit.apps.make.record import Decisions, Forecast
from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.core.memory import size
from surfkit.densify.adc import ADC
from surfkit.densify.filters import CountCap
from surfkit.io.datasets.data import Data
from surfkit.mesh.visibility import Visibility
from surfkit.partition.grid import ContractedGrid
from surfkit.raster import native
from surfkit.raster.select import Device
from surfkit.runs.recipe import Recipe, with_steps

PROBE_STEPS = 25
"""Steps that are measured; the doctor takes twice as many."""
LEAST_SHARE = 0.1
"""Of the likely points that must fit into memory, for a coarse model and blocks to be of use."""
BLOCKS = "surface-blocks"
CLOSED = "visibility"
"""Name of the mesher."""
SEPARATE_FINDINGS = ("memory", "gpu-memory", "first-look", "forecast")
"""Kinds of findings of the forecast that the decisions tell in their own words."""


def decide(data: Data, name: QualityName, steps: int | None, device: Device, out: Path) -> Decisions:
    """What to do with a data set. Says what was found wrong with it that costs quality.

    Args:
        data: With cameras.
        name: The preset.
        steps: That the user wants; None for those of the preset.
        device: Where it will be trained.
        out: Run folder.

    Raises:
        BadInput: There are errors in the data set, or there is no memory for it.
    """
    quality = QUALITIES[name]
    recipe = recipes()[quality.recipe]
    say("looking at the data set, and measuring some steps for the forecast")
    examined = examine(data, recipe, quick=True)
    told = examined.diagnosis.findings
    if errors := [finding.text for finding in told if finding.level == "error"]:
        more = f" (and {len(errors) - 1} more: `surfkit doctor` lists them)" if len(errors) > 1 else ""
        raise BadInput(f"{errors[0]}{more}")
    count = len(examined.gathered.train)
    length = steps or quality.steps(recipe, count, device)
    closes = native.module() is not None
    run = with_steps(closed(recipe) if closes else recipe, length)
    found, more_told = _forecast(data, run, examined, device, out)
    for finding in (*told, *more_told):
        if finding.level == "warning" and finding.what not in SEPARATE_FINDINGS:
            say(f"{finding.level}: {finding.text}")
    pixels = sum(w * h for w, h in read_sizes(data, examined, {shot.name for shot in examined.gathered.train}))
    decided = chosen(quality, found, count, length, pixels / 1e6)
    if not closes:
        say(f"the mesh is that of the recipe: mesh:{CLOSED}, which is closed, needs the compiled part of surfkit")
        return decided
    return replace(decided, mesher=CLOSED)  # one continuous surface is what a client can use


def _forecast(
    data: Data, recipe: Recipe, examined: ExaminedData, device: Device, out: Path
) -> tuple[ResourceEstimate | None, list[Finding]]:
    """What the doctor forecasts; BadInput for what it finds that stops training."""
    found, told = forecast(data, recipe, examined, ProbePlan(PROBE_STEPS, device=device, out=out))
    if errors := [finding.text for finding in told if finding.level == "error"]:
        raise BadInput(errors[0])
    return found, told


def chosen(
    quality: Quality, found: ResourceEstimate | None, photographs: int, steps: int, megapixels: float = 0.0
) -> Decisions:
    """The recipe by its rule: blocks where one model needs more memory than can be used.

    Args:
        quality: The preset.
        found: What a run of one model will take; None where it could not be measured.
        photographs: That are trained on.
        steps: Of optimisation.
        megapixels: Of all these photographs, as they are read.

    Raises:
        BadInput: Not even the coarse model that blocks begin with has room.
    """
    if found is None:
        return Decisions(quality.recipe, "one model, as its memory could not be forecast", photographs, steps)
    other, mesh = None, found.mesh
    if found.gpu is None and mesh is not None:
        guess = FIXED_SECONDS + MEGAPIXEL_SECONDS * megapixels
        other = round(found.depth_seconds + mesh.seconds + guess, 1)
    told = Forecast(
        round(found.seconds, 1), found.memory_bytes, found.run_bytes, other, None if mesh is None else mesh.memory_bytes
    )
    need, usable, where = _tightest(found)
    rule = f"needs {size(need)} of {where} without photographs, and {size(usable)} (90 % of what is free) can be used"
    if need <= usable:
        return Decisions(quality.recipe, f"one model: it {rule}", photographs, steps, forecast=told)
    if not quality.divides:
        why = f"one model, though it {rule}: a draft is never divided, its points are moved to the disk where need be"
        return Decisions(quality.recipe, why, photographs, steps, forecast=told)
    each = found.gpu.point_bytes if found.gpu is not None and where != "memory" else found.point_bytes
    points = found.points - (need - usable) / max(each, 1.0)
    if points < LEAST_SHARE * found.points:
        raise BadInput(
            f"one model {rule}; blocks do not help, as most of it is not for points: smaller photographs need less "
            "(--longest, --quality draft)"
        )
    points = one_digit(points)
    # The blocks together have the points that one model would have had, each with as many around it as in it.
    blocks = max(2, math.ceil(math.sqrt(2 * found.points / points)))
    return Decisions(BLOCKS, f"blocks: one model {rule}", photographs, steps, blocks, points, told)


def _tightest(found: ResourceEstimate) -> tuple[int, int, str]:
    """Memory that one model needs, that can be used, and which memory it is: that of the GPU where this gives out."""
    need = found.memory_bytes - found.cache_bytes + min(found.cache_bytes, int(MIN_CACHE_BYTES))
    usable = int(USABLE_SHARE * found.room.memory_bytes)
    if (gpu := found.gpu) is None:
        return need, usable, "memory"
    on_gpu, free = gpu.memory_bytes - gpu.cache_bytes, int(USABLE_SHARE * gpu.free_bytes)
    if on_gpu > free and need + found.movable_bytes > usable:  # else points are kept in the memory of the CPU
        return on_gpu, free, "memory of the GPU"
    return need, usable, "memory"


def recipe_of(decisions: Decisions) -> Recipe:
    """The recipe that was decided on, the same each time."""
    recipe = recipes()[decisions.recipe]
    if decisions.blocks is not None and decisions.points is not None:
        stage, most = recipe.pretrain, decisions.points
        if isinstance(stage.densify, ADC):
            capped = replace(stage.densify, filters=(CountCap(most), *stage.densify.filters))
            stage = replace(stage, densify=capped)
        grid = ContractedGrid(blocks=(decisions.blocks, decisions.blocks))
        recipe = replace(recipe, partition=grid, pretrain=stage, start=recipe.start.limited(most))
    if decisions.mesher == CLOSED:
        recipe = closed(recipe)
    return with_steps(recipe, decisions.steps)


def closed(recipe: Recipe) -> Recipe:
    """The recipe with a mesh that is closed, as fine as its own."""
    return replace(recipe, mesh=Visibility(oversampling=getattr(recipe.mesh, "oversampling", 1.0)))


def rows(decisions: Decisions) -> list[tuple[str, str]]:
    """Rows of the table that tells what will be done."""
    found = [
        ("photographs", f"{decisions.photographs:,} to train on"),
        ("recipe", f"recipe:{decisions.recipe}, {decisions.steps:,} steps"),
        ("why", decisions.why),
    ]
    if decisions.mesher is not None:
        found.append(("mesh", f"mesh:{decisions.mesher}, closed where something was seen"))
    if decisions.blocks is not None:
        side = f"{decisions.blocks} x {decisions.blocks}"
        found.append(("blocks", f"{side}, after a coarse model of at most {decisions.points:,} points"))
    if (told := decisions.forecast) is None:
        found.append(("time", "not known: nothing could be measured"))
    else:
        later = "depth maps, mesh, texture, maps and reports"
        whole = f"about {duration(told.seconds)} for the steps of optimisation; {later} come on top"
        if told.other_seconds is not None:
            whole = f"about {duration(told.seconds + told.other_seconds)}: {duration(told.seconds)} for the steps of "
            whole += f"optimisation, as measured, and {duration(told.other_seconds)} for {later}, within a factor of 3"
        found.append(("time", whole))
        mesh = "may take more" if told.mesh_bytes is None else f"takes {size(told.mesh_bytes)} beside the points"
        found.append(("memory", f"{size(told.memory_bytes)} for the optimisation; making the mesh {mesh}"))
        found.append(("disk", f"{size(told.disk_bytes)} for the model; {later} come on top"))
    return found
