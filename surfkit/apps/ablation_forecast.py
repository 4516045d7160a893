"""What an ablation table will take, from one short probe on each data set."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from surfkit.apps.doctor.estimate import ResourceEstimate, duration
from surfkit.apps.doctor.examine import examine
from surfkit.apps.doctor.forecast import ProbePlan as Probe
from surfkit.apps.doctor.forecast import forecast
from surfkit.core.events import say
from surfkit.core.memory import size
from surfkit.runs.recipe import Recipe
from surfkit.study.rows import Trial
from surfkit.study.shared_stages import Key, finished_keys, keys_of
from surfkit.study.study import AblationPlan, trials
from surfkit.study.table_text import distinct_names


@dataclass(frozen=True)
class Needs:
    """What some trials on one data set have to compute.

    Attributes:
        runs: Trials that optimise splats.
        others: Trials whose methods do not, and which are not foretold.
        steps: Optimisation steps of all stages, those that several trials share once.
        alone: Steps if each trial computed all its stages itself.
        stages: Stages that make checkpoints, each counted once.
        longest: Steps of the trial that has most.
    """

    runs: int
    others: int
    steps: int
    alone: int
    stages: int
    longest: int = 0


def foretell(plan: AblationPlan, left: Sequence[Trial], probe_steps: int) -> None:
    """Print what the trials that are left of a table will take in time and disk, in a line or two for each data set."""
    done = finished_keys(trials(plan)) if plan.shared else set()
    names = distinct_names([str(data.path.resolve()) for data in plan.data])
    for name, data in zip(names, plan.data, strict=True):
        here = [trial for trial in left if trial.data == data]
        needs, first = needs_of(here, done, plan.shared), next((t for t in here if t.recipe.has_stages), None)
        if first is None:
            continue
        examined = examine(data, first.recipe, quick=True)
        if not examined.diagnosis.sound:
            say(f"forecast: none for {data.path}; `{shlex.join(['surfkit', 'doctor', str(data.path)])}` says why")
            continue
        probe = Probe(probe_steps, plan.max_points, device=plan.device, out=plan.out, threads=plan.workers.threads_each)
        found, findings = forecast(data, first.recipe, examined, probe)
        if found is None:
            say(f"forecast: none for {data.path}: {'; '.join(finding.text for finding in findings)}")
            continue
        for line in lines(plan, name, needs, first.recipe, found):
            say(f"forecast: {line}")


def lines(plan: AblationPlan, name: str, needs: Needs, recipe: Recipe, found: ResourceEstimate) -> Iterator[str]:
    """The forecast for one data set in words.

    Args:
        plan: The table.
        name: Of the data set.
        needs: What is to be computed.
        recipe: That was probed.
        found: What one run of it takes.
    """
    each = sum(found.step_seconds) / len(found.step_seconds)
    aside = max(0.0, found.seconds - each * recipe.pretrain.steps)  # reading, saving, measuring
    aside += found.mesh.seconds if found.mesh is not None else 0.0
    seconds = needs.steps * each + needs.runs * aside + found.depth_seconds  # depth maps are made once
    disk = max(needs.runs, needs.stages) * found.run_bytes
    free = found.room.run_bytes
    maps, meshes = found.depth_seconds > 0, found.mesh is not None
    included = f"with {'depth maps and ' * maps}meshes" if meshes else f"{'with depth maps, ' * maps}without meshes"
    less = f", {needs.alone - needs.steps:,} fewer as rows share stages" if needs.alone > needs.steps else ""
    at_once = plan.workers.at_once or 1
    last = needs.longest * each + aside  # no row is divided
    wall = max(seconds / min(at_once, max(1, needs.runs)), last)
    shared_by = f" ({duration(seconds)} of computing, {at_once} rows at a time)" if at_once > 1 else ""
    likely = "" if found.points_known else f" with about {found.points:,} points, which are a rule of thumb"
    yield (
        f"{name}: {needs.runs} runs, {needs.steps:,} optimisation steps{less}; about {duration(wall)}{shared_by} "
        f"{included}, at {1000 * each:.0f} ms a step{likely}; about {size(disk)} of disk, {size(free)} are free"
    )
    if needs.others:
        yield f"{name}: not included: {needs.others} runs of methods that do not optimise splats"
    if disk > free:
        yield f"{name}: the disk may become full; make room in {plan.out}, or give --out on another disk"


def needs_of(trials: Sequence[Trial], done: set[Key], shared: bool) -> Needs:
    """What trials on one data set have to compute, without what is done."""
    counted: set[Key] = set(done)
    runs = [trial for trial in trials if trial.recipe.has_stages]
    steps = alone = stages = longest = 0
    for trial in runs:
        keys, before = keys_of(trial), steps
        for name, count in stage_steps(trial.recipe).items():
            alone += count
            if shared and keys[name] in counted:
                continue
            counted.add(keys[name])
            steps, stages = steps + count, stages + 1
        longest = max(longest, steps - before)
    return Needs(len(runs), len(trials) - len(runs), steps, alone, stages, longest)


def stage_steps(recipe: Recipe) -> dict[str, int]:
    """Optimisation steps by part of a recipe; of all blocks together, where its partition says how many there are."""
    found = {"pretrain": recipe.pretrain.steps}
    if recipe.partition is not None:
        if recipe.partition_pretrain is not None:
            found["plan"] = recipe.partition_pretrain.steps
        found["tune"] = recipe.tune.steps * math.prod(getattr(recipe.partition, "blocks", ()))
    return found | {f"refine{at}": refine.stage.steps for at, refine in enumerate(recipe.refine)}
