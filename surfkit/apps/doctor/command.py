"""`surfkit doctor`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from surfkit.apps.doctor.default_steps import with_usual_steps
from surfkit.apps.doctor.estimate import ResourceEstimate, duration, likely_range
from surfkit.apps.doctor.examine import Diagnosis, Told, examine
from surfkit.apps.doctor.finding import FINDING_LEVELS, Finding
from surfkit.apps.doctor.forecast import ProbePlan, forecast
from surfkit.apps.doctor.machine import Machine, machine
from surfkit.cli.console_table import print_table
from surfkit.cli.recipes import ARGV, chosen_recipe, settled
from surfkit.core.check import BadInput, printable
from surfkit.core.codec import dump
from surfkit.core.memory import size
from surfkit.core.registry import name_of
from surfkit.io.datasets.data import ReadSettings
from surfkit.raster.select import Device
from surfkit.runs.recipe import Recipe, with_steps

MAX_PROBED_STEPS, MAX_POINT_COUNT = 10_000, 2**31 - 1
COLOURS = {"error": "bold red", "warning": "yellow", "note": "cyan"}


@dataclass(frozen=True)
class DoctorCommand:
    """Check a data set before training: its contents, all errors in it, and the memory, disk and time of a run.

    Without a data set, tell what surfkit runs on, for a report of a bug: versions, devices, compiled kernels.

    Nothing is written. Exit status: 0 when a run can start, also with warnings, and 2 when there are errors.
    """

    default_recipe: ClassVar[str] = "2dgs"

    recipe: Annotated[Recipe, chosen_recipe]
    """Recipe that the data set is checked for. Default: recipe:2dgs."""

    data: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DATA]")] = None
    """Data set: images/ and a COLMAP model in sparse/0, sparse, colmap/sparse/0 or colmap/sparse, or another layout."""

    json: bool = False
    """Print JSON instead of tables."""

    quick: bool = False
    """Read only the headers of photographs: truncated or blank files and changing exposure are not found then."""

    probe: int = 50
    """Optimisation steps that are measured to estimate memory, disk and time; 0 for no estimate."""

    points: int | None = None
    """Number of points at the end of the run, for the estimate. Default: estimated from the recipe and its limits."""

    steps: int | None = None
    """Optimisation steps of the run; every schedule of the recipe is scaled by the same factor."""

    reading: Annotated[ReadSettings, tyro.conf.arg(name="")] = ReadSettings()
    """How the data set is read."""

    cache: str = "auto"
    """Memory for photographs, masks and depth priors in the run, such as 4GB; auto is half of the free memory."""

    out: Path = Path("runs")
    """Folder of the run folders: free disk space is checked there."""

    device: Device = "auto"
    """Device for training and rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    def __post_init__(self) -> None:
        if self.data is None:
            known = ("--json", "--no-json", f"recipe:{self.default_recipe}")  # the last one is added to all words
            if words := [word for word in ARGV.get() if not word.startswith(known)]:
                raise BadInput(f"{words[0]} is about a data set; name its folder: surfkit doctor DATA")
        object.__setattr__(self, "recipe", settled(self.recipe))
        if not 0 <= self.probe <= MAX_PROBED_STEPS:
            raise BadInput(f"--probe {self.probe}: give 0 (no estimate) to {MAX_PROBED_STEPS} steps")
        if self.points is not None and not 1 <= self.points <= MAX_POINT_COUNT:
            raise BadInput(f"--points {self.points}: give 1 to {MAX_POINT_COUNT}")

    def run(self) -> int:
        """Check, and print the findings."""
        if self.data is None:
            found = machine()
            if self.json:
                print(json.dumps(dump(found), indent=2, ensure_ascii=False))
            else:
                print_table(("machine", ""), machine_rows(found))
            return 0
        data = self.reading.of(self.data, self.recipe.test_every)
        if self.steps is None:
            recipe = with_usual_steps(self.recipe, data, self.device)
        else:
            recipe = with_steps(self.recipe, self.steps)
        with progress_bars() as report:
            examined = examine(data, recipe, self.quick, report)
            diagnosis = examined.diagnosis
            if diagnosis.sound and self.probe and not recipe.has_stages:
                text = f"there is no estimate for method:{name_of(recipe.method)}: it does not optimise splats"
                diagnosis = replace(diagnosis, findings=(*diagnosis.findings, Finding("note", "forecast", text)))
            elif diagnosis.sound and self.probe:
                plan = ProbePlan(self.probe, self.points, self.cache, self.device, self.out)
                estimate, more = forecast(data, recipe, examined, plan, report)
                findings = sorted((*diagnosis.findings, *more), key=lambda f: FINDING_LEVELS.index(f.level))
                diagnosis = replace(diagnosis, findings=tuple(findings), estimate=estimate)
        if self.json:
            print(as_json(diagnosis))
        else:
            show(diagnosis, bool(self.probe))
        return 0 if diagnosis.sound else 2


@contextmanager
def progress_bars() -> Iterator[Told]:
    """Progress bars on the terminal; nothing where there is no terminal."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tasks: dict = {}
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:

        def report(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(printable(what), total=total)
            bar.update(tasks[what], completed=done, total=total)

        yield report


def as_json(diagnosis: Diagnosis) -> str:
    """The diagnosis as JSON, with whether it is sound."""
    return json.dumps({"sound": diagnosis.sound, **dump(diagnosis)}, indent=2, ensure_ascii=False)


def show(diagnosis: Diagnosis, estimate_wanted: bool) -> None:
    """Print the diagnosis for a person.

    Args:
        diagnosis: What to print.
        estimate_wanted: Whether an estimate was wanted.
    """
    console = Console(soft_wrap=not sys.stdout.isatty(), highlight=False)
    print_table(("data set", str(diagnosis.data)), list(diagnosis.found.items()))
    if diagnosis.will:
        console.print("\nA run will", style="bold")
        for text in diagnosis.will:
            console.print(printable(f"  {text}"), markup=False)
    if diagnosis.estimate is not None:
        print()
        print_table(("it will take", ""), rows(diagnosis.estimate))
    print()
    for finding in diagnosis.findings:
        console.print(f"{finding.level}: ", style=COLOURS[finding.level], end="")
        console.print(printable(finding.text), markup=False)
    console.print(verdict(diagnosis, estimate_wanted), style="bold")


def rows(found: ResourceEstimate) -> list[tuple[str, str]]:
    """The rows of the table of the estimate."""
    room = found.room
    steps = ", ".join(f"{1000 * seconds:.0f}" for seconds in found.step_seconds)
    table = [
        ("points", f"{found.first:,} at the start; at the end {likely_range(found)}"),
        ("time", f"{duration(found.seconds)} ({steps} ms a step, from the beginning to the end)"),
        *_other_rows(found),
        (
            "memory",
            f"{size(found.memory_bytes)}, of which photographs {size(found.cache_bytes)}; "
            f"{size(room.memory_bytes)} are free",
        ),
        *_gpu_rows(found),
        ("disk", f"{size(found.run_bytes)} for the run folder; {size(room.run_bytes)} are free"),
    ]
    if found.data_bytes:
        table.append(("", f"{size(found.data_bytes)} for undistorted photographs; {size(room.data_bytes)} are free"))
    if not found.points_known:
        table.append(("", "how much the number of points grows is a rule of thumb; --points tries another number"))
    return table


def _other_rows(found: ResourceEstimate) -> list[tuple[str, str]]:
    """Of depth maps before the first step, and the mesh after the last, if they are made."""
    maps = f"{duration(found.depth_seconds)} before, for depth maps, unless an earlier run has made them"
    table = [("", maps)] if found.depth_seconds else []
    if found.refine_seconds:
        table.append(("", f"{duration(found.refine_seconds)} after, to refine it, at the speed of the last steps"))
    if (mesh := found.mesh) is not None:
        memory = f"{size(mesh.memory_bytes)} of memory beside the points"
        table.append(("", f"{duration(mesh.seconds)} after, for the mesh, with {memory}"))
    return table


def _gpu_rows(found: ResourceEstimate) -> list[tuple[str, str]]:
    """Of the memory of the GPU, if there is one."""
    if (gpu := found.gpu) is None:
        return []
    text = f"{size(gpu.memory_bytes)}, of which photographs {size(gpu.cache_bytes)}; {size(gpu.free_bytes)} are free"
    return [("GPU memory", text)]


def machine_rows(found: Machine) -> list[tuple[str, str]]:
    """The rows of the table of a machine."""
    kernels = found.native
    runnable = f"{', '.join(kernels.kernels)} run here, {kernels.in_use} is used ({kernels.file}, {kernels.compiler})"
    return [
        ("surfkit", found.surfkit),
        ("Python", found.python),
        ("system", found.system),
        (
            "processors",
            f"{found.processors}, of which torch uses {found.threads}; {size(found.memory_bytes)} of memory",
        ),
        ("CUDA of torch", found.cuda or "none: a build without"),
        *(
            (f"GPU {i}", f"{each.name}, {size(each.memory_bytes)}, {each.capability}")
            for i, each in enumerate(found.gpus)
        ),
        ("compiled kernels", kernels.lacking or runnable),
        *((f"rasterizer {name}", text) for name, text in found.rasterizers.items()),
        ("packages", ", ".join(f"{name} {version}" for name, version in found.packages.items())),
        ("plugins", ", ".join(found.plugins) or "none"),
    ]


def verdict(diagnosis: Diagnosis, estimate_wanted: bool) -> str:
    """The last line."""
    counts = [sum(finding.level == level for finding in diagnosis.findings) for level in FINDING_LEVELS]
    words = [
        f"{count} {level}{'s' * (count != 1)}" for level, count in zip(FINDING_LEVELS, counts, strict=True) if count
    ]
    if not diagnosis.sound:
        later = (
            "; the estimate comes when the errors are put right"
            if estimate_wanted and diagnosis.estimate is None
            else ""
        )
        return f"{', '.join(words)}{later}"
    return f"ready to train{': ' if words else ''}{', '.join(words)}"


COMMAND = DoctorCommand
