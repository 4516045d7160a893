"""Time and memory by stage."""

from __future__ import annotations

from collections.abc import Sequence

from surfkit.apps.report.elements import Element, ElementGroup, Section, TableCell, TableElement
from surfkit.apps.report.json_values import NO_VALUE, as_bytes, as_duration, mapping, number, numeric
from surfkit.apps.report.run_files import JournaledStage, RunFiles, heading

MEMORY_CAPTION = "The most memory that was held, by what it was taken by"
GPU_MEMORY_CAPTION = "The most memory of the GPU that was held, by what it was taken by"


def resources(runs: Sequence[RunFiles]) -> Section | None:
    """Tables of each run."""
    groups = []
    for run in runs:
        elements = [*_stages(run), *_memory(run)]
        if elements:
            groups.append(ElementGroup(heading(run, runs), tuple(elements), run.id("resources")))
    return Section("resources", "Time and memory", tuple(groups)) if groups else None


def seconds_of(part: JournaledStage) -> float | None:
    """Wall time of the steps of a part; of all its attempts, as far as they came to their end, else by its journal."""
    ended = [number(line, "seconds") for line in part.of("StageEnded")]
    known = [seconds for seconds in ended if seconds is not None]
    if known:
        return sum(known)
    times = [line["time"] for line in part.of("StepDone")]
    return times[-1] - times[0] if len(times) > 1 else None


def _stages(run: RunFiles) -> list[Element]:
    rows: list[tuple[str, float | None, float | None, float | None, float | None, float | None]] = []
    if (prepared := number(run.metrics, "prepare_cpu_seconds")) or (
        prepared := number(run.record, "prepare_cpu_seconds")
    ):
        rows.append(("depth maps (CPU time)", prepared, None, None, None, None))
    for part in run.parts:
        last = next(iter(reversed(part.of("StepDone"))), None)
        if last is not None:
            keys = ("points", "peak_memory_bytes", "peak_gpu_bytes")
            points, memory, gpu = (number(last, key) or None for key in keys)
            rows.append((part.title, seconds_of(part), number(last, "index"), points, memory, gpu))
    for name, data in (("mesh", run.mesh), ("compression", run.compressed)):
        if (took := number(data, "seconds")) is not None:
            rows.append((name, took, None, None, None, None))
    longest = max((row[1] or 0 for row in rows), default=0)
    with_gpu = any(row[5] for row in rows)
    cells = [
        (
            TableCell(name, at),
            TableCell(NO_VALUE)
            if took is None
            else TableCell(as_duration(took), took, share=took / longest if longest else 0.0),
            *(numeric(value, "" if value is None else f"{value:,.0f}") for value in (steps, points)),
            *(numeric(value, "" if value is None else as_bytes(value)) for value in held[: 1 + with_gpu]),
        )
        for at, (name, took, steps, points, *held) in enumerate(rows)
    ]
    head = ("part", "time", "steps", "points", "peak memory", *["peak GPU memory"] * with_gpu)
    return [TableElement("Time and memory by stage", head, tuple(cells), is_sortable=True)] if cells else []


def _memory(run: RunFiles) -> list[Element]:
    return [*_parts(run, "memory_bytes", MEMORY_CAPTION), *_parts(run, "gpu_memory_bytes", GPU_MEMORY_CAPTION)]


def _parts(run: RunFiles, kind: str, title: str) -> list[Element]:
    found = mapping(run.metrics, kind) or mapping(run.record, kind)
    parts = {name: value for name in found if name != "peak" and (value := number(found, name)) is not None}
    most = max(parts.values(), default=0.0)
    rows = [
        (TableCell(name), TableCell(as_bytes(value), value, share=max(0.0, value) / most if most > 0 else 0.0))
        for name, value in parts.items()
    ]
    return [TableElement(title, ("part", "memory"), tuple(rows), is_sortable=True)] if rows else []
