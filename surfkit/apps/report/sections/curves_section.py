"""Curves over the optimisation steps."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

from surfkit.apps.report.elements import Details, Element, ElementGroup, ElementRow, LineChart, Section
from surfkit.apps.report.json_values import mapping, number
from surfkit.apps.report.run_files import JournaledStage, RunFiles, total_loss
from surfkit.apps.report.svg_charts import ChartSeries, chart

Value = Callable[[dict[str, Any]], float | None]


def points(line: dict[str, Any]) -> float | None:
    """The points after a step; None for a method without points."""
    return number(line, "points") or None


def memory(line: dict[str, Any]) -> float | None:
    """The most memory held so far, GB."""
    found = number(line, "peak_memory_bytes")
    return found / 1e9 if found else None


def gpu_memory(line: dict[str, Any]) -> float | None:
    """The most memory of the GPU held so far, GB."""
    found = number(line, "peak_gpu_bytes")
    return found / 1e9 if found else None


def mean_psnr(line: dict[str, Any]) -> float | None:
    """The mean PSNR of the held-out views that were looked at."""
    found = mapping(line, "psnr")
    values = [value for name in found if (value := number(found, name)) is not None]
    return statistics.fmean(values) if values else None


CURVES: tuple[tuple[str, Value, str], ...] = (
    ("Sum of the weighted losses", total_loss, "StepDone"),
    ("Points", points, "StepDone"),
    ("Mean PSNR of a few held-out views, dB", mean_psnr, "Measured"),
    ("Most memory held so far, GB", memory, "StepDone"),
    ("Most memory of the GPU held so far, GB", gpu_memory, "StepDone"),
)


def curves(runs: Sequence[RunFiles]) -> Section | None:
    """Charts of the first stage of all runs, of each loss, and of the blocks and refinements of each run."""
    elements: list[Element] = charts([(run.name, run.first) for run in runs], CURVES)
    for run in runs:
        more = [*_losses(run), *_parts(run)]
        if more and len(runs) > 1:
            more = [Details(f"Losses and parts of {run.name}", tuple(more))]
        elements += more
    return Section("curves", "Curves", tuple(elements)) if elements else None


def charts(parts: Sequence[tuple[str, JournaledStage]], what: Sequence[tuple[str, Value, str]]) -> list[Element]:
    """A chart for each quantity that any of the parts has, a line for each part; none if there are no steps."""
    found = []
    for title, value, event in what:
        series = [(name, part.series(value, event)) for name, part in parts]
        lines = [ChartSeries(name, dots) for name, dots in series if dots is not None]
        if lines:
            found.append(chart(title, lines))
    return [ElementRow(tuple(found), size="wide")] if found else []


def _loss(name: str) -> Value:
    return lambda line: number(line, "losses", name)


def _losses(run: RunFiles) -> list[LineChart]:
    """Each loss of the first stage."""
    done = run.first.of("StepDone")
    names = list(mapping(done[-1], "losses")) if done else []
    series = [(name, run.first.series(_loss(name))) for name in names]
    lines = [ChartSeries(name, dots) for name, dots in series if dots is not None]
    return [chart("Weighted losses, one by one", lines)] if len(lines) > 1 else []


def _parts(run: RunFiles) -> list[Element]:
    """Blocks, and refinements, each in charts of their own."""
    refinements = [part for part in run.parts if part.title.startswith("refinement ")]
    found: list[Element] = []
    for title, parts in (("Blocks", run.blocks), ("Refinements", refinements)):
        drawn = charts([(part.title, part) for part in parts], CURVES[:2])
        if drawn:
            found.append(ElementGroup(f"{title} of {run.name}", tuple(drawn)))
    return found
