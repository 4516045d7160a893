"""Running an ablation table: every row with every seed, each recipe once, and what came out in a folder."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, write_json, write_text
from surfkit.core.events import say
from surfkit.core.lock import locked
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.select import Device
from surfkit.runs.execute.base import Executor, Inline
from surfkit.runs.folder import Run, read_record
from surfkit.runs.recipe import Recipe, complete
from surfkit.runs.resume import compared_data
from surfkit.runs.run_cache import versions
from surfkit.runs.run_stage import CHECKPOINT_EVERY, select_rasterizer
from surfkit.runs.stage_cache import StageCache
from surfkit.study.ablation import Table, build, limit_points, pick, scaled
from surfkit.study.ablation_warnings import lacked_maps, notes_of
from surfkit.study.foreign_meshes import OtherMesh, measured_mesh, mesh_rows, refuse_unfit
from surfkit.study.latex import latex
from surfkit.study.metric_columns import refuse_unknown_columns
from surfkit.study.perceptual import refuse_unmeasurable
from surfkit.study.row_comparison import compare
from surfkit.study.rows import Trial, TrialJob, TrialResult, attempt, finished, run_elsewhere
from surfkit.study.runs_csv import comma_separated
from surfkit.study.shared_stages import finished_keys, next_wave, shared_stages
from surfkit.study.table_text import markdown
from surfkit.study.truth import Truth

TABLE_WRITERS = {"md": markdown, "tex": latex, "csv": comma_separated}
"""What a table is written as beside JSON, by the ending of the file."""
ADDED_SETTINGS: dict[str, Any] = {"missing": "refuse", "alpha": None}
"""Settings of data sets that older versions had not, and what they do by default: rows of these versions are found."""
NO_MAPS = "there was no depth map to learn from, so the run is that of a row without"
"""Why a row has no figures although it was run."""
STORE = "stages"
"""Folder of the stages that rows share, in that of the table."""


@dataclass(frozen=True)
class AblationPlan:
    """What to run.

    Attributes:
        table: The rows.
        data: What to train on: one data set or more.
        out: Folder of the results.
        steps: Length of a run of the table's base; the recipe's own if None.
        seeds: Runs of each row.
        rows: Numbers or labels of those to run; all if empty.
        device: Where to compute.
        max_points: No row grows beyond this number of points, and none of its blocks while it is tuned.
        truth: For each data set, what the meshes of all rows are compared with, for their F1; rows without a mesh get
            one then. Empty to compare none.
        columns: Those of the written tables; what was measured if empty. LPIPS is measured only if it is named.
        workers: The executor of the rows.
        shared: Whether a stage that several rows have in common is computed once.
        meshes: Of other programs, which are compared with the truth and stand below the rows.
        checkpoint_every: Steps between checkpoints of a run.
    """

    table: Table
    data: tuple[Data, ...]
    out: Path
    steps: int | None = None
    seeds: int = 1
    rows: tuple[str, ...] = ()
    device: Device = "auto"
    max_points: int | None = None
    truth: tuple[Truth, ...] = ()
    columns: tuple[str, ...] = ()
    workers: Executor = Inline()
    shared: bool = True
    meshes: tuple[OtherMesh, ...] = ()
    checkpoint_every: int = CHECKPOINT_EVERY

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise BadInput(f"--seeds {self.seeds}: give 1 or more")
        if self.checkpoint_every < 1:
            raise BadInput(f"--checkpoint-every {self.checkpoint_every}: give 1 or more steps")
        refuse_unknown_columns(self.columns)
        paths = [data.path.resolve() for data in self.data]
        if not paths:
            raise BadInput("--data: name at least one data set")
        if twice := [path for path in paths if paths.count(path) > 1]:
            raise BadInput(f"--data: {twice[0]} is there twice; name each data set once")
        if self.truth and len(self.truth) != len(self.data):
            raise BadInput(
                f"--gt: {len(self.truth)} ground truths for {len(self.data)} data sets; give one for each, in the "
                "same order"
            )
        refuse_unfit(self.meshes, self.table, len(self.data), bool(self.truth))

    @property
    def sets(self) -> list[tuple[Data, Truth | None]]:
        """Each data set with its truth."""
        return list(zip(self.data, self.truth or [None] * len(self.data), strict=True))

    def work(self, trial: Trial) -> TrialJob:
        """What a process needs to know to run a trial."""
        store = self.out / STORE if self.shared else None
        return TrialJob(trial, self.device, store, lpips=self.lpips, checkpoint_every=self.checkpoint_every)

    @property
    def lpips(self) -> bool:
        """Whether LPIPS is measured."""
        return "lpips" in self.columns

    def is_done(self, trial: Trial, outcome: TrialResult) -> bool:
        """Whether all that is wanted of a trial was measured."""
        if outcome.figures is None:
            return False
        wanted = {trial.truth.figure} if trial.truth is not None else set()
        if self.lpips and "psnr" in outcome.figures:  # a mesher alone draws no pictures to measure it on
            wanted |= {"lpips"}
        return wanted <= outcome.figures.keys()


class AblationWatcher(Protocol):
    """Who is told how it goes."""

    def begin(self, trial: Trial, at: int, count: int, report: Mapping[str, Any]) -> None:
        """A run begins, the `at`-th of `count`; with an executor, it is handed over."""

    def end(self, trial: Trial, outcome: TrialResult, report: Mapping[str, Any]) -> None:
        """It has ended."""


def ablate(
    plan: AblationPlan, watch: AblationWatcher, before: Callable[[AblationPlan, Sequence[Trial]], None] | None = None
) -> dict[str, Any]:
    """Run what is not finished yet, keep the results up to date in the folder, and return them as they are saved.

    Args:
        plan: What to run.
        watch: Is told how it goes.
        before: Called with the trials that are to be run, if any, before the first of them begins.

    Raises:
        BadInput: Nothing can be run as planned, or another process works in the folder; nothing has been written then.
        KeyboardInterrupt: Someone asked to stop; the same plan goes on from there.
    """
    if plan.out.exists() and not plan.out.is_dir():
        raise BadInput(f"--out {plan.out}: a file, not a folder; name another one")
    left = unfinished(plan)
    if left:
        refuse_unusable(plan)
        refuse_other_data(plan)
    else:
        try:
            refuse_other_data(plan)
        except BadInput as error:
            say(f"note: nothing is left to run, and the finished rows are shown as they are: {error}")
    with locked(plan.out):
        if before is not None:
            before(plan, left)
        return Session(plan, watch).run(left)


class Session:
    """The runs of a plan, as they come to their ends; `watch` is told how it goes."""

    def __init__(self, plan: AblationPlan, watch: AblationWatcher) -> None:
        self.plan, self.watch = plan, watch
        self.every = trials(plan)
        self.outcomes = known_outcomes(self.every)
        self.report: dict[str, Any] = {}

    def run(self, left: Sequence[Trial]) -> dict[str, Any]:
        """Run some trials, and return the report."""
        plan, waiting, count = self.plan, list(left), len(left)
        StageCache(plan.out / STORE).sweep()
        self.save()
        while waiting:
            wave = self.wave(waiting)
            waiting = [trial for trial in waiting if trial not in wave]
            wave = [trial for trial in wave if not self.has_failed(trial)]  # with another seed it would fail again
            if not wave:
                continue
            for trial in wave:
                self.watch.begin(trial, left.index(trial) + 1, count, self.report)
            works = [plan.work(trial) for trial in wave]
            here = plan.workers.in_process
            ended = ((work, attempt(work)) for work in works) if here else run_elsewhere(works, plan.workers)
            with closing(ended):
                for work, outcome in ended:
                    self.outcomes[work.trial.folder] = outcome
                    self.save()
                    self.watch.end(work.trial, outcome, self.report)
        for mesh in plan.meshes:
            (data,), (truth,) = plan.data, plan.truth
            self.outcomes[mesh.folder(truth, data, plan.out)] = measured_mesh(mesh, truth, data, plan.out)
            self.save()
        return self.report

    def wave(self, waiting: Sequence[Trial]) -> list[Trial]:
        """The trials to run now: the next one in this process, or at once all that share nothing unfinished."""
        if self.plan.workers.in_process:
            return list(waiting[:1])
        return next_wave(waiting, finished_keys(self.every)) if self.plan.shared else list(waiting)

    def has_failed(self, trial: Trial) -> bool:
        """Whether the row has failed on the same data set, with whatever seed."""
        same = (other for other in self.every if (other.label, other.data) == (trial.label, trial.data))
        return any(self.outcomes[each.folder].failed for each in same if each.folder in self.outcomes)

    def save(self) -> None:
        """Write ablation.json and ablation.md."""
        self.report = save(self.plan, self.every, self.outcomes)


def known_outcomes(every: Sequence[Trial]) -> dict[Path, TrialResult]:
    """The outcomes of the trials that were finished before, by the folders of their runs."""
    found = {trial.folder: finished(trial) for trial in every}
    return {folder: TrialResult(known) for folder, known in found.items() if known is not None}


def report_so_far(plan: AblationPlan) -> dict[str, Any]:
    """Plain data of the whole table as far as it has been run; nothing is run, and nothing written."""
    every = trials(plan)
    return report_of(plan, every, known_outcomes(every))


def trials(plan: AblationPlan) -> list[Trial]:
    """Every row with every seed on every data set; all rows with the first seed come first, so that the table is soon
    whole."""
    recipes = {label: sized(recipe, plan) for label, recipe in build(plan.table).items()}
    found = []
    for at in range(plan.seeds):
        for data, truth in plan.sets:
            for label, recipe in recipes.items():
                seeded = replace(recipe, seed=recipe.seed + at)
                folder = run_folder(plan.out / "runs", seeded, data)
                found.append(Trial(label, seeded.seed, seeded, folder, data, truth))
    return found


def sized(recipe: Recipe, plan: AblationPlan) -> Recipe:
    """A row's recipe at the length and with the limit of the plan, and with a mesh where F1 is wanted."""
    if plan.truth and recipe.mesh is None and "mesh" not in recipe.unused:
        recipe = replace(recipe, mesh=TSDF())
    recipe = scaled(recipe, plan.table, plan.steps)
    return limit_points(recipe, plan.max_points) if recipe.has_stages else recipe


def mesh_alone(plan: AblationPlan) -> list[str]:
    """Labels of the rows that make a mesh and draw no pictures, where no mesh is compared: they have no quality to
    show, and are run only where they are named."""
    if plan.truth or plan.rows:
        return []
    return [label for label, recipe in build(plan.table).items() if not recipe.method.draws]


def unfinished(plan: AblationPlan) -> list[Trial]:
    """The trials of the rows of a plan that are still to be run, one for each folder."""
    every, labels, passed_over = trials(plan), pick(plan.table, plan.rows), mesh_alone(plan)
    known = known_outcomes(every)
    first: dict[Path, Trial] = {}
    for trial in every:
        if trial.label not in labels or trial.label in passed_over:
            continue
        if not plan.is_done(trial, known.get(trial.folder, TrialResult())):
            first.setdefault(trial.folder, trial)
    return list(first.values())


def run_folder(runs: Path, recipe: Recipe, data: Data) -> Path:
    """The folder of a run; if there is one that was named by all installed plugins, as runs were before, that one."""
    now, before = (runs / fingerprint(recipe, data, code) for code in (versions(recipe), versions()))
    return before if before.exists() and not now.exists() else now


def fingerprint(recipe: Recipe, data: Data, code: Mapping[str, str]) -> str:
    """Twelve hex digits that two runs share if they are made from the same.

    Args:
        recipe, data: What was done, and with what.
        code: Versions of the packages that did it: surfkit, and the plugins whose parts are in the recipe.
    """
    since = {name for name, usual in ADDED_SETTINGS.items() if getattr(data, name) == usual}
    parts = {
        "recipe": {name: it for name, it in dump(replace(recipe, about="")).items() if name != "test_every"},
        "data": {name: it for name, it in dump(replace(data, path=data.path.resolve())).items() if name not in since},
        "versions": dict(code),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]


def refuse_unusable(plan: AblationPlan) -> None:
    """BadInput for what would make every run fail, before anything is written."""
    select_rasterizer(plan.device)
    plan.workers.ready()
    for data, truth in plan.sets:
        held_out = read(data).held_out
        if not held_out and truth is None:
            told = "no photograph is kept from training, so rows cannot be compared; see --test-every"
            raise BadInput(f"{data.path}: {told}")
        if truth is not None:
            truth.refuse_unusable()
            for mesh in plan.meshes:
                mesh.refuse_unusable()
        if plan.lpips:
            refuse_unmeasurable(held_out)


def refuse_other_data(plan: AblationPlan) -> None:
    """BadInput if finished runs were trained on other photographs, cameras or depth maps than the next ones would be.

    One run that looks at depth maps, and one that does not, stand for all on a data set: they were compared alike.
    """
    every = trials(plan)
    for data, _ in plan.sets:
        own = replace(data, path=data.path.resolve())
        runs = [Run(each.folder, complete(each.recipe), own) for each in every if each.data == data]
        for run in {run.needs_priors: run for run in runs if run.metrics.exists() and run.inputs.exists()}.values():
            other = compared_data(run, read(own), set(read_record(run.out).get("skipped", ())))[1]
            if other is not None:
                raise BadInput(
                    f"--out {plan.out} has rows that are trained already, as {run.out.name}, but {other}, name another "
                    "folder, or delete that one"
                )


def save(plan: AblationPlan, every: list[Trial], outcomes: Mapping[Path, TrialResult]) -> dict[str, Any]:
    """Write the table as JSON, Markdown, LaTeX and CSV, and return what is in the first."""
    report = report_of(plan, every, outcomes)
    write_json(plan.out / "ablation.json", report)
    for ending, form in TABLE_WRITERS.items():
        write_text(plan.out / f"ablation.{ending}", form(report))
    return report


def report_of(plan: AblationPlan, every: Sequence[Trial], outcomes: Mapping[Path, TrialResult]) -> dict[str, Any]:
    """Plain data of the whole table as far as it has been run."""
    return {
        "table": plan.table.name,
        "about": plan.table.about,
        "steps": scaled(plan.table.base, plan.table, plan.steps).length or 0,
        "max_points": plan.max_points,
        "columns": list(plan.columns),
        "also": list(plan.table.columns),
        "seeds": plan.seeds,
        "versions": versions() | {"python": platform.python_version(), "torch": torch.__version__},
        "stages": shared_stages([trial for trial in every if trial.folder in outcomes]),
        "data_sets": [
            {
                "data": dump(replace(data, path=data.path.resolve())),
                "truth": None if truth is None else {"path": str(truth.path), "tau": truth.tau},
                "rows": rows_of(plan, [trial for trial in every if trial.data == data], outcomes)
                + ([] if truth is None else mesh_rows(plan, (data, truth), outcomes)),
                "notes": notes_of(trial for trial in every if trial.data == data and trial.folder in outcomes),
            }
            for data, truth in plan.sets
        ],
    }


def rows_of(plan: AblationPlan, every: Sequence[Trial], outcomes: Mapping[Path, TrialResult]) -> list[dict[str, Any]]:
    """Plain data of every row on one data set."""
    known = [(trial, outcomes[trial.folder]) for trial in every if trial.folder in outcomes]
    measured: dict[str, dict[int, Mapping[str, float]]] = {}
    failed: dict[str, str] = {}
    other: dict[str, str] = {}
    runs: dict[str, list[dict[str, Any]]] = {}
    for trial, outcome in known:
        if outcome.failed is not None:
            failed.setdefault(trial.label, f"seed {trial.seed}: {outcome.failed}")
        if outcome.figures is None:
            continue
        found = outcome.figures
        if lacked_maps(trial):
            found, other[trial.label] = {}, NO_MAPS
        else:
            measured.setdefault(trial.label, {})[trial.seed] = found
        folder = trial.folder.relative_to(plan.out).as_posix()
        runs.setdefault(trial.label, []).append({"seed": trial.seed, "folder": folder, **found})
    return [
        row
        | {
            "runs": runs.get(row["label"], []),
            "failed": failed.get(row["label"]),
            "not_as_named": other.get(row["label"]),
        }
        for row in compare(plan.table, measured)
    ]
