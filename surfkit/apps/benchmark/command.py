"""`surfkit benchmark`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.apps.benchmark.benchmark_results import LEGEND, facts, failures, head_and_cells, results_in
from surfkit.apps.benchmark.folder_check import look
from surfkit.apps.benchmark.protocol import Protocol
from surfkit.apps.benchmark.protocol_words import description
from surfkit.apps.benchmark.protocols import PROTOCOLS, protocol_of
from surfkit.apps.benchmark.run_benchmark import BenchmarkPlan, run
from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput, printable
from surfkit.core.events import say
from surfkit.raster.select import Device
from surfkit.study.ablation_screen import AblationScreen

FAULTY = 2
"""Exit status where the data are not those of the benchmark."""


@dataclass(frozen=True)
class BenchmarkCommand:
    """Train and measure recipes on a public benchmark, by a protocol that is fixed, so that figures can be compared.

    Without a name, list the benchmarks. The protocol fixes scenes, splits, sizes, steps, depth maps, crops, thresholds
    and alignment; options only choose rows, scenes and seeds. First, the folder is checked: everything that is missing
    or wrong is listed at once, with where it comes from, and nothing is trained. An interrupted benchmark continues
    when the same command is given again.
    """

    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[NAME]")] = None
    """Benchmark: gauu-scene, matrixcity, tanks-and-temples, dtu or shibuya."""

    root: Path | None = None
    """Folder of the data, laid out as `--describe` shows."""

    recipes: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: those of the protocol)")] = ()
    """Rows: those of the protocol by name, or any recipe (`surfkit recipes`) with its own settings; its steps are those
    of the protocol where that has some, as for shibuya."""

    scenes: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: all)")] = ()
    """Scenes of the benchmark to run."""

    seeds: int = 1
    """Number of runs of each row, with seeds 0, 1, 2 and so on; with several, figures have a standard deviation."""

    check: bool = False
    """Only check the folder; exit status 2 if something is missing or wrong."""

    describe: bool = False
    """Only print the protocol in words."""

    show: bool = False
    """Run nothing: show the results in --out."""

    out: Path | None = None
    """Folder of the results. Default: runs/NAME-VERSION."""

    device: Device = "auto"
    """Device for training and rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    def run(self) -> int:
        """Check, run and show: 1 if a row failed, 2 if the folder is not that of the benchmark."""
        if self.name is None:
            return self._list()
        protocol = protocol_of(self.name)
        if sum((self.check, self.describe, self.show)) > 1:
            raise BadInput("--check, --describe and --show each do one thing; give one")
        if self.describe:
            self._refuse_unread(BenchmarkCommand(self.name, describe=True))
            for line in description(protocol):
                tell(line)
            return 0
        out = self.out or Path("runs") / protocol.tag
        if self.show:
            self._refuse_unread(BenchmarkCommand(self.name, self.root, show=True, out=self.out))
            if (found := results_in(out, protocol)) is None:
                raise BadInput(f"--out {out}: no results of a benchmark in it; name their folder")
            return show(found)
        if self.root is None:
            raise BadInput(
                f"--root missing: the folder of the data; `surfkit benchmark {self.name} --describe` shows it"
            )
        return self._run(protocol, self.root, out)

    def _list(self) -> int:
        if self != BenchmarkCommand():
            raise BadInput(f"name a benchmark: {', '.join(PROTOCOLS)}")
        rows = [(each.name, each.tag, str(len(each.scenes)), each.about) for each in PROTOCOLS.values()]
        print_table(("benchmark", "protocol", "scenes", "what it is"), rows)
        return 0

    def _refuse_unread(self, read: BenchmarkCommand) -> None:
        """BadInput for options that are not read: what is given and is not in `read`."""
        for each in fields(self):
            if getattr(self, each.name) != getattr(read, each.name):
                way = "--describe" if read.describe else "--show"
                raise BadInput(f"--{each.name}: {way} does not read it; leave it out")

    def _run(self, protocol: Protocol, root: Path, out: Path) -> int:
        if self.seeds < 1:
            raise BadInput(f"--seeds {self.seeds}: give 1 or more")
        scenes, contenders = protocol.chosen_scenes(self.scenes), protocol.chosen_contenders(self.recipes)
        plan = BenchmarkPlan(protocol, root, out, scenes, contenders, self.seeds, self.device)
        for scene in scenes:
            protocol.table(scene, contenders)  # refuses recipes that are not there
        if found := look(protocol, root, scenes, contenders):
            for finding in found:
                say(printable(finding.text))
            faults = f"{len(found)} fault{'s' * (len(found) > 1)}, listed above"
            say(f"surfkit: {root}: not as {protocol.tag} has it: {faults}; nothing was trained")
            return FAULTY
        if self.check:
            tell(f"{root}: all that {protocol.tag} needs for {', '.join(scene.name for scene in scenes)} is there")
            return 0
        try:
            with AblationScreen() as screen:
                report = run(plan, screen)
        except KeyboardInterrupt:
            say(f"{out} keeps what is finished; give the same command again to continue")
            raise
        status = show(report)
        print()
        files = [(ending, out / f"benchmark.{ending}") for ending in ("md", "csv", "json")]
        print_table(("written", "path"), [(what, str(path)) for what, path in files])
        return status


def show(report: dict[str, Any]) -> int:
    """Print the facts and the table; 1 if a row failed."""
    for name, value in facts(report):
        tell(f"{name}: {value}")
    print()
    print_table(*head_and_cells(report))
    tell(LEGEND)
    for line in failures(report):
        say(f"surfkit: {printable(line)}")
    return 1 if failures(report) else 0


COMMAND = BenchmarkCommand
