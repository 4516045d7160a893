"""Running an ablation table: every row with every seed, each recipe once, and what came out in a folder."""

from __future__ import annotations

import hashlib
import json
import platform
import traceback
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch

from surfkit import pipeline
from surfkit.blocks.schedule import Compute
from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import dump, read_json, write_json, write_text
from surfkit.core.registry import records
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.select import Device
from surfkit.readers.data import Data
from surfkit.readers.read import read
from surfkit.recipe import Recipe
from surfkit.report.ablation import Table, build, limit_points, pick, scaled
from surfkit.report.compare import compare, figures
from surfkit.report.table import markdown
from surfkit.report.truth import Truth
from surfkit.run.notes import collect_notes
from surfkit.run.stage import select_rasterizer

TRACE = "failed.txt"
"""Where a run that failed in an unforeseen way leaves its traceback."""


@dataclass(frozen=True)
class Plan:
    """What to run.

    Attributes:
        table: The rows.
        data: What to train on.
        out: Folder of the results.
        steps: Length of a run of the table's base; the recipe's own if None.
        seeds: Runs of each row.
        rows: Numbers or labels of those to run; all if empty.
        device: Where to compute.
        max_points: No row grows beyond this number of points.
        truth: What the meshes of all rows are compared with, for their F1; rows without a mesh get one then.
    """

    table: Table
    data: Data
    out: Path
    steps: int | None = None
    seeds: int = 1
    rows: tuple[str, ...] = ()
    device: Device = "auto"
    max_points: int | None = None
    truth: Truth | None = None

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise BadInput(f"--seeds {self.seeds}: give 1 or more")


@dataclass(frozen=True)
class Trial:
    """One row with one seed, and the folder of its run, which rows with the same recipe share."""

    label: str
    seed: int
    recipe: Recipe
    folder: Path


@dataclass(frozen=True)
class Outcome:
    """What a run came to: numbers, the reason in one line why it failed, or both where only its mesh did."""

    figures: Mapping[str, float] | None = None
    failed: str | None = None


class Watch(Protocol):
    """Who is told how it goes."""

    def begin(self, trial: Trial, at: int, count: int, report: Mapping[str, Any]) -> None:
        """A run begins, the `at`-th of `count`."""

    def end(self, trial: Trial, outcome: Outcome, report: Mapping[str, Any]) -> None:
        """It has ended."""


def ablate(plan: Plan, watch: Watch) -> dict[str, Any]:
    """Run what is not finished yet, keep the results up to date in the folder, and return them as they are saved.

    Raises:
        BadInput: Nothing can be run as planned; nothing has been written then.
        KeyboardInterrupt: Someone asked to stop; the same plan goes on from there.
    """
    every = trials(plan)
    outcomes = {trial.folder: Outcome(found) for trial in every if (found := finished(trial.folder, plan.truth))}
    done = [folder for folder, known in outcomes.items() if plan.truth is None or "f1" in known.figures]
    left = unfinished(every, pick(plan.table, plan.rows), done)
    if left:
        refuse_unusable(plan)
    report = save(plan, every, outcomes)
    for at, trial in enumerate(left, 1):
        if any(row["label"] == trial.label and row["failed"] for row in report["rows"]):
            continue  # with another seed it would most likely fail again
        watch.begin(trial, at, len(left), report)
        outcomes[trial.folder] = outcome = attempt(trial, plan)
        report = save(plan, every, outcomes)
        watch.end(trial, outcome, report)
    return report


def trials(plan: Plan) -> list[Trial]:
    """Every row with every seed; all rows with the first seed come first, so that the table is soon whole."""
    recipes = {label: sized(recipe, plan) for label, recipe in build(plan.table).items()}
    found = []
    for at in range(plan.seeds):
        for label, recipe in recipes.items():
            seeded = replace(recipe, seed=recipe.seed + at)
            found.append(Trial(label, seeded.seed, seeded, plan.out / "runs" / fingerprint(seeded, plan.data)))
    return found


def sized(recipe: Recipe, plan: Plan) -> Recipe:
    """A row's recipe at the length and with the limit of the plan, and with a mesh where F1 is wanted."""
    if plan.truth is not None and recipe.mesh is None and "mesh" not in recipe.unused:
        recipe = replace(recipe, mesh=TSDF())
    recipe = scaled(recipe, plan.table, plan.steps)
    return limit_points(recipe, plan.max_points) if recipe.has_stages else recipe


def unfinished(every: Sequence[Trial], labels: Collection[str], outcomes: Collection[Path]) -> list[Trial]:
    """The trials of some rows that are still to be run, one for each folder."""
    first: dict[Path, Trial] = {}
    for trial in every:
        if trial.label in labels and trial.folder not in outcomes:
            first.setdefault(trial.folder, trial)
    return list(first.values())


def fingerprint(recipe: Recipe, data: Data) -> str:
    """Twelve hex digits that two runs share if they are made from the same: recipe, data, and versions of the code."""
    parts = {
        "recipe": dump(replace(recipe, about="")),
        "data": dump(replace(data, path=data.path.resolve())),
        "versions": versions(),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def versions() -> dict[str, str]:
    """Of surfkit and of the installed plugins that offer parts of recipes."""
    offering = [plugin for plugin in records() if plugin.distribution and "surfkit_components" in plugin.hooks]
    return {plugin.distribution: plugin.version for plugin in offering}


def finished(folder: Path, truth: Truth | None = None) -> dict[str, float] | None:
    """The numbers of a run that is over: its metrics are written last, and deleted when it is trained further."""
    path = folder / "metrics.json"
    if not path.exists():
        return None
    metrics = read_json(path, dict[str, Any])
    if truth is None or not truth.known(metrics):
        metrics.pop("geometry", None)  # of another truth
    try:
        return figures(metrics)
    except BadInput as error:
        raise BadInput(f"{path}: {error}; delete it, and the row is measured again") from error


def refuse_unusable(plan: Plan) -> None:
    """BadInput for what would make every run fail, before anything is written."""
    if plan.out.exists() and not plan.out.is_dir():
        raise BadInput(f"--out {plan.out}: a file, not a folder; name another one")
    select_rasterizer(plan.device)
    if not read(plan.data).held_out:
        raise BadInput("no photograph is kept from training, so rows cannot be compared; see --test-every")
    if plan.truth is not None:
        plan.truth.refuse_unusable()


def attempt(trial: Trial, plan: Plan) -> Outcome:
    """Run one recipe, or go on with it; what goes wrong becomes its outcome."""
    trace, found = trial.folder / TRACE, finished(trial.folder)
    try:
        if found is None:
            found = figures(pipeline.run(trial.recipe, plan.data, trial.folder, Compute(plan.device)))
        if plan.truth is not None:
            with collect_notes():
                found = figures(plan.truth.measure(trial.folder, plan.out))
    except (BadInput, Fault) as error:
        return Outcome(found, " ".join(str(error).split()))
    except Exception as error:
        write_text(trace, traceback.format_exc())
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return Outcome(found, f"{reason[:200]}; see {trace}")
    trace.unlink(missing_ok=True)
    return Outcome(found)


def save(plan: Plan, every: list[Trial], outcomes: Mapping[Path, Outcome]) -> dict[str, Any]:
    """Write ablation.json and ablation.md, and return what is in the first."""
    report = report_of(plan, every, outcomes)
    write_json(plan.out / "ablation.json", report)
    write_text(plan.out / "ablation.md", markdown(report))
    return report


def report_of(plan: Plan, every: list[Trial], outcomes: Mapping[Path, Outcome]) -> dict[str, Any]:
    """Plain data of the whole table as far as it has been run."""
    known = [(trial, outcomes[trial.folder]) for trial in every if trial.folder in outcomes]
    measured: dict[str, dict[int, Mapping[str, float]]] = {}
    failed: dict[str, str] = {}
    runs: dict[str, list[dict[str, Any]]] = {}
    for trial, outcome in known:
        if outcome.failed is not None:
            failed.setdefault(trial.label, f"seed {trial.seed}: {outcome.failed}")
        if outcome.figures is None:
            continue
        measured.setdefault(trial.label, {})[trial.seed] = outcome.figures
        folder = trial.folder.relative_to(plan.out).as_posix()
        runs.setdefault(trial.label, []).append({"seed": trial.seed, "folder": folder, **outcome.figures})
    rows = compare(plan.table, measured)
    return {
        "table": plan.table.name,
        "about": plan.table.about,
        "steps": scaled(plan.table.base, plan.table, plan.steps).length or 0,
        "max_points": plan.max_points,
        "truth": None if plan.truth is None else {"path": str(plan.truth.path), "tau": plan.truth.tau},
        "seeds": plan.seeds,
        "data": dump(replace(plan.data, path=plan.data.path.resolve())),
        "versions": versions() | {"python": platform.python_version(), "torch": torch.__version__},
        "rows": [row | {"runs": runs.get(row["label"], []), "failed": failed.get(row["label"])} for row in rows],
    }
