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

from surfkit.cli.recipes import chosen_recipe, settled
from surfkit.cli.table import print_table
from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.core.memory import size
from surfkit.core.registry import name_of
from surfkit.doctor.estimate import Estimate, duration, likely_range
from surfkit.doctor.examine import Diagnosis, Told, examine
from surfkit.doctor.finding import LEVELS, Finding
from surfkit.doctor.forecast import Plan, forecast
from surfkit.pipeline import with_steps
from surfkit.raster.select import Device
from surfkit.readers.data import Reading
from surfkit.recipe import Recipe

MOST_PROBED, MOST_POINTS = 10_000, 2**31 - 1
COLOURS = {"error": "bold red", "warning": "yellow", "note": "cyan"}


@dataclass(frozen=True)
class Doctor:
    """Examine a data set before training: what is there, all that is wrong, and what a run takes.

    Nothing is written. Exits 0 when nothing stops training, warnings allowed, and 2 when there are errors.
    """

    data: Annotated[Path, tyro.conf.Positional]
    """Data set: images/ and a COLMAP model in sparse/0, sparse, colmap/sparse/0 or colmap/sparse, or another layout."""

    default_recipe: ClassVar[str] = "2dgs"

    recipe: Annotated[Recipe, chosen_recipe]
    """What it is to be used for; recipe:2dgs if none is named."""

    json: bool = False
    """Print JSON instead."""

    quick: bool = False
    """Look at the headers of photographs only, which does not find files that are cut off or blank, nor exposures."""

    probe: int = 50
    """Steps to take for the estimate of memory, disk and time; 0 for no estimate."""

    points: int | None = None
    """Points at the end of the run, for the estimate; by default what the recipe allows and is likely."""

    steps: int | None = None
    """Length of the run; every schedule of the recipe is scaled along."""

    reading: Annotated[Reading, tyro.conf.arg(name="")] = Reading()
    """How the data set is read."""

    cache: str = "auto"
    """Memory for photographs, masks and depth priors in the run, such as 4GB; auto takes half of what is free."""

    out: Path = Path("runs")
    """Where the run folder will be: room is looked for there."""

    device: Device = "auto"
    """Where to compute."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "recipe", settled(self.recipe))
        if not 0 <= self.probe <= MOST_PROBED:
            raise BadInput(f"--probe {self.probe}: give 0 (no estimate) to {MOST_PROBED} steps")
        if self.points is not None and not 1 <= self.points <= MOST_POINTS:
            raise BadInput(f"--points {self.points}: give 1 to {MOST_POINTS}")

    def run(self) -> int:
        """Examine, and tell."""
        data = self.reading.of(self.data)
        recipe = self.recipe if self.steps is None else with_steps(self.recipe, self.steps)
        with watched() as told:
            examined = examine(data, recipe, self.quick, told)
            diagnosis = examined.diagnosis
            if diagnosis.sound and self.probe and not recipe.has_stages:
                text = f"there is no estimate for method:{name_of(recipe.method)}: it does not optimise splats"
                diagnosis = replace(diagnosis, findings=(*diagnosis.findings, Finding("note", "forecast", text)))
            elif diagnosis.sound and self.probe:
                plan = Plan(self.probe, self.points, self.cache, self.device, self.out)
                estimate, findings = forecast(data, recipe, examined, plan, told)
                findings = tuple(sorted((*diagnosis.findings, *findings), key=lambda f: LEVELS.index(f.level)))
                diagnosis = replace(diagnosis, findings=findings, estimate=estimate)
        if self.json:
            print(as_json(diagnosis))
        else:
            show(diagnosis, bool(self.probe))
        return 0 if diagnosis.sound else 2


@contextmanager
def watched() -> Iterator[Told]:
    """Bars on the terminal for what takes its time; nothing where there is no terminal."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tasks: dict = {}
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:

        def told(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done, total=total)

        yield told


def as_json(diagnosis: Diagnosis) -> str:
    """The diagnosis as JSON, with whether it is sound."""
    return json.dumps({"sound": diagnosis.sound, **dump(diagnosis)}, indent=2, ensure_ascii=False)


def show(diagnosis: Diagnosis, asked: bool) -> None:
    """Print the diagnosis for a person.

    Args:
        diagnosis: What to print.
        asked: Whether an estimate was wanted.
    """
    console = Console(soft_wrap=not sys.stdout.isatty(), highlight=False)
    print_table((str(diagnosis.data), ""), list(diagnosis.found.items()))
    if diagnosis.will:
        console.print("\nA run will", style="bold")
        for text in diagnosis.will:
            console.print(f"  {text}", markup=False)
    if diagnosis.estimate is not None:
        print()
        print_table(("it will take", ""), rows(diagnosis.estimate))
    print()
    for finding in diagnosis.findings:
        console.print(f"{finding.level}: ", style=COLOURS[finding.level], end="")
        console.print(finding.text, markup=False)
    console.print(verdict(diagnosis, asked), style="bold")


def rows(found: Estimate) -> list[tuple[str, str]]:
    """The estimate in words."""
    room = found.room
    steps = ", ".join(f"{1000 * seconds:.0f}" for seconds in found.step_seconds)
    told = [
        ("points at the end", likely_range(found)),
        ("time", f"{duration(found.seconds)} ({steps} ms a step, from the beginning to the end)"),
        (
            "memory",
            f"{size(found.memory_bytes)}, of which photographs {size(found.cache_bytes)}; "
            f"{size(room.memory_bytes)} are free",
        ),
        ("disk", f"{size(found.run_bytes)} for the run folder; {size(room.run_bytes)} are free"),
    ]
    if found.data_bytes:
        told.append(("", f"{size(found.data_bytes)} for undistorted photographs; {size(room.data_bytes)} are free"))
    if not found.points_known:
        told.append(("", "how far points multiply is a rule of thumb; --points tries another number"))
    return told


def verdict(diagnosis: Diagnosis, asked: bool) -> str:
    """The last line."""
    counts = [sum(finding.level == level for finding in diagnosis.findings) for level in LEVELS]
    words = [f"{count} {level}{'s' * (count != 1)}" for level, count in zip(LEVELS, counts, strict=True) if count]
    if not diagnosis.sound:
        later = "; the estimate comes when the errors are put right" if asked and diagnosis.estimate is None else ""
        return f"{', '.join(words)}{later}"
    return f"ready to train{': ' if words else ''}{', '.join(words)}"


COMMAND = Doctor
