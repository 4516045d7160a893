"""Running a benchmark: an ablation table for each scene, with the settings of the protocol."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from surfkit.apps.benchmark.benchmark_results import report_of, results_in, write_report
from surfkit.apps.benchmark.data_record import data_hash
from surfkit.apps.benchmark.protocol import BenchmarkScene, Contender, Protocol
from surfkit.apps.benchmark.provenance import PROVENANCE_FILE, Provenance, provenance_now
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.lock import locked
from surfkit.io.datasets.read import read
from surfkit.raster.select import Device
from surfkit.study.rows import Trial, TrialResult
from surfkit.study.study import AblationPlan, AblationWatcher, ablate, report_so_far
from surfkit.study.truth import Truth


@dataclass(frozen=True)
class BenchmarkPlan:
    """What to run.

    Attributes:
        protocol: All that decides the figures.
        root: Folder of the data.
        out: Of the results.
        scenes: To run.
        contenders: Rows to run.
        seeds: Runs of each row on each scene.
        device: Where to compute.
    """

    protocol: Protocol
    root: Path
    out: Path
    scenes: tuple[BenchmarkScene, ...]
    contenders: tuple[Contender, ...]
    seeds: int = 1
    device: Device = "auto"

    def table(self, scene: BenchmarkScene, truth: Truth) -> AblationPlan:
        """The ablation table of a scene."""
        return AblationPlan(
            self.protocol.table(scene, self.contenders),
            (scene.data(self.root),),
            self.out / scene.name,
            seeds=self.seeds,
            device=self.device,
            truth=(truth,),
            columns=self.protocol.columns,
        )


@dataclass
class SceneTable:
    """A scene as far as it is run.

    Attributes:
        scene: The scene.
        plan: Its rows.
        data: Hash of its data.
        report: What is known of the rows, as `study.report_of` has it.
    """

    scene: BenchmarkScene
    plan: AblationPlan
    data: str
    report: Mapping[str, Any]


@dataclass
class Keeper:
    """Keeps the results up to date while rows are run, and tells another watcher.

    Attributes:
        plan: What is run.
        tables: Every scene.
        made: Provenance of each run, by its folder below `plan.out`.
        before: Results of an earlier command in the folder.
        watch: Is told, too.
        here: The scene that is run.
    """

    plan: BenchmarkPlan
    tables: list[SceneTable]
    made: dict[str, Provenance]
    before: Mapping[str, Any] | None = None
    watch: AblationWatcher | None = None
    here: SceneTable | None = field(default=None, repr=False)

    def begin(self, trial: Trial, at: int, count: int, report: Mapping[str, Any]) -> None:
        """See `AblationWatcher.begin`."""
        if self.watch is not None:
            self.watch.begin(trial, at, count, report)

    def end(self, trial: Trial, outcome: TrialResult, report: Mapping[str, Any]) -> None:
        """See `AblationWatcher.end`."""
        assert self.here is not None, "a run ends within its table"
        self.here.report = report
        if outcome.figures is not None:
            folder = trial.folder.relative_to(self.plan.out).as_posix()
            self.made[folder] = provenance_now(self.plan.protocol.digest, self.here.data, self.plan.device)
            write_json(self.plan.out / PROVENANCE_FILE, self.made)
        self.save()
        if self.watch is not None:
            self.watch.end(trial, outcome, report)

    def save(self) -> dict[str, Any]:
        """Write the results, and return them."""
        report = self.report()
        write_report(self.plan.out, self.plan.protocol, report)
        return report

    def report(self) -> dict[str, Any]:
        """The results so far."""
        known = {table.scene.name: (table.data, table.report) for table in self.tables}
        return report_of(self.plan.protocol, self.plan.seeds, known, self.made, self.before)


def opened(plan: BenchmarkPlan, watch: AblationWatcher | None = None) -> Keeper:
    """A benchmark with what was finished before; of the data, what has not been touched since is not read again.

    Raises:
        BadInput: Data that cannot be used, or results that were made from other data or by another protocol.
    """
    path, before = plan.out / PROVENANCE_FILE, results_in(plan.out, plan.protocol)
    made = read_json(path, dict[str, Provenance]) if path.exists() else {}
    tables = []
    for scene in plan.scenes:
        out, read_scene = plan.out / scene.name, read(scene.data(plan.root))
        files = [plan.root / each.path for each in scene.truth.needed()]
        found = data_hash(read_scene, files, plan.root, out)
        refuse_other(plan, scene, found, made)
        table = plan.table(scene, scene.truth.truth(plan.root.resolve(), out, read_scene))
        tables.append(SceneTable(scene, table, found, report_so_far(table)))
    return Keeper(plan, tables, made, before, watch)


def refuse_other(plan: BenchmarkPlan, scene: BenchmarkScene, data: str, made: Mapping[str, Provenance]) -> None:
    """BadInput if runs of a scene were made from other data, or by another declaration of the same version."""
    for folder, before in made.items():
        if not folder.startswith(f"{scene.name}/"):
            continue
        start = f"--out {plan.out} has results of {plan.protocol.tag}, as {folder},"
        if before.data != data:
            raise BadInput(
                f"{start} of other data: their hash was {before.data}, and that of {scene.name} is {data} now; put the "
                "old files back, name another folder, or delete that one"
            )
        if before.protocol != plan.protocol.digest:
            raise BadInput(f"{start} by another declaration of that version; name another folder, or delete that one")


def run(plan: BenchmarkPlan, watch: AblationWatcher | None = None) -> dict[str, Any]:
    """Run what is not finished, keep the results up to date in the folder, and return them.

    Raises:
        BadInput: Nothing can be run as planned, or what is in the folder does not belong to it.
        KeyboardInterrupt: Someone asked to stop; the same plan goes on from there.
    """
    if plan.out.exists() and not plan.out.is_dir():
        raise BadInput(f"--out {plan.out}: a file, not a folder; name another one")
    with locked(plan.out):
        keeper = opened(plan, watch)
        keeper.save()
        for table in keeper.tables:
            keeper.here = table
            table.report = ablate(table.plan, keeper)
            keeper.save()
        return keeper.save()
